"""Saving and restoring what an algorithm depends on, as flat names to arrays."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from liir_common.types import Array


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors under `prefix.name`."""
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def snapshot(tensors: Mapping[str, Tensor]) -> dict[str, Array]:
    """Copies, each in one piece of memory."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}


@torch.no_grad()
def restore(live: Mapping[str, Tensor], state: Mapping[str, Array]) -> None:
    """Copy `state` into the `live` tensors; nothing is touched unless all of it fits.

    Raises:
        ValueError: names, shapes or dtypes differ.
    """
    missing, unknown = sorted(live.keys() - state.keys()), sorted(state.keys() - live.keys())
    if missing or unknown:
        raise ValueError(
            f"this state is of another algorithm or configuration: missing {missing}, unknown {unknown}"
        )
    saved = {name: torch.tensor(array) for name, array in state.items()}
    for name, tensor in live.items():
        wanted, got = (tuple(tensor.shape), tensor.dtype), (tuple(saved[name].shape), saved[name].dtype)
        if wanted != got:
            raise ValueError(f"state {name} wants shape and dtype {wanted}, got {got}")
    for name, tensor in live.items():
        tensor.copy_(saved[name])
