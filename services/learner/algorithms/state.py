"""Saving and restoring what an algorithm depends on, as flat names to tensors."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors under `prefix.name`."""
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def snapshot(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Copies on the CPU."""
    return {name: tensor.detach().clone().cpu() for name, tensor in tensors.items()}


@torch.no_grad()
def restore(live: Mapping[str, Tensor], state: Mapping[str, Tensor]) -> None:
    """Copy `state` into the `live` tensors; nothing is touched unless all of it fits.

    Raises:
        ValueError: names, shapes or dtypes differ.
    """
    missing, unknown = sorted(live.keys() - state.keys()), sorted(state.keys() - live.keys())
    if missing or unknown:
        raise ValueError(
            f"this state is of another algorithm or configuration: missing {missing}, unknown {unknown}"
        )
    for name, tensor in live.items():
        wanted, got = (tuple(tensor.shape), tensor.dtype), (tuple(state[name].shape), state[name].dtype)
        if wanted != got:
            raise ValueError(f"state {name} wants shape and dtype {wanted}, got {got}")
    for name, tensor in live.items():
        tensor.copy_(state[name])
