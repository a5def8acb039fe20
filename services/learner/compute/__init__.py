"""The learning rule in a process of its own, so that no update waits for what this one serves.

The two processes speak over a pair of sockets that nobody else has: this one asks for one thing at a time,
the other answers with it, or with the exception that it was. The other writes nothing, listens nowhere, and
ends when this end is closed, however that came about.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from enum import Enum, auto
from multiprocessing import Pipe
from typing import Any, Self

from liir_common import seeds
from liir_common.config import Config
from liir_common.errors import ComputeError
from liir_common.types import Array, Batch, EnvSpec, Weights

_COMMAND = (sys.executable, "-m", __name__)
_END_S = 10.0


class Answer(Enum):
    """What comes back."""

    VALUE = auto()
    ERROR = auto()
    POLICY = auto()
    """The update goes on, this is the policy that it leaves"""


class Compute:
    """An `Algorithm` in a process of its own.

    What is raised there is raised here, and `ComputeError` by every method once that process is gone.
    """

    def __init__(self, spec: EnvSpec, config: Config) -> None:
        """Start the process, with the method, device and threads of `config`.

        Raises:
            ConfigError: the device is not there.
        """
        self._connection, theirs = Pipe()
        with theirs:
            end = theirs.fileno()
            self._process = subprocess.Popen([*_COMMAND, str(end)], pass_fds=[end])
        seed = seeds.derive(config.seed, seeds.LEARNER)
        try:
            has_replay = self._ask("make", spec, config.algorithm, seed, config.learner)
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
        self._connection.close()
        self._end()

    def policy(self) -> Weights:
        """As `Algorithm.policy`."""
        weights: Weights = self._ask("policy")
        return weights

    def intrinsic(self) -> Weights:
        """As `Algorithm.intrinsic`."""
        weights: Weights = self._ask("intrinsic")
        return weights

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """As `Algorithm.update`."""
        figures: dict[str, float] = self._ask("update", batch, policy_ready=policy_ready)
        return figures

    def state(self) -> dict[str, Array]:
        """As `Algorithm.state`."""
        state: dict[str, Array] = self._ask("state")
        return state

    def load_state(self, state: Mapping[str, Array]) -> None:
        """As `Algorithm.load_state`."""
        self._ask("load_state", state)

    def parameter_counts(self) -> dict[str, int]:
        """As `Algorithm.parameter_counts`."""
        counts: dict[str, int] = self._ask("parameter_counts")
        return counts

    def _ask(
        self, what: str, *arguments: object, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> Any:
        try:
            self._connection.send((what, arguments))
        except OSError:
            raise self._death(f"before {what!r}") from None
        while True:
            try:
                answer, value = self._connection.recv()
            except (EOFError, OSError):
                raise self._death(f"during {what!r}") from None
            if answer is Answer.VALUE:
                return value
            if answer is Answer.ERROR:
                raise value
            policy_ready(value)

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

    def __init__(self, ask: Callable[..., Any]) -> None:
        self._ask = ask

    @property
    def first(self) -> int:
        """As `Replay.first`."""
        return int(self._ask("replay.first"))

    def frames(self, first: int) -> list[bytes]:
        """As `Replay.frames`."""
        frames: list[bytes] = self._ask("replay.frames", first)
        return frames

    def restore(self, total: int, frames: Sequence[bytes]) -> None:
        """As `Replay.restore`."""
        self._ask("replay.restore", total, frames)
