"""A GRU over lives of unequal length, with its derivatives in both directions.

Rows are packed: all sequences' first steps, then all second steps, and so on, the longest sequence first
within each step, so that neither padding nor dead agents are computed. Gates are in torch's order r, z, n.

Around a trace the step h' = f(h, inputs) is linear in its tangents,

    ḣ' = z·ḣ + to_n·ġi_n + Σ_gates to_gates·ġh, with ġi added to ġh for the gates r and z,

where gi are the projected inputs and gh the recurrent sums. `backward` runs this recurrence towards the
past, `forward_derivative` towards the future.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


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


def forward(inputs: Tensor, weight: Tensor, bias_n: Tensor, sizes: list[int]) -> Trace:
    """Run from h = 0.

    Args:
        inputs: [R, 3H], projected inputs with all biases but gate n's recurrent one; overwritten
        weight: [3H, H], recurrent
        bias_n: [H], recurrent bias of gate n
        sizes: how many sequences have a step t; never grows, sums to R
    """
    width = weight.shape[1]
    # Gate n's input stays apart, for r multiplies its recurrent sum alone; one product adds all three sums.
    n = inputs[:, 2 * width :].clone()
    inputs[:, 2 * width :] = bias_n
    rz, recurrent_n = inputs[:, : 2 * width], inputs[:, 2 * width :]
    r, z = rz.chunk(2, 1)
    h_all, transposed = torch.empty_like(n), weight.t()
    h = inputs.new_zeros(sizes[0], width)
    in_steps = (x.split_with_sizes(sizes) for x in (inputs, rz, r, z, recurrent_n, n, h_all))
    for sums_t, rz_t, r_t, z_t, recurrent_t, n_t, h_t in zip(*in_steps, strict=True):
        h = h[: len(h_t)]
        sums_t.addmm_(h, transposed)
        rz_t.sigmoid_()
        n_t.addcmul_(r_t, recurrent_t).tanh_()
        h = torch.lerp(n_t, h, z_t, out=h_t)
    before = zip(h_all.split_with_sizes(sizes), sizes[1:], strict=False)
    previous = torch.cat([torch.zeros_like(h_all[: sizes[0]]), *(h_t[:size] for h_t, size in before)])
    to_n, to_gates = _linearise(previous, r, z, n, recurrent_n)
    return Trace(sizes, h_all, previous, z, to_n, to_gates)


def _linearise(
    previous: Tensor, r: Tensor, z: Tensor, n: Tensor, recurrent_n: Tensor
) -> tuple[Tensor, Tensor]:
    """to_n [R, H] and to_gates [R, 3, H]; x - x² is the sigmoid's derivative, 1 - n² that of tanh."""
    to_n = torch.addcmul(z.new_ones(()), n, n, value=-1).mul_(1 - z)
    to_gates = z.new_empty(len(z), 3, z.shape[1])
    torch.mul(torch.addcmul(r, r, r, value=-1).mul_(recurrent_n), to_n, out=to_gates[:, 0])
    torch.mul(torch.addcmul(z, z, z, value=-1), previous - n, out=to_gates[:, 1])
    torch.mul(to_n, r, out=to_gates[:, 2])
    return to_n, to_gates


def backward(trace: Trace, weight: Tensor, grad_h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients by `inputs` [R, 3H], `weight` [3H, H] and all recurrent biases [3H].

    `grad_h` [R, H], the gradient by the hidden states, is overwritten.
    """
    sizes, grad_gates = trace.sizes, torch.empty_like(trace.to_gates)
    gates = grad_gates.flatten(1)
    in_steps = (grad_h, grad_h.unsqueeze(1), trace.z, trace.to_gates, grad_gates, gates)
    h, h_1, z, to_gates, out, out_flat = (x.split_with_sizes(sizes) for x in in_steps)
    for t in range(len(sizes) - 1, 0, -1):
        torch.mul(h_1[t], to_gates[t], out=out[t])
        h[t - 1][: sizes[t]].addcmul_(h[t], z[t]).addmm_(out_flat[t], weight)
    torch.mul(h_1[0], to_gates[0], out=out[0])
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
    h_dots = (recurrent.view_as(trace.to_gates) * trace.to_gates).sum(1)
    h_dots.addcmul_(trace.to_n, inputs[:, 2 * width :])
    h_dot = h_dots.new_zeros(trace.sizes[0], width)
    in_steps = (x.split_with_sizes(trace.sizes) for x in (h_dots, trace.z, trace.to_gates))
    for h_dot_t, z_t, to_gates_t in zip(*in_steps, strict=True):
        h_dot = h_dot[: len(h_dot_t)]
        through_gates = (h_dot @ weight.t()).view_as(to_gates_t).mul_(to_gates_t).sum(1)
        h_dot = h_dot_t.addcmul_(z_t, h_dot).add_(through_gates)
    return h_dots
