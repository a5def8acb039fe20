"""QMIX: the team's value is monotonic in every agent's (Rashid, Samvelyan, Schroeder, Farquhar, Foerster,
Whiteson, ICML 2018).

Each agent's best action is then a part of the team's best one, while the state decides how the values mix.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from liir_common.config import AlgorithmConfig
from liir_common.types import EnvSpec
from services.learner.algorithms.networks import views
from services.learner.algorithms.q_learning import QLearning


class MonotonicMixer:
    """Q_tot = |W_2(s)|ᵀ · elu(|W_1(s)|·q + b_1(s)) + b_2(s), the weights being networks of the state.

    W_1, W_2 and b_2 are FC - ReLU - FC, b_1 is one layer.
    """

    head = ""

    def __init__(self, spec: EnvSpec, width: int, hypernet_width: int) -> None:
        self._width = width
        self.shapes: dict[str, tuple[int, ...]] = {}
        for name, hidden, outputs in [
            ("w1", hypernet_width, spec.n_agents * width),
            ("w2", hypernet_width, width),
            ("b2", width, 1),
        ]:
            self._add(f"{name}_in", spec.state_dim, hidden)
            self._add(f"{name}_out", hidden, outputs)
        self._add("b1", spec.state_dim, width)

    def _add(self, layer: str, inputs: int, outputs: int) -> None:
        self.shapes |= {f"{layer}.weight": (outputs, inputs), f"{layer}.bias": (outputs,)}

    def __call__(self, flat: Tensor, q: Tensor, state: Tensor) -> Tensor:
        """[M, 1] of the agents' values [M, n] in the states [M, S]."""
        p = views(flat, self.shapes)

        def layer(name: str, x: Tensor) -> Tensor:
            return functional.linear(x, p[f"{name}.weight"], p[f"{name}.bias"])

        def two_layers(name: str) -> Tensor:
            return layer(f"{name}_out", layer(f"{name}_in", state).relu())

        w1 = two_layers("w1").abs().view(len(q), q.shape[1], self._width)
        w2 = two_layers("w2").abs()
        hidden = functional.elu((q.unsqueeze(-1) * w1).sum(1) + layer("b1", state))
        return (hidden * w2).sum(1, keepdim=True) + two_layers("b2")


class Qmix(QLearning):
    """Q networks mixed monotonically and fitted to the team's return."""

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        mixer = MonotonicMixer(spec, config.mixer_width, config.hypernet_width)
        super().__init__(spec, config, seed, device, dtype, mixer)
