"""The shared policy of all agents: its probabilities, its gradient steps and their linearisation."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from liir_common.config import AlgorithmConfig
from liir_common.types import EnvSpec
from services.learner.algorithms.data import Data
from services.learner.algorithms.networks import PolicyNetwork, arrays, initial
from services.learner.algorithms.optim import Optimizer, Step
from services.learner.algorithms.state import prefixed

# Distance that the central difference moves θ, as a share of its norm: float32 rounding and curvature
# balance there.
_DIFFERENCE = 1e-3


class Policy:
    """θ with its optimiser.

    The behaviour policy is π = (1 - ε)·softmax + ε / available actions, and so is the π of every
    log-probability, ratio and derivative here, with the batch's ε.

    Correction of old samples: the ratio is always ρ = π_θ / μ with the stored probability μ, whether θ
    has moved on by earlier steps on the batch or the actors' policy was a version behind. With one step
    per batch it is truncated at 1; with several, steps use PPO's clip (Schulman et al., 2017).
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

    def advance(self, data: Data, advantage: Tensor) -> tuple[Tensor, Step, dict[str, Tensor]]:
        """Take the K policy steps of a batch along g(θ) = (1/N) Σ w · A · ∇log π, `advantage` A being [R].

        Returns θ [P] before the last step, that step and its figures.
        """
        for _ in range(self._config.policy_epochs):
            theta = self.theta.clone()
            gradient, metrics = self._gradient(data, advantage)
            step = self._optimizer.ascend(gradient)
        return theta, step, metrics | {"policy_gradient_norm": step.norm}

    def _gradient(self, data: Data, advantage: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        theta = self.theta.detach().requires_grad_()
        log_pi, entropy = self._log_pi_and_entropy(theta, data)
        log_rho = log_pi.detach() - data.log_mu
        rho = log_rho.exp()
        weight = self.score_weight(rho, advantage)
        mean_entropy = data.mean(entropy)
        # Eq. (6)
        objective = data.mean(weight * log_pi) + self._config.entropy * mean_entropy
        (gradient,) = torch.autograd.grad(objective, theta)
        return gradient, {
            "policy_entropy": mean_entropy.detach(),
            "policy_kl": data.mean(rho - 1 - log_rho),
            "clip_fraction": data.mean((weight != rho * advantage).to(rho.dtype)),
        }

    def extrinsic_gradient(self, data: Data, advantage: Tensor) -> Tensor:
        """v = (1/N) Σ w · ρ · A · ∇log π at the present θ [P]; ρ is truncated at 1, `advantage` A is [R]."""
        theta = self.theta.detach().requires_grad_()
        log_pi, _ = self._log_pi_and_entropy(theta, data)
        rho = (log_pi.detach() - data.log_mu).exp().clamp(max=1)
        (gradient,) = torch.autograd.grad(data.mean(rho * advantage * log_pi), theta)
        return gradient

    def score_weight(self, rho: Tensor, advantage: Tensor) -> Tensor:
        """What ∇log π is weighted with in a policy step [R]: the advantage times the corrected ratio."""
        if self._config.policy_epochs == 1:
            return rho.clamp(max=1) * advantage
        clip = self._config.ratio_clip
        beyond = torch.where(advantage > 0, rho > 1 + clip, rho < 1 - clip)
        return (rho * advantage).masked_fill(beyond, 0)

    @torch.no_grad()
    def linearised(self, theta: Tensor, direction: Tensor, data: Data) -> tuple[Tensor, Tensor]:
        """log π(u_i | τ_i) at `theta` [P] and its derivative along `direction` [P], both [R]."""
        if self._config.meta_gradient == "difference":
            length = torch.linalg.vector_norm(direction).clamp_min(torch.finfo(theta.dtype).eps)
            width = _DIFFERENCE * torch.linalg.vector_norm(theta) / length
            above, below = (self._log_pi(theta + h * direction, data) for h in (width, -width))
            return (above + below) / 2, (above - below) / (2 * width)
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(theta, direction)  # type: ignore[no-untyped-call]
            log_pi, derivative = forward_ad.unpack_dual(self._log_pi(dual, data))  # type: ignore[no-untyped-call]
        return log_pi, derivative

    def _log_pi(self, theta: Tensor, data: Data) -> Tensor:
        return self._log_probs(theta, data).gather(1, data.actions).squeeze(1)

    def _log_pi_and_entropy(self, theta: Tensor, data: Data) -> tuple[Tensor, Tensor]:
        log_probs = self._log_probs(theta, data)
        return log_probs.gather(1, data.actions).squeeze(1), -(log_probs.exp() * log_probs).sum(1)

    def _log_probs(self, theta: Tensor, data: Data) -> Tensor:
        """log π of every action [R, A]; the logarithm of next to nothing where one is not available."""
        logits = self._network(theta, data.inputs, data.sizes)
        softmax = logits.masked_fill(~data.mask, -torch.inf).softmax(1)
        floor = data.epsilon * data.mask / data.mask.sum(1, keepdim=True)
        return torch.log(((1 - data.epsilon) * softmax + floor).clamp_min(torch.finfo(softmax.dtype).tiny))
