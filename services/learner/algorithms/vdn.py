"""VDN: the team's value is the sum of the agents' values (Sunehag et al., AAMAS 2018)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from liir_common.config import AlgorithmConfig
from liir_common.types import EnvSpec
from services.learner.algorithms.q_learning import QLearning


class Sum:
    """Q_tot = Σ_i Q_i."""

    head = ""
    shapes: Mapping[str, tuple[int, ...]] = {}

    def __call__(self, flat: Tensor, q: Tensor, state: Tensor) -> Tensor:
        """[M, 1] of the agents' values [M, n]."""
        return q.sum(1, keepdim=True)


class Vdn(QLearning):
    """Q networks whose sum is fitted to the team's return."""

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        super().__init__(spec, config, seed, device, dtype, Sum())
