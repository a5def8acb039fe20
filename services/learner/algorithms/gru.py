"""A GRU over lives of unequal length, with its derivatives in both directions.

Rows are packed: all sequences' first steps, then all second steps, and so on, the longest sequence first
within each step, so that neither padding nor dead agents are computed. Gates are in torch's order r, z, n.

Around a trace the step h' = f(h, inputs) is linear in its tangents,

    ḣ' = z·ḣ + to_n·ġi_n + Σ_gates to_gates·ġh, with ġi added to ġh for the gates r and z,

where gi are the projected inputs and gh the recurrent sums. `backward` runs this recurrence towards the
past, `forward_derivative` towards the future.

What goes from step to step is compiled for float32 on the CPU (`gru_compiled`), where dispatching small
operations cost more than their arithmetic, and made of torch's operations elsewhere (`gru_eager`).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor

from services.learner.algorithms import gru_compiled, gru_eager


@dataclass(frozen=True)
class Trace:
    """A run of the GRU and its linearisation."""

    sizes: list[int]
    h: Tensor
    """[R, H], hidden states"""
    previous: Tensor
    """[R, H], the hidden states they came from"""
    z: Tensor
    """[R, H]"""
    to_n: Tensor
    """[R, H]"""
    to_gates: Tensor
    """[R, 3, H]"""


def _recurrences(tensor: Tensor) -> ModuleType:
    compiled = tensor.dtype == torch.float32 and tensor.device.type == "cpu"
    return gru_compiled if compiled else gru_eager


def forward(inputs: Tensor, weight: Tensor, bias_n: Tensor, sizes: list[int]) -> Trace:
    """Run from h = 0.

    Args:
        inputs: [R, 3H], projected inputs with all biases but gate n's recurrent one; overwritten
        weight: [3H, H], recurrent
        bias_n: [H], recurrent bias of gate n
        sizes: how many sequences have a step t; never grows, sums to R
    """
    return Trace(sizes, *_recurrences(inputs).forward(inputs, weight, bias_n, sizes))


def backward(trace: Trace, weight: Tensor, grad_h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients by `inputs` [R, 3H], `weight` [3H, H] and all recurrent biases [3H].

    `grad_h` [R, H], the gradient by the hidden states, is overwritten.
    """
    grad_gates = torch.empty_like(trace.to_gates)
    _recurrences(grad_h).backward(trace.sizes, trace.z, trace.to_gates, weight, grad_h, grad_gates)
    gates = grad_gates.flatten(1)
    grad_weight, grad_bias = gates.t() @ trace.previous, gates.sum(0)
    # Gate n's input is not multiplied with r, as its recurrent sum is; the other gates' gradients agree.
    torch.mul(grad_h, trace.to_n, out=grad_gates[:, 2])
    return gates, grad_weight, grad_bias


def forward_derivative(trace: Trace, weight: Tensor, inputs: Tensor, recurrent: Tensor) -> Tensor:
    """ḣ [R, H] for tangents of the projected inputs and, at constant h, of the recurrent sums, both [R, 3H].

    `recurrent` is overwritten.
    """
    width = weight.shape[1]
    recurrent[:, : 2 * width] += inputs[:, : 2 * width]
    h_dot = (recurrent.view_as(trace.to_gates) * trace.to_gates).sum(1)
    h_dot.addcmul_(trace.to_n, inputs[:, 2 * width :])
    _recurrences(h_dot).forward_derivative(trace.sizes, trace.z, trace.to_gates, weight, h_dot)
    return h_dot
