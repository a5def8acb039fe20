"""The networks as pure functions of one flat parameter vector and their input.

Flat vectors make an optimiser a handful of vector operations, and a direction in parameter space, which
the meta-gradient needs, an ordinary tensor.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from liir_common.types import EnvSpec

Shapes = Mapping[str, tuple[int, ...]]


def count(shapes: Shapes) -> int:
    """Number of parameters."""
    return sum(math.prod(shape) for shape in shapes.values())


def views(flat: Tensor, shapes: Shapes) -> dict[str, Tensor]:
    """The parameters inside `flat` [count(shapes)], by name."""
    parts = flat.split_with_sizes([math.prod(shape) for shape in shapes.values()])
    return {name: part.view(shape) for part, (name, shape) in zip(parts, shapes.items(), strict=True)}


def arrays(flat: Tensor, shapes: Shapes) -> dict[str, NDArray[np.float32]]:
    """float32 copies of the parameters inside `flat`, by name."""
    return {name: view.float().cpu().numpy().copy() for name, view in views(flat, shapes).items()}


class Network(Protocol):
    """What all networks have; each is called with its flat parameters and its inputs."""

    head: str
    """Name of the last layer"""

    @property
    def shapes(self) -> Shapes:
        """Names and shapes of the parameters, in the order of the flat vector."""


def initial(
    network: Network, head_gain: float, orthogonal: bool, seed: int, device: torch.device, dtype: torch.dtype
) -> Tensor:
    """Fresh flat parameters; the weights of the last layer are scaled by `head_gain`.

    Orthogonal (Saxe et al., 2014): gain √2 before a ReLU, biases zero. Otherwise uniform within
    ± 1 / √(inputs of the unit), a head's bias scaled like its weights.
    """
    generator = torch.Generator().manual_seed(seed)
    flat = torch.zeros(count(network.shapes), dtype=dtype)
    for name, parameter in views(flat, network.shapes).items():
        layer = name.split(".")[0]
        if orthogonal and "weight" in name:
            gain = {network.head: head_gain, "gru": 1.0}.get(layer, math.sqrt(2))
            torch.nn.init.orthogonal_(parameter, gain, generator=generator)
        elif not orthogonal:
            bound = 1 / math.sqrt(network.shapes[name.replace("bias", "weight")][1])
            bound *= head_gain if layer == network.head else 1.0
            parameter.uniform_(-bound, bound, generator=generator)
    return flat.to(device)


class Mlp:
    """FC - ReLU - FC - ReLU - FC."""

    head = "fc3"

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        sizes = [inputs, hidden, hidden, outputs]
        self.shapes: dict[str, tuple[int, ...]] = {}
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes), 1):
            self.shapes |= {f"fc{layer}.weight": (n_out, n_in), f"fc{layer}.bias": (n_out,)}

    def __call__(self, flat: Tensor, x: Tensor) -> Tensor:
        """Outputs [..., outputs] for inputs [..., inputs]."""
        w1, b1, *above = views(flat, self.shapes).values()
        return _above(functional.linear(x, w1, b1), *above)


class StateValue(Mlp):
    """V_ϕ(s), which sees nothing but the state: values [M, 1] of states [M, S]."""

    def __init__(self, spec: EnvSpec, hidden: int) -> None:
        super().__init__(spec.state_dim, hidden, 1)


class AgentValue(Mlp):
    """V_φ(s, i): one value per agent, dead or alive, from the state and the agent's id."""

    def __init__(self, spec: EnvSpec, hidden: int) -> None:
        super().__init__(spec.state_dim + spec.n_agents, hidden, 1)

    def __call__(self, flat: Tensor, x: Tensor) -> Tensor:
        """Values [M, n] of states [M, S]."""
        w1, b1, *above = views(flat, self.shapes).values()
        of_state, of_id = w1.split_with_sizes([x.shape[1], w1.shape[1] - x.shape[1]], 1)
        # The state's part of the first layer is the same for all agents of a step.
        first = functional.linear(x, of_state, b1).unsqueeze(1) + of_id.t().contiguous()
        return _above(first, *above).squeeze(-1)


class LocalValue(Mlp):
    """V(o_i, i): one value per agent, dead or alive, from its own observation and id."""

    def __init__(self, spec: EnvSpec, hidden: int) -> None:
        super().__init__(spec.obs_dim + spec.n_agents, hidden, 1)

    def __call__(self, flat: Tensor, x: Tensor) -> Tensor:
        """Values [M, n] of observations [M, n, O]."""
        ids = torch.eye(x.shape[1], dtype=x.dtype, device=x.device).expand(len(x), -1, -1)
        return super().__call__(flat, torch.cat([x, ids], -1)).squeeze(-1)


class IntrinsicReward(Mlp):
    """r_in(η; s_i, u_i) for every action, squashed to ± bound."""

    def __init__(self, spec: EnvSpec, hidden: int, bound: float) -> None:
        super().__init__(spec.obs_dim + spec.n_agents, hidden, spec.n_actions)
        self._bound = bound

    def __call__(self, flat: Tensor, x: Tensor) -> Tensor:
        """[R, A] for inputs (observation, agent id) [R, O + n]."""
        return self._bound * torch.tanh(super().__call__(flat, x) / self._bound)


class CounterfactualValue(Mlp):
    """COMA's critic Q_i(s, u_-i, ·), 128 - 128: all of an agent's actions at once, the others' being given.

    It sees the state, the agent's observation, all agents' actions but its own, all last actions, and its id.
    """

    def __init__(self, spec: EnvSpec) -> None:
        inputs = spec.state_dim + spec.obs_dim + spec.n_agents * (2 * spec.n_actions + 1)
        super().__init__(inputs, 128, spec.n_actions)


def relu_backward_(grad: Tensor, out: Tensor) -> Tensor:
    """The gradient by what entered a ReLU, in place of `grad`, that by its output `out`."""
    torch.ops.aten.threshold_backward.grad_input(grad, out, 0, grad_input=grad)
    return grad


class _Above(torch.autograd.Function):
    """The layers above the first, from its outputs [M, H] before the ReLU; written out because autograd's
    own ReLUs cost as much as the matrix products."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, w2: Tensor, b2: Tensor, w3: Tensor, b3: Tensor) -> Tensor:
        h1 = first.relu()
        h2 = functional.linear(h1, w2, b2).relu_()
        ctx.save_for_backward(h1, h2, w2, w3)
        return functional.linear(h2, w3, b3)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        h1, h2, w2, w3 = ctx.saved_tensors
        by_h2 = relu_backward_(grad @ w3, h2)
        by_h1 = relu_backward_(by_h2 @ w2, h1)
        return by_h1, by_h2.t() @ h1, by_h2.sum(0), grad.t() @ h2, grad.sum(0)


_apply: Callable[..., Tensor] = _Above.apply


def _above(first: Tensor, *parameters: Tensor) -> Tensor:
    """Outputs [..., outputs] of the network whose first layer gave `first` [..., H]."""
    return _apply(first.flatten(0, -2), *parameters).view(*first.shape[:-1], -1)


def coma_critic_size(spec: EnvSpec) -> int:
    """Parameters of COMA's critic, the budget of everything beside the policy (section 5.2.1)."""
    return count(CounterfactualValue(spec).shapes)


def fit_width(budget: int, size: Callable[[int], int]) -> int:
    """The width of hidden layers whose `size` in parameters comes closest to `budget`."""
    width = 1
    while size(width + 1) <= budget:
        width += 1
    return min(width, width + 1, key=lambda w: abs(size(w) - budget))
