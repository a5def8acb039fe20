"""The learning rules, each in one file that reads beside its paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import torch

from liir_common.config import AlgorithmConfig
from liir_common.types import Array, Batch, EnvSpec, Weights
from services.learner.algorithms.central_v import CentralV
from services.learner.algorithms.coma import Coma
from services.learner.algorithms.iac import Iac
from services.learner.algorithms.iql import Iql
from services.learner.algorithms.liir import Liir
from services.learner.algorithms.qmix import Qmix
from services.learner.algorithms.vdn import Vdn


class SavedReplay(Protocol):
    """What the learner needs of a replay, see `Replay`."""

    @property
    def first(self) -> int:
        """Number of the oldest episode that is here."""

    def frames(self, first: int) -> list[bytes]:
        """The episodes from number `first` on."""

    def extend(self, first: int, frames: Sequence[bytes]) -> None:
        """Take in the episodes from number `first` on; unless they come next, nothing else stays."""


class Algorithm(Protocol):
    """What the learner needs of a learning rule. Not thread-safe: one thread calls it."""

    @property
    def replay(self) -> SavedReplay | None:
        """Episodes to learn from again, saved beside the state; None if the method is on-policy."""

    def policy(self) -> Weights:
        """Copies of the policy's weights under the names and shapes of `policy_shapes`."""

    def intrinsic(self) -> Weights:
        """Copies of the weights of the intrinsic reward; empty if the method has none."""

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """One learner step; returns figures by name, those without a value in this batch left out.

        `policy_ready` is called once, with what `policy()` is after this step, as soon as that is known: the
        next batch can be played with it while the rest of the step is made.

        Raises:
            ValueError: the batch does not fit; nothing has changed then.
            FloatingPointError: learning has diverged.
        """

    def state(self) -> dict[str, Array]:
        """Copies of everything that `update` depends on but the replay."""

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Go on from `state`, bit for bit as if never stopped.

        Raises:
            ValueError: names, shapes or dtypes differ; nothing has changed then.
        """

    def parameter_counts(self) -> dict[str, int]:
        """Number of parameters of each network, theta first; budget, if there is one, is what the paper
        grants those beside theta."""


_METHODS: Mapping[str, Callable[[EnvSpec, AlgorithmConfig, int, torch.device, torch.dtype], Algorithm]] = {
    "liir": Liir,
    "central_v": CentralV,
    "iac": Iac,
    "coma": Coma,
    "iql": Iql,
    "vdn": Vdn,
    "qmix": Qmix,
}


def make_algorithm(
    spec: EnvSpec,
    config: AlgorithmConfig,
    seed: int,
    device: torch.device,
    dtype: torch.dtype = torch.float32,
) -> Algorithm:
    """The method `config.name` for environment `spec`, initialised from `seed` alone (0 <= seed < 2**64)."""
    return _METHODS[config.name](spec, config, seed, device, dtype)
