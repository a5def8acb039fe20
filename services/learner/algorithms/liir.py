"""LIIR: learning individual intrinsic reward (Du, Han, Fang, Dai, Liu, Tao, NeurIPS 2019).

The lower level improves the policy θ for the proxy return, which adds an intrinsic to the extrinsic reward;
the upper level improves the intrinsic reward η by what the policy step that it caused does to the
extrinsic return. Equation numbers are the paper's. It shares parameters among the agents, so the sum
over agents sits inside v = ∂J_ex/∂θ': what one agent does reaches every other agent's r_in.

With c = ⟨ũ, ∇log π(u_i|τ_i)⟩ along ũ = α·P'(g)ᵀ·v, the chain rule of Eq. (7) collapses to the gradient of the
scalar S(η) = (1/N) Σ w · c · A_proxy(η): one forward-mode derivative of the policy and one backward pass
through r_in, exact for every form of advantage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from liir_common import seeds
from liir_common.config import AlgorithmConfig
from liir_common.types import Array, Batch, EnvSpec, Weights
from services.learner.algorithms.actor_critic import ETA, PHI, ActorCritic
from services.learner.algorithms.critic import Critic
from services.learner.algorithms.data import Data
from services.learner.algorithms.metrics import to_floats
from services.learner.algorithms.networks import (
    AgentValue,
    IntrinsicReward,
    StateValue,
    arrays,
    coma_critic_size,
    count,
    fit_width,
    initial,
)
from services.learner.algorithms.optim import Optimizer, Step
from services.learner.algorithms.policy import Evaluation
from services.learner.algorithms.state import prefixed, snapshot


@dataclass(frozen=True)
class Inner:
    """The last policy step on a batch, with all that its gradient was made from."""

    batch: Batch
    data: Data
    value: Tensor
    """V_φ [B, T+1, n]"""
    target: Tensor
    """V_φ [B, T+1, n] that returns are built from"""
    eta: Tensor
    """Leaf of the graph of r_in; η stays where it is until this step has been judged"""
    r_in: Tensor
    """[R], with its graph"""
    before: Evaluation
    """The policy before the step"""
    step: Step


class Liir(ActorCritic):
    """Algorithm 1: policy θ, intrinsic reward η, proxy value φ and extrinsic value ϕ."""

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        def networks(width: int) -> tuple[IntrinsicReward, AgentValue, StateValue]:
            reward = IntrinsicReward(spec, width, config.r_in_bound)
            return reward, AgentValue(spec, width), StateValue(spec, width)

        width = fit_width(coma_critic_size(spec), lambda w: sum(count(net.shapes) for net in networks(w)))
        self._reward, phi, varphi = networks(width)
        super().__init__(spec, config, seed, device, dtype, varphi)
        self._phi = Critic(phi, config, seeds.derive(seed, PHI), device, dtype)
        gain, orthogonal = config.r_in_gain, config.orthogonal_init
        self._eta = initial(self._reward, gain, orthogonal, seeds.derive(seed, ETA), device, dtype)
        self._eta_optimizer = Optimizer(self._eta, config.eta_optimizer)
        self._learns_reward = config.lambda_ > 0 and not config.freeze_eta
        self._pending: Inner | None = None

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """One iteration of Algorithm 1 on `batch`; returns its figures. `policy_ready` is as in `Algorithm`.

        Step 5 of the algorithm judges θ' on the samples that made it or, one batch later, on fresh ones.

        Raises:
            ValueError: the batch does not fit (see `check`); nothing has changed then.
            FloatingPointError: learning has diverged.
        """
        data = self._prepare(batch)
        value, target = self._varphi.values(data, data.state)
        extrinsic_return = self._return(data, data.reward, target)
        a_ex = self._advantage(data, extrinsic_return, value)
        metrics: dict[str, Tensor] = {}

        if self._pending:
            metrics |= self._improve_reward(self._pending, data, a_ex)
        inner, proxy_return, figures = self._improve_policy(batch, data)
        self._announce(policy_ready)
        metrics |= figures
        if self._learns_reward and self._config.outer_samples == "fresh":
            self._pending = inner
        elif self._learns_reward:
            metrics |= self._improve_reward(inner, data, a_ex)

        metrics |= self._phi.fit(data, data.state, proxy_return, "proxy_value")
        metrics |= self._varphi.fit(data, data.state, extrinsic_return, "value")
        return to_floats(metrics)

    def _improve_policy(self, batch: Batch, data: Data) -> tuple[Inner, Tensor, dict[str, Tensor]]:
        """θ → θ' on the proxy advantage; returns the last step, the proxy returns and figures."""
        value, target = self._phi.values(data, data.state)
        eta, r_in = self._intrinsic_reward(data)
        proxy_return = self._proxy_return(data, r_in.detach(), target)
        a_proxy = self._advantage(data, proxy_return, value)
        before, step, metrics = self._policy.advance(data, a_proxy)
        metrics |= self._reward_figures(data, r_in.detach())
        return Inner(batch, data, value, target, eta, r_in, before, step), proxy_return, metrics

    def _improve_reward(self, inner: Inner, judged: Data, a_ex: Tensor) -> dict[str, Tensor]:
        """η ascends ∇η J_ex, the extrinsic return at θ' being judged by the advantage `a_ex` of `judged`."""
        data = inner.data
        v = self._policy.extrinsic_gradient(judged, a_ex)  # Eq. (8)
        c = self._policy.derivative(inner.before, data, inner.step.transpose(v))

        proxy_return = self._proxy_return(data, inner.r_in, inner.target)
        a_proxy = self._advantage(data, proxy_return, inner.value)
        # Eq. (9): g is linear in the weights of ∇log π, and those in A_proxy.
        s = data.mean(c * self._policy.score_weight(inner.before, data, a_proxy))
        (gradient,) = torch.autograd.grad(s, inner.eta)  # Eq. (7)
        self._eta_optimizer.ascend(gradient)
        return {
            "eta_gradient_norm": torch.linalg.vector_norm(gradient),
            "outer_gradient_norm": torch.linalg.vector_norm(v),
            "credit_std": (data.mean(c**2) - data.mean(c) ** 2).clamp_min(0).sqrt(),
        }

    def _intrinsic_reward(self, data: Data) -> tuple[Tensor, Tensor]:
        """A leaf η and r_in(η; s_i, u_i) [R] of the living; the dead get none."""
        eta = self._eta.detach().requires_grad_(self._learns_reward)
        return eta, data.weight * self._reward(eta, data.local).gather(1, data.actions.t()).squeeze(1)

    def _proxy_return(self, data: Data, r_in: Tensor, target: Tensor) -> Tensor:
        r_proxy = data.reward + self._config.lambda_ * data.lives(r_in)  # Eq. (2)
        return self._return(data, r_proxy, target)

    def _reward_figures(self, data: Data, r_in: Tensor) -> dict[str, Tensor]:
        """Sizes of the rewards; the ratio is left out of batches without any extrinsic reward."""
        intrinsic = self._config.lambda_ * data.mean(r_in.abs())
        extrinsic = data.reward.abs().sum() / data.filled.sum()
        figures = {"intrinsic_reward": intrinsic, "extrinsic_reward": extrinsic}
        return figures | ({"reward_ratio": intrinsic / extrinsic} if extrinsic > 0 else {})

    def intrinsic(self) -> dict[str, NDArray[np.float32]]:
        """float32 copies of η: FC - ReLU - FC - ReLU - FC on (observation, one-hot agent id), one output per
        action, squashed to bound · tanh(output / bound)."""
        return arrays(self._eta, self._reward.shapes)

    def parameter_counts(self) -> dict[str, int]:
        """Parameters of each network and the budget of all but θ."""
        return super().parameter_counts() | {"eta": self._eta.numel(), "phi": self._phi.size}

    def state(self) -> dict[str, Array]:
        """As the base class, with the pending step of fresh outer samples."""
        return super().state() | (
            snapshot(prefixed("pending", _pack(self._pending))) if self._pending else {}
        )

    def load_state(self, state: Mapping[str, Array]) -> None:
        """As the base class, with the pending step of fresh outer samples."""
        fresh = self._config.outer_samples == "fresh"
        pending = {k: v for k, v in state.items() if fresh and k.startswith("pending.")}
        inner = self._unpack({k.removeprefix("pending."): v for k, v in pending.items()}) if pending else None
        super().load_state({k: v for k, v in state.items() if k not in pending})
        if inner:  # Only now is η the one that its r_in came from.
            eta, r_in = self._intrinsic_reward(inner.data)
            inner = replace(inner, eta=eta, r_in=r_in)
        self._pending = inner

    def _tensors(self) -> dict[str, Tensor]:
        eta = {"parameters": self._eta} | prefixed("optimizer", self._eta_optimizer.tensors())
        return super()._tensors() | prefixed("eta", eta) | prefixed("phi", self._phi.tensors())

    def _unpack(self, pending: Mapping[str, Array]) -> Inner:
        if pending.keys() != _PENDING:
            raise ValueError(f"a pending step wants {sorted(_PENDING)}, got {sorted(pending)}")
        packed = {name: pending[f"batch.{name}"] for name in _BATCH}
        named: dict[str, Any] = {
            name: value if value.ndim else value.item() for name, value in packed.items()
        }
        batch = Batch(**named)
        value, target, theta, gradient, diagonal = (
            torch.tensor(pending[name], device=self._device) for name in _STEP
        )
        step = Step(gradient, diagonal, self._config.policy_optimizer.clip)
        data = self._prepare(batch)
        eta, r_in = self._intrinsic_reward(data)
        return Inner(batch, data, value, target, eta, r_in, self._policy.evaluate(theta, data), step)


_BATCH = [field.name for field in fields(Batch)]
_STEP = ["value", "target", "theta", "gradient", "diagonal"]
_PENDING = {*_STEP, *(f"batch.{name}" for name in _BATCH)}


def _pack(inner: Inner) -> dict[str, Tensor]:
    batch = {f"batch.{name}": torch.from_numpy(np.asarray(getattr(inner.batch, name))) for name in _BATCH}
    step = [inner.value, inner.target, inner.before.theta, inner.step.gradient, inner.step.diagonal]
    return batch | dict(zip(_STEP, step, strict=True))
