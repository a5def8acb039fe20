"""The process that computes updates, for whoever has the other end of the socket that its argument names."""

from __future__ import annotations

import signal
import socket
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from typing import Any

import torch

from liir_common import seeds
from liir_common.config import Config, from_tree
from liir_common.errors import ConfigError
from liir_common.types import Array, Batch, EnvSpec, Weights
from services.learner.algorithms import Algorithm, SavedReplay, make_algorithm
from services.learner.compute import Answer
from services.learner.compute.link import NO_ARRAYS, Link
from services.learner.memory import keep_memory
from services.learner.replay_store import join, split

Make = Callable[[EnvSpec, Config], Algorithm]


def main(make: Make) -> None:
    """Answer with what `make` gives until the other end is closed; signals are for the process there."""
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)
    end = socket.socket(fileno=int(sys.argv[1]))
    with closing(Link(end)) as link, suppress(EOFError, ConnectionError):
        worker = Worker(link, make)
        while True:
            worker.answer(*link.receive())  # nothing of which stays here while the next is waited for


class Worker:
    """Does what it is asked for with the algorithm that it was first asked to make."""

    def __init__(self, link: Link, make: Make) -> None:
        """Nothing is there until "make" is asked for."""
        self._link = link
        self._make = make
        self._algorithm: Algorithm

    def answer(self, question: tuple[str, Any], arrays: Mapping[str, Array]) -> None:
        """Do it, and send what came of it."""
        try:
            got, got_arrays = self._do(*question, arrays)
            self._link.send([Answer.VALUE, got], got_arrays)
        except ConnectionError:  # the other end is gone
            raise
        except Exception as error:
            kinds = [kind.__name__ for kind in type(error).__mro__]
            self._link.send([Answer.ERROR, [kinds, str(error), traceback.format_exc()]])

    def _do(self, what: str, value: Any, arrays: Mapping[str, Array]) -> tuple[Any, Mapping[str, Array]]:
        if what == "make":
            self._algorithm = self._make(EnvSpec.of(value["spec"]), from_tree(value["config"]))
            return self._algorithm.replay is not None, NO_ARRAYS
        algorithm = self._algorithm
        match what:
            case "policy":
                return None, algorithm.policy()
            case "intrinsic":
                return None, algorithm.intrinsic()
            case "update":
                return algorithm.update(Batch(**value | arrays), self._policy_ready), NO_ARRAYS
            case "state":
                return None, algorithm.state()
            case "load_state":
                algorithm.load_state(arrays)
                return None, NO_ARRAYS
            case "parameter_counts":
                return algorithm.parameter_counts(), NO_ARRAYS
            case "replay.first":
                return self._replay.first, NO_ARRAYS
            case "replay.frames":
                return None, join(self._replay.frames(value))
            case "replay.extend":
                self._replay.extend(value, split(arrays))
                return None, NO_ARRAYS
        raise NotImplementedError(what)

    @property
    def _replay(self) -> SavedReplay:
        replay = self._algorithm.replay
        assert replay is not None, "asked for only where there is one"
        return replay

    def _policy_ready(self, weights: Weights) -> None:
        self._link.send([Answer.POLICY, None], weights)


def make(spec: EnvSpec, config: Config) -> Algorithm:
    """The algorithm on its device, in a process set up for it.

    Raises:
        ConfigError: that device is not there.
    """
    keep_memory()
    torch.set_num_threads(config.learner.threads)
    seed = seeds.derive(config.seed, seeds.LEARNER)
    return make_algorithm(spec, config.algorithm, seed, device(config.learner.device))


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
