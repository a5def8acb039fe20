"""A GRU over lives of unequal length, with hand-written derivatives in both directions.

Rows are packed: all sequences' first steps, then all second steps, and so on, the longest sequence
first within each step, so that neither padding nor dead agents are computed. With the gates saved, the
step h' = f(h, gates) is linear in its tangents (ḣ, ġi, ġh); `_linearise` has the coefficients, `backward`
runs the linear recurrence towards the past, `jvp` towards the future.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def gru(inputs: Tensor, weight_hh: Tensor, bias_hh: Tensor, sizes: list[int]) -> Tensor:
    """Hidden states [R, H] from projected inputs W_ih·x + b_ih [R, 3H] (gates r, z, n), starting at h = 0.

    `sizes[t]` is the number of sequences that have a step t; it never grows, and R = Σ sizes.
    """
    return _Gru.apply(inputs, weight_hh, bias_hh, sizes)  # type: ignore[no-any-return, no-untyped-call]


class _Gru(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, sizes: list[int]) -> Tensor:
        hidden = weight.shape[1]
        h_all = inputs.new_empty(len(inputs), hidden)
        gates = torch.empty_like(inputs)
        recurrent = torch.empty_like(inputs)
        h = inputs.new_zeros(sizes[0], hidden)
        transposed = weight.t()
        steps = zip(
            sizes,
            inputs[:, : 2 * hidden].split_with_sizes(sizes),
            inputs[:, 2 * hidden :].split_with_sizes(sizes),
            recurrent.split_with_sizes(sizes),
            recurrent[:, : 2 * hidden].split_with_sizes(sizes),
            recurrent[:, 2 * hidden :].split_with_sizes(sizes),
            gates[:, : 2 * hidden].split_with_sizes(sizes),
            gates[:, :hidden].split_with_sizes(sizes),
            gates[:, hidden : 2 * hidden].split_with_sizes(sizes),
            gates[:, 2 * hidden :].split_with_sizes(sizes),
            h_all.split_with_sizes(sizes),
            strict=True,
        )
        for size, in_rz, in_n, rec, rec_rz, rec_n, rz, r, z, n, out in steps:
            h = h[:size]
            torch.addmm(bias, h, transposed, out=rec)
            torch.add(in_rz, rec_rz, out=rz).sigmoid_()
            torch.addcmul(in_n, r, rec_n, out=n).tanh_()
            h = torch.lerp(n, h, z, out=out)
        ctx.saved = (weight, sizes, h_all, gates, recurrent)
        return h_all

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        weight, sizes, h_all, gates, recurrent = ctx.saved
        previous = _previous(h_all, sizes)
        z, to_n, to_gates = _linearise(previous, gates, recurrent)
        grad = grad.clone()
        grad_rec = torch.empty_like(to_gates)
        carried = grad.new_zeros(0, weight.shape[1])
        steps = zip(
            grad.split_with_sizes(sizes),
            z.split_with_sizes(sizes),
            to_gates.split_with_sizes(sizes),
            grad_rec.split_with_sizes(sizes),
            strict=True,
        )
        for g, z_t, to_gates_t, out in reversed(list(steps)):
            g[: len(carried)] += carried
            torch.mul(g.unsqueeze(1), to_gates_t, out=out)
            carried = torch.addmm(g * z_t, out.flatten(1), weight)
        grad_in = torch.cat([grad_rec[:, :2].flatten(1), grad * to_n], 1)
        grad_rec = grad_rec.flatten(1)
        return grad_in, grad_rec.t() @ previous, grad_rec.sum(0), None

    @staticmethod
    def jvp(ctx: Any, inputs: Tensor, weight_dot: Tensor, bias_dot: Tensor, _: None) -> Tensor:
        weight, sizes, h_all, gates, recurrent = ctx.saved
        hidden = weight.shape[1]
        previous = _previous(h_all, sizes)
        z, to_n, to_gates = _linearise(previous, gates, recurrent)
        own = torch.addmm(bias_dot, previous, weight_dot.t())
        own[:, : 2 * hidden] += inputs[:, : 2 * hidden]
        h_dots = (own.view_as(to_gates) * to_gates).sum(1).addcmul_(to_n, inputs[:, 2 * hidden :])
        h_dot = h_dots.new_zeros(sizes[0], hidden)
        transposed = weight.t()
        steps = zip(
            h_dots.split_with_sizes(sizes),
            z.split_with_sizes(sizes),
            to_gates.split_with_sizes(sizes),
            strict=True,
        )
        for out, z_t, to_gates_t in steps:
            h_dot = h_dot[: len(out)]
            through = (h_dot @ transposed).view_as(to_gates_t).mul_(to_gates_t).sum(1)
            h_dot = out.add_(through).addcmul_(z_t, h_dot)
        return h_dots


def _previous(h_all: Tensor, sizes: list[int]) -> Tensor:
    """The hidden state that each row started from."""
    steps = zip(h_all.split_with_sizes(sizes), sizes[1:], strict=False)
    return torch.cat([torch.zeros_like(h_all[: sizes[0]]), *(h[:size] for h, size in steps)])


def _linearise(previous: Tensor, gates: Tensor, recurrent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coefficients of ḣ' = z·ḣ + to_n·ġi_n + Σ_gates to_gates·(ġh, plus ġi for r and z)."""
    r, z, n = gates.chunk(3, 1)
    to_n = (1 - z) * (1 - n * n)
    to_r = to_n * recurrent[:, -r.shape[1] :] * r * (1 - r)
    to_z = (previous - n) * z * (1 - z)
    return z, to_n, torch.stack([to_r, to_z, to_n * r], 1)
