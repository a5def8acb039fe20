"""What algorithms save, as tensors to calculate with."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from services.learner.algorithms import Algorithm


def state_of(algorithm: Algorithm) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in algorithm.state().items()}


def load_state(algorithm: Algorithm, state: Mapping[str, Tensor]) -> None:
    algorithm.load_state({name: tensor.numpy() for name, tensor in state.items()})
