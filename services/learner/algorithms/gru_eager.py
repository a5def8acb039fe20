"""The recurrences of `gru` in torch's operations, for any device and precision."""

from __future__ import annotations

import torch
from torch import Tensor


def forward(
    inputs: Tensor, weight: Tensor, bias_n: Tensor, sizes: list[int]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """h, previous, z, to_n [R, H] and to_gates [R, 3, H] of a trace, for the arguments of `gru.forward`."""
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
    return h_all, previous, z, *_linearise(previous, r, z, n, recurrent_n)


def _linearise(
    previous: Tensor, r: Tensor, z: Tensor, n: Tensor, recurrent_n: Tensor
) -> tuple[Tensor, Tensor]:
    """to_n [R, H] and to_gates [R, 3, H]; x - x² is the sigmoid's derivative, 1 - n² that of tanh."""
    to_n = (1 - n**2) * (1 - z)
    to_gates = torch.stack([(r - r**2) * recurrent_n * to_n, (z - z**2) * (previous - n), to_n * r], 1)
    return to_n, to_gates


def backward(
    sizes: list[int], z: Tensor, to_gates: Tensor, weight: Tensor, grad_h: Tensor, grad_gates: Tensor
) -> None:
    """Write the gradient by the recurrent sums into `grad_gates` [R, 3, H].

    `grad_h` [R, H] becomes the gradient by each hidden state through all that follows.
    """
    in_steps = (grad_h, grad_h.unsqueeze(1), z, to_gates, grad_gates, grad_gates.flatten(1))
    h, h_1, z_, to, out, out_flat = (x.split_with_sizes(sizes) for x in in_steps)
    for t in range(len(sizes) - 1, 0, -1):
        torch.mul(h_1[t], to[t], out=out[t])
        h[t - 1][: sizes[t]].addcmul_(h[t], z_[t]).addmm_(out_flat[t], weight)
    torch.mul(h_1[0], to[0], out=out[0])


def forward_derivative(sizes: list[int], z: Tensor, to_gates: Tensor, weight: Tensor, h_dot: Tensor) -> None:
    """Add what comes through the hidden state before to `h_dot` [R, H], which holds each step's own part."""
    before = h_dot.new_zeros(sizes[0], weight.shape[1])
    in_steps = (x.split_with_sizes(sizes) for x in (h_dot, z, to_gates))
    for h_dot_t, z_t, to_gates_t in zip(*in_steps, strict=True):
        before = before[: len(h_dot_t)]
        through_gates = (before @ weight.t()).view_as(to_gates_t).mul_(to_gates_t).sum(1)
        before = h_dot_t.addcmul_(z_t, before).add_(through_gates)
