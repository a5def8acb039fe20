"""The policy network FC - ReLU - GRU - FC with its derivatives in both directions.

The derivatives are written by hand: the last policy step of a batch needs both at the same θ, and one trace
serves both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from liir_common.types import EnvSpec, policy_shapes
from services.learner.algorithms import gru
from services.learner.algorithms.data import Data
from services.learner.algorithms.networks import relu_backward_, views


@dataclass(frozen=True)
class Trace:
    """A run of the network on the agents' rows of a batch."""

    inputs: Tensor
    """[R, O + A + n]"""
    x: Tensor
    """[R, H], what enters the GRU; its sign is the derivative of the ReLU that it left"""
    gru: gru.Trace
    logits: Tensor
    """[A, R]; this way round, because a softmax over few rows is many times faster than over few columns"""


class PolicyNetwork:
    """Pure functions of the flat parameters θ [P]."""

    head = "fc2"

    def __init__(self, spec: EnvSpec, hidden: int) -> None:
        self.shapes = policy_shapes(spec, hidden)

    def forward(self, theta: Tensor, data: Data) -> Trace:
        """Logits and all that the derivatives need."""
        p = views(theta, self.shapes)
        x = functional.linear(data.inputs, p["fc1.weight"], p["fc1.bias"]).relu_()
        bias_rz, bias_n = p["gru.bias_hh"].split_with_sizes([2 * x.shape[1], x.shape[1]])
        bias = torch.cat([bias_rz, torch.zeros_like(bias_n)]).add_(p["gru.bias_ih"])
        gates = functional.linear(x, p["gru.weight_ih"], bias)
        trace = gru.forward(gates, p["gru.weight_hh"], bias_n, data.sizes)
        logits = torch.addmm(p["fc2.bias"].unsqueeze(1), p["fc2.weight"], trace.h.t())
        return Trace(data.inputs, x, trace, logits)

    def backward(self, theta: Tensor, trace: Trace, grad_logits: Tensor) -> Tensor:
        """Gradient by θ [P] from that by the logits [A, R]."""
        p = views(theta, self.shapes)
        out = torch.empty_like(theta)
        grad = views(out, self.shapes)
        torch.mm(grad_logits, trace.gru.h, out=grad["fc2.weight"])
        torch.sum(grad_logits, 1, out=grad["fc2.bias"])
        grad_h = grad_logits.t() @ p["fc2.weight"]
        gates, weight_hh, bias_hh = gru.backward(trace.gru, p["gru.weight_hh"], grad_h)
        grad["gru.weight_hh"].copy_(weight_hh)
        grad["gru.bias_hh"].copy_(bias_hh)
        torch.mm(gates.t(), trace.x, out=grad["gru.weight_ih"])
        torch.sum(gates, 0, out=grad["gru.bias_ih"])
        grad_x = relu_backward_(gates @ p["gru.weight_ih"], trace.x)
        torch.mm(grad_x.t(), trace.inputs, out=grad["fc1.weight"])
        torch.sum(grad_x, 0, out=grad["fc1.bias"])
        return out

    def forward_derivative(self, theta: Tensor, trace: Trace, direction: Tensor) -> Tensor:
        """How the logits [A, R] change as θ moves along `direction` [P]."""
        p, d = views(theta, self.shapes), views(direction, self.shapes)
        x = relu_backward_(functional.linear(trace.inputs, d["fc1.weight"], d["fc1.bias"]), trace.x)
        inputs = functional.linear(trace.x, d["gru.weight_ih"], d["gru.bias_ih"])
        inputs.addmm_(x, p["gru.weight_ih"].t())
        recurrent = functional.linear(trace.gru.previous, d["gru.weight_hh"], d["gru.bias_hh"])
        h = gru.forward_derivative(trace.gru, p["gru.weight_hh"], inputs, recurrent)
        logits = torch.addmm(d["fc2.bias"].unsqueeze(1), d["fc2.weight"], trace.gru.h.t())
        return logits.addmm_(p["fc2.weight"], h.t())
