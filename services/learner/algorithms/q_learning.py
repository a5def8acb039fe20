"""What the value-based methods share: recurrent Q networks, double Q-learning, target networks, replay.

A method is its mixer, which makes the values of the team from the agents' values: Q_tot of the actions
taken is fitted to r + γ·Q̄_tot at the actions that are best by the live network (van Hasselt, Guez, Silver,
"Deep reinforcement learning with double Q-learning", AAAI 2016). The Q network has the policy's shape, so
that actors and evaluators play it as they play a policy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from liir_common import seeds
from liir_common.config import AlgorithmConfig
from liir_common.types import Array, Batch, EnvSpec, Weights
from services.learner.algorithms.data import Data, check, prepare
from services.learner.algorithms.metrics import to_floats
from services.learner.algorithms.networks import Network, arrays, count, initial
from services.learner.algorithms.optim import Optimizer
from services.learner.algorithms.policy_network import PolicyNetwork
from services.learner.algorithms.replay import Replay
from services.learner.algorithms.returns import lambda_return
from services.learner.algorithms.state import prefixed, restore, snapshot

Value = TypeVar("Value", bound=np.generic)

# Which stream of the seed each part starts from.
THETA, MIXER, SAMPLES = range(3)


class Mixer(Network, Protocol):
    """From the agents' values to the team's."""

    def __call__(self, flat: Tensor, q: Tensor, state: Tensor) -> Tensor:
        """[M, k] of the agents' values [M, n] and the states [M, S]: k = 1 for a team, n for independent
        agents."""


@dataclass(frozen=True)
class Sample:
    """Episodes drawn from the replay."""

    data: Data
    """Rows of everybody, dead or alive, at every played step and in the states to bootstrap from, B·(T+1)
    steps in all"""
    reward: Tensor
    """[B, T, 1]"""
    filled: Tensor
    """[B, T], 1 where the step was played"""


class QLearning:
    """The parameters θ of the Q network and those of the mixer, one flat vector."""

    def __init__(
        self,
        spec: EnvSpec,
        config: AlgorithmConfig,
        seed: int,
        device: torch.device,
        dtype: torch.dtype,
        mixer: Mixer,
    ) -> None:
        self._spec, self._config = spec, config
        self._device, self._dtype = device, dtype
        self._network, self._mixer = PolicyNetwork(spec, config.policy_hidden), mixer
        gain, orthogonal = config.policy_gain if config.orthogonal_init else 1.0, config.orthogonal_init
        theta = initial(self._network, gain, orthogonal, seeds.derive(seed, THETA), device, dtype)
        mixing = initial(mixer, 1.0, orthogonal, seeds.derive(seed, MIXER), device, dtype)
        self._parameters = torch.cat([theta, mixing])
        self._target = self._parameters.clone() if config.target_interval else self._parameters
        self._optimizer = Optimizer(self._parameters, config.policy_optimizer)
        self._steps, self._updates = torch.zeros(2, dtype=torch.int64).unbind()
        # A signed integer holds one bit less than a seed has.
        self._seed = torch.tensor(seeds.derive(seed, SAMPLES) >> 1)
        self._episodes = Replay(spec, config.replay.episodes)
        self.replay: Replay | None = self._episodes

    def policy(self) -> dict[str, NDArray[np.float32]]:
        """float32 copies of the Q network under the names and shapes of `policy_shapes`."""
        return arrays(self._split(self._parameters)[0], self._network.shapes)

    def intrinsic(self) -> dict[str, NDArray[np.float32]]:
        """Nothing: there is no intrinsic reward."""
        return {}

    def parameter_counts(self) -> dict[str, int]:
        """Parameters of each network; the paper sets no budget here."""
        return {"theta": count(self._network.shapes), "mixer": count(self._mixer.shapes)}

    def state(self) -> dict[str, Array]:
        """Copies of everything that `update` depends on but the replay."""
        return snapshot(self._tensors())

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Go on from `state`, bit for bit as if never stopped, once the replay is restored, too.

        Raises:
            ValueError: it is of another method, configuration or environment; nothing has changed then.
        """
        restore(self._tensors(), state)

    def update(
        self, batch: Batch, policy_ready: Callable[[Weights], None] = lambda _: None
    ) -> dict[str, float]:
        """One learner step: keep `batch` and learn from the replay, as often as the episodes so far allow.

        The figures are those of the last update on a sample; there is none until the replay holds enough.
        `policy_ready` is as in `Algorithm`.

        Raises:
            ValueError: the batch does not fit (see `check`); nothing has changed then.
            FloatingPointError: learning has diverged.
        """
        check(batch, self._spec)
        config, before = self._config.replay, self._episodes.total
        self._episodes.add(batch)
        updates = self._episodes.total // config.episodes_per_update - before // config.episodes_per_update
        metrics: dict[str, Tensor] = {}
        if len(self._episodes) >= config.batch_episodes:
            for _ in range(updates):
                metrics = self._learn(self._sample())
        self._steps += 1
        if self._config.target_interval and int(self._steps) % self._config.target_interval == 0:
            self._target.copy_(self._parameters)
        figures = to_floats(metrics) if metrics else {}
        policy_ready(self.policy())
        return figures

    def _sample(self) -> Sample:
        random = np.random.default_rng([int(self._seed), int(self._updates)])
        places = random.choice(len(self._episodes), self._config.replay.batch_episodes, replace=False)
        self._updates += 1
        batch = self._episodes.sample(sorted(places.tolist()))
        whole = everybody(batch, limit_is_terminal=self._config.limit_is_terminal)
        device, dtype = self._device, self._dtype
        data = prepare(whole, self._spec, limit_is_terminal=True, device=device, dtype=dtype)
        filled = torch.from_numpy(batch.filled).to(device, dtype)
        return Sample(data, data.reward[:, :-1], filled)

    def _learn(self, sample: Sample) -> dict[str, Tensor]:
        """One gradient step on the mean of (Q_tot - y)² over the played steps."""
        data = sample.data
        theta, mixing = self._split(self._parameters)
        trace = self._network.forward(theta, data)
        best = (trace.logits + data.closed).argmax(0, keepdim=True)
        y = self._targets(sample, best)

        q, mixing = trace.logits.detach().requires_grad_(), mixing.detach().requires_grad_()
        q_tot = self._mix(mixing, data, q.gather(0, data.actions))
        error = (q_tot[:, :-1] - y) * sample.filled.unsqueeze(-1)
        loss = error.square().sum() / (sample.filled.sum() * error.shape[-1])
        by_q, by_mixing = torch.autograd.grad(loss, (q, mixing), materialize_grads=True)
        gradient = torch.cat([self._network.backward(theta, trace, by_q), by_mixing])
        step = self._optimizer.ascend(-gradient)
        taken = q.detach().gather(0, data.actions)
        return {
            "q_loss": loss.detach(),
            "q_taken": taken.mean(),
            "policy_gradient_norm": step.norm,
        }

    def _targets(self, sample: Sample, best: Tensor) -> Tensor:
        """y [B, T, k]: returns with the target network's value of the actions `best` [1, R]."""
        theta, mixing = self._split(self._target)
        q = self._network.forward(theta, sample.data).logits
        value = self._mix(mixing, sample.data, q.gather(0, best))
        config = self._config
        return lambda_return(sample.reward, value, sample.filled, config.gamma, config.gae_lambda)

    def _mix(self, mixing: Tensor, data: Data, q: Tensor) -> Tensor:
        """Q_tot [B, T+1, k] of the agents' rows [1, R]; zero after an end without bootstrapping."""
        by_step = data.lives(q.squeeze(0))[data.filled.bool()]
        return data.team(self._mixer(mixing, by_step, data.state))[:, :-1]

    def _split(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        theta = count(self._network.shapes)
        return parameters[:theta], parameters[theta:]

    def _tensors(self) -> dict[str, Tensor]:
        counters = {"steps": self._steps, "updates": self._updates, "seed": self._seed}
        own = {"parameters": self._parameters} | counters
        if self._config.target_interval:
            own["target"] = self._target
        return prefixed("q", own | prefixed("optimizer", self._optimizer.tensors()))


def everybody(batch: Batch, *, limit_is_terminal: bool) -> Batch:
    """`batch` as value-based methods learn from it: nobody is dead, and a state to bootstrap from is a step.

    The team's reward goes on after an agent's death, and so does the agent's value: the only action of
    the dead is the one that they took. Has one step more than `batch`.
    """
    bootstraps = (batch.truncated & ~batch.terminated).any(1) & (not limit_is_terminal)
    lengths = batch.filled.sum(1) + bootstraps
    rows = np.arange(batch.obs.shape[1] + 1)
    lives, mask = (_longer(array) for array in (batch.alive, batch.mask))
    # What is done in a state that is only bootstrapped from counts for nothing.
    cut = np.argmax(batch.mask[np.arange(len(lengths)), lengths - bootstraps], -1)
    actions = _longer(batch.actions)
    actions[bootstraps, lengths[bootstraps] - 1] = cut[bootstraps]
    taken = np.eye(mask.shape[-1], dtype=np.bool_)[_longer(actions)]
    return replace(
        batch,
        obs=_longer(batch.obs),
        state=_longer(batch.state),
        mask=np.where(lives[..., None], mask, taken),
        alive=np.broadcast_to((rows < lengths[:, None])[..., None], lives.shape),
        actions=actions,
        log_mu=_longer(batch.log_mu),
        reward=_longer(batch.reward),
        filled=rows[:-1] < lengths[:, None],
        terminated=rows[:-1] == lengths[:, None] - 1,
        truncated=np.zeros_like(_longer(batch.truncated)),
    )


def _longer(array: NDArray[Value]) -> NDArray[Value]:
    """With one step of zeros more."""
    return np.pad(array, [(0, 0), (0, 1)] + [(0, 0)] * (array.ndim - 2))
