"""COMA: counterfactual multi-agent policy gradients (Foerster et al., AAAI 2018).

A central critic Q_i(s, u_-i, ·) values all actions of one agent, the others' being given. What an action is
worth beyond the agent's own average over actions is its advantage: a credit for this agent alone.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from liir_common.config import AlgorithmConfig
from liir_common.types import Batch, EnvSpec, Weights
from services.learner.algorithms.actor_critic import ActorCritic
from services.learner.algorithms.data import Data, observations
from services.learner.algorithms.metrics import to_floats
from services.learner.algorithms.networks import CounterfactualValue
from services.learner.algorithms.returns import normalize


class Coma(ActorCritic):
    """Policy θ and counterfactual critic ϕ, whose size is the budget of the other methods."""

    def __init__(
        self, spec: EnvSpec, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        super().__init__(spec, config, seed, device, dtype, CounterfactualValue(spec))

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """One learner step on `batch`; returns its figures. `policy_ready` is as in `Algorithm`.

        Raises:
            ValueError: the batch does not fit (see `check`); nothing has changed then.
            FloatingPointError: learning has diverged.
        """
        data = self._prepare(batch)
        inputs, taken = critic_inputs(batch, data)
        live, target = self._varphi.outputs(inputs)
        # TD(λ) returns, one column per agent, of the critic's values of the actions taken.
        returns = self._return(data, data.reward, data.team(_pick(target, taken)))

        pi = self._policy.evaluate(self._policy.theta, data).pi
        advantages = counterfactual_advantage(_agents(data, live), pi)
        advantage = advantages.gather(0, data.actions).squeeze(0)
        if self._config.normalize_advantages:
            advantage = normalize(advantage, data.weight)
        _, _, metrics = self._policy.advance(data, advantage)
        self._announce(policy_ready)
        fitted = self._varphi.regress(lambda q: _pick(q, taken), inputs, returns[data.filled.bool()], "value")
        return to_floats(metrics | fitted)


def counterfactual_advantage(q: Tensor, pi: Tensor) -> Tensor:
    """A_i(s, u_-i, ·) = Q_i(s, u_-i, ·) - Σ_a π_i(a)·Q_i(s, u_-i, a), all [A, R]."""
    return q - (pi * q).sum(0)


def critic_inputs(batch: Batch, data: Data) -> tuple[Tensor, Tensor]:
    """What the critic sees of the M played steps [M, n, inputs], and the actions it values [M, n].

    The dead observe nothing, do nothing and count as having taken action 0.
    """
    played = torch.from_numpy(batch.filled).to(data.filled.device)
    alive = torch.from_numpy(batch.alive[:, :-1]).to(played.device) & played.unsqueeze(-1)
    actions = torch.from_numpy(batch.actions).to(played.device) * alive
    one_hot = functional.one_hot(actions, batch.mask.shape[-1]).to(data.state) * alive.unsqueeze(-1)
    last = functional.pad(one_hot, (0, 0, 0, 0, 1, 0))[:, :-1][played]
    ids = torch.eye(data.n_agents).to(data.state)
    others = one_hot[played].unsqueeze(1) * (1 - ids).unsqueeze(-1)

    def to_all(values: Tensor) -> Tensor:
        return values.unsqueeze(1).expand(-1, data.n_agents, -1)

    obs = observations(batch, data)
    parts = [
        to_all(data.state),
        obs,
        others.flatten(2),
        to_all(last.flatten(1)),
        ids.expand(len(obs), -1, -1),
    ]
    return torch.cat(parts, -1), actions[played]


def _pick(q: Tensor, taken: Tensor) -> Tensor:
    """[M, n] of q [M, n, A] at the actions `taken` [M, n]."""
    return q.gather(-1, taken.unsqueeze(-1)).squeeze(-1)


def _agents(data: Data, q: Tensor) -> Tensor:
    """Agents' rows [A, R] of q [M, n, A]."""
    dense = data.team(q.flatten(1))[:, :-1].reshape(-1, q.shape[-1])
    return dense.index_select(0, data.rows).t()
