"""Central-V: the policy gradient of every agent with the team's advantage (Foerster et al., AAAI 2018)."""

from __future__ import annotations

from collections.abc import Callable

import torch

from liir_common.config import AlgorithmConfig
from liir_common.types import Batch, EnvSpec, Weights
from services.learner.algorithms.actor_critic import ActorCritic
from services.learner.algorithms.metrics import to_floats
from services.learner.algorithms.networks import StateValue, coma_critic_size, count, fit_width


class CentralV(ActorCritic):
    """Policy θ and value ϕ; ϕ alone has the size that η, φ and ϕ of LIIR have together."""

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        width = fit_width(coma_critic_size(spec), lambda width: count(StateValue(spec, width).shapes))
        super().__init__(spec, config, seed, device, dtype, StateValue(spec, width))

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """One learner step on `batch`; returns its figures. `policy_ready` is as in `Algorithm`.

        Raises:
            ValueError: the batch does not fit (see `check`); nothing has changed then.
            FloatingPointError: learning has diverged.
        """
        data = self._prepare(batch)
        value, target = self._varphi.values(data, data.state)
        returns = self._return(data, data.reward, target)
        _, _, metrics = self._policy.advance(data, self._advantage(data, returns, value))
        self._announce(policy_ready)
        return to_floats(metrics | self._varphi.fit(data, data.state, returns, "value"))
