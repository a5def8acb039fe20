"""The process that computes updates, for whoever has the other end of the socket that its argument names."""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from operator import attrgetter
from typing import Any

import torch

from liir_common.config import AlgorithmConfig, LearnerConfig
from liir_common.errors import ConfigError
from liir_common.types import EnvSpec, Weights
from services.learner.algorithms import Algorithm, make_algorithm
from services.learner.compute import Answer
from services.learner.memory import keep_memory


def main(make: Callable[..., Algorithm]) -> None:
    """Answer with what `make` gives until the other end is closed; signals are for the process there."""
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)
    with Connection(int(sys.argv[1])) as connection, suppress(EOFError, ConnectionError):
        worker = Worker(connection, make)
        while True:
            worker.answer(*connection.recv())


class Worker:
    """Does what it is asked for with the algorithm that it was first asked to make."""

    def __init__(self, connection: Connection, make: Callable[..., Algorithm]) -> None:
        """Nothing is there until "make" is asked for, whose arguments are those of `make`."""
        self._connection = connection
        self._make = make
        self._algorithm: Algorithm

    def answer(self, what: str, arguments: tuple[Any, ...]) -> None:
        """Do it, and send what came of it."""
        try:
            answer = Answer.VALUE, self._do(what, arguments)
        except Exception as error:
            error.add_note(f"There:\n{traceback.format_exc()}")  # which would stay behind
            answer = Answer.ERROR, error
        self._connection.send(answer)

    def _do(self, what: str, arguments: tuple[Any, ...]) -> Any:
        if what == "make":
            self._algorithm = self._make(*arguments)
            return self._algorithm.replay is not None
        if what == "update":
            (batch,) = arguments
            return self._algorithm.update(batch, self._policy_ready)
        found = attrgetter(what)(self._algorithm)
        return found(*arguments) if callable(found) else found

    def _policy_ready(self, weights: Weights) -> None:
        self._connection.send((Answer.POLICY, weights))


def make(spec: EnvSpec, config: AlgorithmConfig, seed: int, learner: LearnerConfig) -> Algorithm:
    """The algorithm on its device, in a process set up for it.

    Raises:
        ConfigError: that device is not there.
    """
    keep_memory()
    torch.set_num_threads(learner.threads)
    return make_algorithm(spec, config, seed, device(learner.device))


def device(name: str) -> torch.device:
    """The device to train on: "auto" takes a GPU when there is one.

    Raises:
        ConfigError: "cuda", and torch sees none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "learner.device: wanted a CUDA device, torch sees none; set auto or cpu, or mend the driver"
        )
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


if __name__ == "__main__":
    main(make)
