"""The learning rule in a process of its own, so that no update waits for what this one serves.

The two processes speak over a pair of sockets that nobody else has: this one asks for one thing at a time,
the other answers with it, or with what was raised. The other writes nothing, listens nowhere, and ends when
this end is closed, however that came about.
"""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from enum import StrEnum
from typing import Any, Self

import numpy as np

from liir_common.config import Config
from liir_common.errors import ComputeError, ConfigError
from liir_common.types import Array, Batch, EnvSpec, Weights
from services.learner.compute.link import NO_ARRAYS, Link
from services.learner.replay_store import join, split

_COMMAND = (sys.executable, "-m", __name__)
_END_S = 10.0
_ERRORS = {kind.__name__: kind for kind in (ConfigError, FloatingPointError, ValueError)}
"""What an algorithm is expected to raise."""


class Answer(StrEnum):
    """What comes back."""

    VALUE = "value"
    ERROR = "error"
    """What was raised: its classes, its text, and its traceback, which would stay behind"""
    POLICY = "policy"
    """The update goes on, this is the policy that it leaves"""


class Compute:
    """An `Algorithm` in a process of its own.

    What is raised there is raised here, as the first of its classes that `Algorithm` speaks of, else as a
    RuntimeError; and `ComputeError` by every method once that process is gone.
    """

    def __init__(self, spec: EnvSpec, config: Config) -> None:
        """Start the process, with the method, device and threads of `config`.

        Raises:
            ConfigError: the device is not there.
        """
        ours, theirs = socket.socketpair()
        with theirs:
            end = theirs.fileno()
            self._process = subprocess.Popen([*_COMMAND, str(end)], pass_fds=[end])
        self._link = Link(ours)
        try:
            has_replay, _ = self._ask("make", {"spec": asdict(spec), "config": config.shared_tree()})
        except BaseException:
            self.close()
            raise
        self.replay = _Replay(self._ask) if has_replay else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def close(self) -> None:
        """End the process; no thread may be waiting for an answer."""
        self._link.close()
        self._end()

    def policy(self) -> Weights:
        """As `Algorithm.policy`."""
        return self._ask("policy")[1]

    def intrinsic(self) -> Weights:
        """As `Algorithm.intrinsic`."""
        return self._ask("intrinsic")[1]

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """As `Algorithm.update`."""
        arrays = {name: value for name, value in vars(batch).items() if isinstance(value, np.ndarray)}
        numbers = {name: value for name, value in vars(batch).items() if name not in arrays}
        figures: dict[str, float] = self._ask("update", numbers, arrays, policy_ready)[0]
        return figures

    def state(self) -> dict[str, Array]:
        """As `Algorithm.state`."""
        return self._ask("state")[1]

    def load_state(self, state: Mapping[str, Array]) -> None:
        """As `Algorithm.load_state`."""
        self._ask("load_state", arrays=state)

    def parameter_counts(self) -> dict[str, int]:
        """As `Algorithm.parameter_counts`."""
        counts: dict[str, int] = self._ask("parameter_counts")[0]
        return counts

    def _ask(
        self,
        what: str,
        value: object = None,
        arrays: Mapping[str, Array] = NO_ARRAYS,
        policy_ready: Callable[[Weights], None] = lambda _: None,
    ) -> tuple[Any, dict[str, Array]]:
        try:
            self._link.send([what, value], arrays)
        except OSError:
            raise self._death(f"before {what!r}") from None
        del arrays  # which may be a whole replay
        while True:
            try:
                (answer, got), got_arrays = self._link.receive()
            except (EOFError, OSError):
                raise self._death(f"during {what!r}") from None
            if answer == Answer.VALUE:
                return got, got_arrays
            if answer == Answer.ERROR:
                raise _error(*got)
            policy_ready(got_arrays)

    def _end(self) -> int:
        """The code that the process ends with, now that one side of the connection is closed."""
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def _death(self, when: str) -> ComputeError:
        code = self._end()
        how = f"{signal.Signals(-code).name} killed it" if code < 0 else f"it ended with code {code}"
        return ComputeError(
            f"the process that computes learner steps is gone: {how} {when}; resume the run, which goes on "
            "from its last saved state; if nobody killed it, see that the machine has memory enough"
        )


class _Replay:
    """The replay of the algorithm there."""

    def __init__(self, ask: Callable[..., tuple[Any, dict[str, Array]]]) -> None:
        self._ask = ask

    @property
    def first(self) -> int:
        """As `Replay.first`."""
        return int(self._ask("replay.first")[0])

    def frames(self, first: int) -> list[bytes]:
        """As `Replay.frames`."""
        return split(self._ask("replay.frames", first)[1])

    def extend(self, first: int, frames: Sequence[bytes]) -> None:
        """As `Replay.extend`."""
        self._ask("replay.extend", first, join(frames))


def _error(kinds: list[str], text: str, trace: str) -> Exception:
    known = next((_ERRORS[kind] for kind in kinds if kind in _ERRORS), None)
    error = RuntimeError(f"{kinds[0]}: {text}") if known is None else known(text)
    error.add_note(f"There:\n{trace}")
    return error
