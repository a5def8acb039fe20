"""Independent Q-learning: each agent learns the value of its own actions (Tan, ICML 1993)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from liir_common.config import AlgorithmConfig
from liir_common.types import EnvSpec
from services.learner.algorithms.q_learning import QLearning


class Independent:
    """No mixing: every agent's value has a target of its own."""

    head = ""
    shapes: Mapping[str, tuple[int, ...]] = {}

    def __call__(self, flat: Tensor, q: Tensor, state: Tensor) -> Tensor:
        """The agents' values [M, n] as they are."""
        return q


class Iql(QLearning):
    """Q networks that share their parameters and nothing else."""

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        super().__init__(spec, config, seed, device, dtype, Independent())
