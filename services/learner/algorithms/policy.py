"""The shared policy of all agents: its probabilities, its gradient steps and their linearisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from liir_common.config import AlgorithmConfig
from liir_common.types import EnvSpec
from services.learner.algorithms.data import Data
from services.learner.algorithms.networks import arrays, initial
from services.learner.algorithms.optim import Optimizer, Step
from services.learner.algorithms.policy_network import PolicyNetwork, Trace
from services.learner.algorithms.state import prefixed

# Distance that the central difference moves θ, as a share of its norm: float32 rounding and curvature
# balance there.
_DIFFERENCE = 1e-3


@dataclass(frozen=True)
class Evaluation:
    """The policy π = (1 - ε)·softmax + ε / available actions at one θ on the agents' rows of a batch."""

    theta: Tensor
    """[P]"""
    trace: Trace
    softmax: Tensor
    """[A, R]"""
    pi: Tensor
    """[A, R]"""
    log_pi: Tensor
    """[R], log π(u_i | τ_i) of the actions taken"""
    slope: Tensor
    """[R], (1 - ε)·softmax(u) / π(u): d log π(u) = slope · (d logit(u) - Σ_a softmax(a)·d logit(a))"""


class Policy:
    """θ with its optimiser.

    The behaviour policy is π = (1 - ε)·softmax + ε / available actions, and so is the π of every
    log-probability, ratio and derivative here, with the batch's ε.

    The ratio is always ρ = π_θ / μ with the stored probability μ, whether θ has moved on by steps on the
    batch or the actors' policy was a version behind; `ratio_bound` truncates it. Where a batch gives several
    policy steps, they use PPO's clip instead (Schulman et al., 2017).
    """

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self._config = config
        self._network = PolicyNetwork(spec, config.policy_hidden)
        gain = config.policy_gain if config.orthogonal_init else 1.0
        self.theta = initial(self._network, gain, config.orthogonal_init, seed, device, dtype)
        self._optimizer = Optimizer(self.theta, config.policy_optimizer)

    def tensors(self) -> dict[str, Tensor]:
        """The live state."""
        return {"parameters": self.theta} | prefixed("optimizer", self._optimizer.tensors())

    def weights(self) -> dict[str, NDArray[np.float32]]:
        """float32 copies under the names of `policy_shapes`."""
        return arrays(self.theta, self._network.shapes)

    def advance(self, data: Data, advantage: Tensor) -> tuple[Evaluation, Step, dict[str, Tensor]]:
        """Take the K policy steps of a batch along g(θ), `advantage` being [R].

        Returns the policy before the last step, that step and its figures.
        """
        for _ in range(self._config.policy_epochs):
            before = self.evaluate(self.theta.clone(), data)
            weight = self.score_weight(before, data, advantage)
            gradient, entropy = self._gradient(before, data, weight)
            step = self._optimizer.ascend(gradient)  # Eq. (6)
        log_rho = before.log_pi - data.log_mu
        rho = log_rho.exp()
        h = before.trace.gru.h
        return (
            before,
            step,
            {
                "policy_entropy": entropy,
                "policy_kl": data.mean(rho - 1 - log_rho),
                # Near 0 the GRU has saturated: it passes nothing on of what the agent sees.
                # Seven times as fast as `std`, which took 2 % of an update.
                "policy_hidden_std": (h - h.mean(0)).square().mean(0).sqrt().mean(),
                "policy_gradient_norm": step.norm,
                # With one step ρ is 1 but for rounding, which is not clipping.
                "clip_fraction": data.mean((~torch.isclose(weight, rho * advantage)).to(rho.dtype)),
            },
        )

    def extrinsic_gradient(self, data: Data, advantage: Tensor) -> Tensor:
        """v = (1/N) Σ w · ρ · A · ∇log π at the present θ [P]; `advantage` A is [R]."""
        now = self.evaluate(self.theta, data)
        return self._backward(now, self._score(now, data, self._ratio(now, data) * advantage))

    def _ratio(self, at: Evaluation, data: Data) -> Tensor:
        """ρ = π / μ [R], truncated where the samples may be old."""
        rho = (at.log_pi - data.log_mu).exp()
        bound = self._config.ratio_bound
        return rho.clamp(max=bound) if bound else rho

    def score_weight(self, at: Evaluation, data: Data, advantage: Tensor) -> Tensor:
        """What ∇log π is weighted with in a policy step [R]: the advantage [R] times the corrected ratio."""
        if self._config.policy_epochs == 1:
            return self._ratio(at, data) * advantage
        rho, clip = (at.log_pi - data.log_mu).exp(), self._config.ratio_clip
        beyond = torch.where(advantage > 0, rho > 1 + clip, rho < 1 - clip)
        return (rho * advantage).masked_fill(beyond, 0)

    def evaluate(self, theta: Tensor, data: Data) -> Evaluation:
        """The policy with parameters `theta` [P]."""
        trace = self._network.forward(theta, data)
        softmax = (trace.logits + data.closed).softmax(0)
        pi = torch.add(data.floor, softmax, alpha=1 - data.epsilon)
        chosen = pi.gather(0, data.actions)
        slope = softmax.gather(0, data.actions) * (1 - data.epsilon) / chosen
        return Evaluation(theta, trace, softmax, pi, chosen.log().squeeze(0), slope.squeeze(0))

    def derivative(self, at: Evaluation, data: Data, direction: Tensor) -> Tensor:
        """⟨direction, ∇log π(u_i | τ_i)⟩ [R] for a `direction` [P] of θ."""
        if self._config.meta_gradient == "difference":
            return self._difference(at, data, direction)
        logits = self._network.forward_derivative(at.theta, at.trace, direction)
        mean = (at.softmax * logits).sum(0)
        return at.slope * (logits.gather(0, data.actions).squeeze(0) - mean)

    def _difference(self, at: Evaluation, data: Data, direction: Tensor) -> Tensor:
        length = torch.linalg.vector_norm(direction).clamp_min(torch.finfo(direction.dtype).eps)
        width = _DIFFERENCE * torch.linalg.vector_norm(at.theta) / length
        above, below = (self.evaluate(at.theta + h * direction, data) for h in (width, -width))
        difference: Tensor = (above.log_pi - below.log_pi) / (2 * width)
        return difference

    def _gradient(self, at: Evaluation, data: Data, weight: Tensor) -> tuple[Tensor, Tensor]:
        """g(θ) = (1/N) Σ w · (weight · ∇log π + entropy coefficient · ∇H) and the mean of the entropy H."""
        log_pi = at.pi.clamp_min(torch.finfo(at.pi.dtype).tiny).log()
        by_logits = at.softmax * ((at.softmax * log_pi).sum(0) - log_pi)
        by_logits *= data.weight * (self._config.entropy * (1 - data.epsilon) / data.count)
        entropy = data.mean(-(at.pi * log_pi).sum(0))
        return self._backward(at, by_logits.add_(self._score(at, data, weight))), entropy

    def _score(self, at: Evaluation, data: Data, weight: Tensor) -> Tensor:
        """Gradient by the logits [A, R] of (1/N) Σ w · weight · log π."""
        scale = data.weight * weight * at.slope / data.count
        return (at.softmax * -scale).scatter_add_(0, data.actions, scale.unsqueeze(0))

    def _backward(self, at: Evaluation, grad_logits: Tensor) -> Tensor:
        return self._network.backward(at.theta, at.trace, grad_logits)
