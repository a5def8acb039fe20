"""The recurrences of `gru` compiled for float32 on the CPU; see `liir_common.rollout.dense` for the rules.

Sequences do not touch each other, so every thread takes some of them through all steps without waiting for
the others. How they are shared out changes no byte of the result.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from liir_common.rollout.dense import add_product, sigmoid, tanh

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "fastmath": {"contract"},
    "error_model": "numpy",  # Python's check for division by zero would keep tanh from vectorising.
}
_ZERO, _ONE = np.float32(0), np.float32(1)


def forward(
    inputs: Tensor, weight: Tensor, bias_n: Tensor, sizes: list[int]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As `gru_eager.forward`; `inputs` stays as it is."""
    rows, width = len(inputs), weight.shape[1]
    h, previous, z, to_n = (inputs.new_empty(rows, width) for _ in range(4))
    to_gates = inputs.new_empty(rows, 3, width)
    _share_out(_forward, sizes, inputs, weight.t().contiguous(), bias_n, h, previous, z, to_n, to_gates)
    return h, previous, z, to_n, to_gates


def backward(
    sizes: list[int], z: Tensor, to_gates: Tensor, weight: Tensor, grad_h: Tensor, grad_gates: Tensor
) -> None:
    """As `gru_eager.backward`."""
    _share_out(_backward, sizes, z, to_gates, weight.clone(), grad_h, grad_gates)


def forward_derivative(sizes: list[int], z: Tensor, to_gates: Tensor, weight: Tensor, h_dot: Tensor) -> None:
    """As `gru_eager.forward_derivative`."""
    _share_out(_forward_derivative, sizes, z, to_gates, weight.t().contiguous(), h_dot)


def _share_out(kernel: Callable[..., None], sizes: list[int], *tensors: Tensor) -> None:
    """Run `kernel` on all sequences with as many threads as torch has, each with its share of the rows."""
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    arrays = [tensor.flatten(1).numpy() if tensor.ndim > 1 else tensor.numpy() for tensor in tensors]
    firsts = _shares(sizes, torch.get_num_threads())
    parts = [(offsets, first, end, *arrays) for first, end in itertools.pairwise(firsts)]
    others = [_threads().submit(kernel, *part) for part in parts[1:]]
    kernel(*parts[0])
    for other in others:
        other.result()


def _shares(sizes: list[int], count: int) -> list[int]:
    """The first sequence of each share and the end of the last: equal numbers of rows, as far as it goes."""
    lengths = (np.asarray(sizes)[:, None] > np.arange(sizes[0])).sum(0)
    done = np.cumsum(lengths)
    cuts = np.searchsorted(done, done[-1] * np.arange(1, count) / count) + 1
    return sorted({0, *cuts.tolist(), sizes[0]})


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="gru")


@njit(**_OPTIONS)
def _rows(offsets, t, first, end):
    """Rows of step t that the sequences from `first` until `end` have, and the first of those at t - 1."""
    begin, size = offsets[t] + first, offsets[t + 1] - offsets[t]
    return begin, begin + min(end, size) - first, offsets[max(t - 1, 0)] + first


@njit(inline="always")
def _gate(row, gate, width):
    """The part of a row [3H] that belongs to a gate: 0 is r, 1 is z, 2 is n."""
    return row[gate * width : (gate + 1) * width]


@njit(**_OPTIONS)
def _forward(offsets, first, end, inputs, weight, bias_n, h, previous, z, to_n, to_gates):
    sums = np.empty((end - first, 3 * h.shape[1]), np.float32)
    for t in range(len(offsets) - 1):
        begin, stop, before = _rows(offsets, t, first, end)
        for k in range(begin, stop):
            if t > 0:
                previous[k] = h[before + k - begin]
            else:
                previous[k] = _ZERO
            sums[k - begin] = inputs[k]
            sums[k - begin, 2 * h.shape[1] :] = bias_n
        if t > 0 and begin < stop:
            add_product(previous[begin:stop], weight, sums[: stop - begin])
        for k in range(begin, stop):
            _step(sums[k - begin], inputs[k], previous[k], h[k], z[k], to_n[k], to_gates[k])


@njit(**_OPTIONS)
def _step(sums, inputs, previous, h, z, to_n, to_gates):
    """A row of the GRU and of its linearisation; x - x² is the sigmoid's derivative, 1 - n² that of tanh."""
    width = len(h)
    r, sum_z, sum_n = _gate(sums, 0, width), _gate(sums, 1, width), _gate(sums, 2, width)
    to_r, to_z, to_sum_n = _gate(to_gates, 0, width), _gate(to_gates, 1, width), _gate(to_gates, 2, width)
    input_n, n = _gate(inputs, 2, width), h
    for j in range(width):
        r[j] = sigmoid(r[j])
    for j in range(width):
        z[j] = sigmoid(sum_z[j])
    for j in range(width):
        n[j] = tanh(input_n[j] + r[j] * sum_n[j])
    for j in range(width):
        to_n[j] = (_ONE - n[j] * n[j]) * (_ONE - z[j])
    for j in range(width):
        to_r[j] = (r[j] - r[j] * r[j]) * sum_n[j] * to_n[j]
    for j in range(width):
        to_z[j] = (z[j] - z[j] * z[j]) * (previous[j] - n[j])
    for j in range(width):
        to_sum_n[j] = to_n[j] * r[j]
    for j in range(width):
        h[j] = n[j] + z[j] * (previous[j] - n[j])


@njit(**_OPTIONS)
def _backward(offsets, first, end, z, to_gates, weight, grad_h, grad_gates):
    width = weight.shape[1]
    for t in range(len(offsets) - 2, -1, -1):
        begin, stop, before = _rows(offsets, t, first, end)
        for k in range(begin, stop):
            by_h, z_k = grad_h[k], z[k]
            for gate in range(3):
                by_gate, to_gate = _gate(grad_gates[k], gate, width), _gate(to_gates[k], gate, width)
                for j in range(width):
                    by_gate[j] = by_h[j] * to_gate[j]
            if t > 0:
                by_previous = grad_h[before + k - begin]
                for j in range(width):
                    by_previous[j] += by_h[j] * z_k[j]
        if t > 0 and begin < stop:
            add_product(grad_gates[begin:stop], weight, grad_h[before : before + stop - begin])


@njit(**_OPTIONS)
def _forward_derivative(offsets, first, end, z, to_gates, weight, h_dot):
    width = weight.shape[0]
    sums = np.empty((end - first, 3 * width), np.float32)
    for t in range(1, len(offsets) - 1):
        begin, stop, before = _rows(offsets, t, first, end)
        if begin >= stop:
            break
        sums[: stop - begin] = _ZERO
        add_product(h_dot[before : before + stop - begin], weight, sums[: stop - begin])
        for k in range(begin, stop):
            out, last, z_k = h_dot[k], h_dot[before + k - begin], z[k]
            for j in range(width):
                out[j] += z_k[j] * last[j]
            for gate in range(3):
                through, to_gate = _gate(sums[k - begin], gate, width), _gate(to_gates[k], gate, width)
                for j in range(width):
                    out[j] += through[j] * to_gate[j]
