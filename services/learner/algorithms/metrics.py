"""Turning figures on the device into plain numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor


def to_floats(metrics: Mapping[str, Tensor]) -> dict[str, float]:
    """Plain numbers, fetched from the device in one go.

    Raises:
        FloatingPointError: one of them is infinite or not a number, which means that learning has diverged.
    """
    values = torch.stack([value.double() for value in metrics.values()]).tolist()
    out: dict[str, float] = dict(zip(metrics, values, strict=True))
    wrong = {name: value for name, value in out.items() if not math.isfinite(value)}
    if wrong:
        raise FloatingPointError(f"learning has diverged, not finite: {wrong}")
    return out
