"""What all methods share that train one stochastic policy and an extrinsic value on each batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from liir_common import seeds
from liir_common.config import AlgorithmConfig
from liir_common.types import Array, Batch, EnvSpec, Weights
from services.learner.algorithms.critic import Critic
from services.learner.algorithms.data import Data, prepare
from services.learner.algorithms.networks import Mlp, coma_critic_size
from services.learner.algorithms.policy import Policy
from services.learner.algorithms.replay import Replay
from services.learner.algorithms.returns import lambda_return, normalize
from services.learner.algorithms.state import prefixed, restore, snapshot

# Which stream of the seed each network starts from; methods with equal seeds start from the same policy.
THETA, VARPHI, PHI, ETA = range(4)


class ActorCritic:
    """The policy θ, the extrinsic value ϕ, whose network is the method's choice, and their estimates; methods
    add their update."""

    replay: Replay | None = None

    def __init__(
        self,
        spec: EnvSpec,
        config: AlgorithmConfig,
        seed: int,
        device: torch.device,
        dtype: torch.dtype,
        value: Mlp,
    ) -> None:
        self._spec, self._config = spec, config
        self._device, self._dtype = device, dtype
        self._policy = Policy(spec, config, seeds.derive(seed, THETA), device, dtype)
        self._varphi = Critic(value, config, seeds.derive(seed, VARPHI), device, dtype)

    def policy(self) -> dict[str, NDArray[np.float32]]:
        """float32 copies of θ under the names and shapes of `policy_shapes`."""
        return self._policy.weights()

    def intrinsic(self) -> dict[str, NDArray[np.float32]]:
        """float32 copies of the weights of r_in; none unless the method has it."""
        return {}

    def parameter_counts(self) -> dict[str, int]:
        """Parameters of each network and the budget of all but θ."""
        budget = coma_critic_size(self._spec)
        return {"theta": self._policy.theta.numel(), "varphi": self._varphi.size, "budget": budget}

    def state(self) -> dict[str, Array]:
        """Copies of everything that `update` depends on."""
        return snapshot(self._tensors())

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Go on from `state`, bit for bit as if never stopped.

        Raises:
            ValueError: it is of another method, configuration or environment; nothing has changed then.
        """
        restore(self._tensors(), state)

    def _tensors(self) -> dict[str, Tensor]:
        return prefixed("policy", self._policy.tensors()) | prefixed("varphi", self._varphi.tensors())

    def _prepare(self, batch: Batch) -> Data:
        limit = self._config.limit_is_terminal
        return prepare(batch, self._spec, limit_is_terminal=limit, device=self._device, dtype=self._dtype)

    def _announce(self, policy_ready: Callable[[Weights], None]) -> None:
        """Say that the policy is what the step leaves; what follows, the fits of critics, does not touch it.

        Raises:
            FloatingPointError: nobody could play with it.
        """
        if not torch.isfinite(self._policy.theta).all():
            raise FloatingPointError("learning has diverged: the policy is not finite")
        policy_ready(self.policy())

    def _return(self, data: Data, reward: Tensor, value: Tensor) -> Tensor:
        """TD(λ_g) returns [B, T, k] of `reward` [B, T, k] over `value` [B, T+1, k]."""
        return lambda_return(reward, value, data.filled, self._config.gamma, self._config.gae_lambda)

    def _advantage(self, data: Data, returns: Tensor, value: Tensor) -> Tensor:
        """Agents' rows [R] of returns [B, T, k] over the baseline `value` [B, T+1, k]."""
        advantage = data.agents(returns - value[:, :-1])
        return normalize(advantage, data.weight) if self._config.normalize_advantages else advantage
