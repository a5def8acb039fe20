"""Games that take what a method is for: the two-step game, penalty, climbing, memory, credit among many.

They are played through the PettingZoo loop with the tickets and the kernel that actors use.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv

from liir_common.config import METHOD_PRESETS, AlgorithmConfig
from liir_common.rollout.loop import LoopPlayer, loop_spec
from liir_common.types import Batch, Exploration, Ticket
from services.learner.algorithms import make_algorithm

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

HIDDEN = 16


class Game(ParallelEnv[str, Any, Any]):
    """A team game of a fixed number of steps; everybody sees the same unless the game says otherwise."""

    metadata = {"name": "game_v0"}  # noqa: RUF012
    episode_limit = 1
    n_agents = 2
    n_actions = 2
    obs_dim = 1

    def __init__(self) -> None:
        self.possible_agents = [f"agent_{i}" for i in range(self.n_agents)]
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        box = spaces.Box(-1, 1, (self.obs_dim,), np.float32)
        return spaces.Dict({"observation": box, "action_mask": spaces.Box(0, 1, (self.n_actions,), np.int8)})

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(self.n_actions)

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.agents, self.t = list(self.possible_agents), 0
        self.begin(np.random.default_rng(seed))
        return self._look(), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, int]) -> tuple[dict[str, Any], ...]:
        reward = self.play([actions[agent] for agent in self.agents])
        self.t += 1
        done = self.t == self.episode_limit
        observations = self._look()
        rewards, ends, cuts, infos = (dict.fromkeys(self.agents, x) for x in (reward, done, False, {}))
        if done:
            self.agents = []
        return observations, rewards, ends, cuts, infos

    def state(self) -> np.ndarray:
        return np.ravel([self.sight(i) for i in range(self.n_agents)]).astype(np.float32)

    def _look(self) -> dict[str, Any]:
        return {
            agent: {"observation": np.array(self.sight(i), np.float32), "action_mask": self.mask()}
            for i, agent in enumerate(self.agents)
        }

    def begin(self, rng: np.random.Generator) -> None:
        """Draw what is random about an episode."""

    def mask(self) -> np.ndarray:
        return np.ones(self.n_actions, np.int8)

    def sight(self, agent: int) -> list[float]:
        return [1.0]

    def play(self, actions: list[int]) -> float:
        raise NotImplementedError


class TwoStep(Game):
    """Section 5 of the QMIX paper: agent 0 chooses between a sure 7 and a game that pays 8 to the bold."""

    episode_limit = 2
    obs_dim = 3
    safe, risky = [[7, 7], [7, 7]], [[0, 1], [1, 8]]

    def begin(self, rng: np.random.Generator) -> None:
        self.where = 0

    def sight(self, agent: int) -> list[float]:
        return [float(self.where == place) for place in range(3)]

    def play(self, actions: list[int]) -> float:
        if self.t == 0:
            self.where = 1 + actions[0]
            return 0.0
        return float((self.safe if self.where == 1 else self.risky)[actions[0]][actions[1]])


class Penalty(Game):
    """The penalty game of Claus and Boutilier (AAAI 1998): two best ways, a loss for those who disagree on
    which, and a poor but safe third."""

    n_actions = 3
    obs_dim = 2
    payoff = [[10, 0, -2], [0, 2, 0], [-2, 0, 10]]  # noqa: RUF012

    def sight(self, agent: int) -> list[float]:
        return [float(agent == 0), float(agent == 1)]

    def play(self, actions: list[int]) -> float:
        return float(self.payoff[actions[0]][actions[1]])


class Ruin(Penalty):
    """A climbing game: the first way is best with a partner who takes it, but on average worse than the
    second, since with the third it ruins both."""

    payoff = [[1, 0, -2.2], [0, 0.2, -1], [-2.2, -1, -2]]  # noqa: RUF012


class Memory(Game):
    """Each agent sees a sign, can do nothing for two steps, and then has to name it without seeing it."""

    episode_limit = 3
    obs_dim = 2

    def begin(self, rng: np.random.Generator) -> None:
        self.signs = rng.integers(0, 2, self.n_agents)

    def mask(self) -> np.ndarray:
        return np.array([1, self.t >= 2], np.int8)

    def sight(self, agent: int) -> list[float]:
        return [2.0 * self.signs[agent] - 1 if self.t == 0 else 0.0, float(self.t == 2)]

    def state(self) -> np.ndarray:
        return np.array([*self.signs, self.t], np.float32)

    def play(self, actions: list[int]) -> float:
        return float(np.mean(actions == self.signs)) if self.t == 2 else 0.0


class Targets(Game):
    """Shooting always beats walking; which of two targets pays more changes with every step and is seen."""

    episode_limit = 8
    n_actions = 6
    obs_dim = 12
    targets = 2

    def begin(self, rng: np.random.Generator) -> None:
        self.marks = rng.integers(0, self.targets, (self.episode_limit + 1, self.n_agents))

    def sight(self, agent: int) -> list[float]:
        mark = float(self.marks[self.t, agent])
        return [mark, 1 - mark] + [1.0] * 10

    def play(self, actions: list[int]) -> float:
        shots, hits = np.less(actions, self.targets), np.equal(actions, self.marks[self.t])
        return float(shots.mean() + hits.mean()) / self.episode_limit


class Levers(Game):
    """Twelve agents with a lever each that has to be left or pulled; the team gets the sum."""

    n_agents = 12

    def sight(self, agent: int) -> list[float]:
        return [1.0 if agent % 2 else -1.0]

    def play(self, actions: list[int]) -> float:
        return float(sum(action == agent % 2 for agent, action in enumerate(actions)))


def train(
    game: Game,
    name: str,
    settings: dict[str, Any],
    updates: int,
    epsilon: float,
    seed: int,
    episodes: int = 32,
) -> LoopPlayer:
    """A player of what is learned from `updates` batches of `episodes`, each played by the newest policy."""
    of_method = METHOD_PRESETS.get(name, {})
    config = AlgorithmConfig.model_validate({"policy_hidden": HIDDEN} | of_method | settings | {"name": name})
    player = LoopPlayer(game, loop_spec(game, type(game).__name__, {}), config.policy_hidden)
    algorithm = make_algorithm(player.spec, config, seed, torch.device("cpu"))
    for version in range(updates):
        player.load(algorithm.policy())
        tickets = [
            Ticket.for_training(seed, episodes * version + i, version, config.behaviour, epsilon)
            for i in range(episodes)
        ]
        algorithm.update(Batch.from_trajectories([player.play(ticket) for ticket in tickets], epsilon))
    player.load(algorithm.policy())
    return player


def mean_return(player: LoopPlayer, exploration: Exploration, episodes: int) -> float:
    tickets = [Ticket(i, 0, i, exploration, 0.0) for i in range(episodes)]
    return float(np.mean([player.play(ticket).reward.sum() for ticket in tickets]))


FASTER = {"policy_optimizer": {"lr": 2e-3}, "critic_optimizer": {"lr": 2e-3}}
OFTEN = {"target_interval": 4, "replay": {"episodes": 1000, "batch_episodes": 32, "episodes_per_update": 8}}


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("name", "found"), [("qmix", 8.0), ("vdn", 7.0)])
def test_only_a_mixer_that_the_state_controls_finds_the_eight(name: str, found: float, seed: int) -> None:
    """Played uniformly, so that the data are the same for both."""
    player = train(TwoStep(), name, FASTER | OFTEN, updates=80, epsilon=1.0, seed=seed)
    assert mean_return(player, Exploration.GREEDY, episodes=1) == found


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("name", "found"), [("qmix", 1.0), ("vdn", 0.2), ("iql", 0.2)])
def test_only_a_mixer_sees_past_the_ruin_to_the_best_way(name: str, found: float, seed: int) -> None:
    """Played uniformly, so that the data are the same for all.

    To independent learners, and in a sum of their values, a way is worth its mean over what the other tries:
    -0.4 the first, -0.27 the second. QMIX's mixer is monotonic and convex, so it can say that a way pays only
    together; of what it can say, the closest to the payoffs has the first way first.
    """
    player = train(Ruin(), name, FASTER, updates=80, epsilon=1.0, seed=seed)
    assert mean_return(player, Exploration.GREEDY, episodes=1) == pytest.approx(found)


@pytest.mark.parametrize("name", ["liir", "central_v", "iac", "coma"])
def test_policies_that_learn_together_agree_on_one_of_two_best_ways(name: str) -> None:
    player = train(Penalty(), name, FASTER | {"entropy": 0.0}, updates=100, epsilon=0.2, seed=3)
    assert mean_return(player, Exploration.GREEDY, episodes=1) == 10.0


@pytest.mark.parametrize("name", ["liir", "central_v", "iac", "coma", "iql", "vdn", "qmix"])
def test_memory_beats_what_can_be_seen(name: str) -> None:
    """What an agent sees when it has to answer says nothing: without memory half of the answers are right."""
    settings = FASTER | OFTEN if name in ("iql", "vdn", "qmix") else FASTER | {"target_interval": 0}
    player = train(Memory(), name, settings, updates=100, epsilon=0.3, seed=3)
    assert mean_return(player, Exploration.GREEDY, episodes=64) > 0.95


@pytest.mark.parametrize("name", ["liir", "central_v", "iac"])
def test_a_policy_that_has_learned_the_obvious_still_sees(name: str) -> None:
    """From a small head, learning what is good everywhere saturates the GRU, and the policy goes blind."""
    settings = FASTER | {"policy_hidden": 64}
    player = train(Targets(), name, settings, updates=40, epsilon=0.1, seed=1)
    assert mean_return(player, Exploration.GREEDY, episodes=64) > 1.9
    player = train(Targets(), name, settings | {"policy_gain": 0.01}, updates=40, epsilon=0.1, seed=1)
    assert mean_return(player, Exploration.GREEDY, episodes=64) < 1.6


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_counterfactual_baseline_takes_the_others_noise_out(seed: int) -> None:
    """With two episodes a batch, the team's advantage says little about any one of twelve levers."""
    settings = FASTER | {"policy_epochs": 1, "critic_epochs": 8, "entropy": 0.0, "target_interval": 0}
    # COMA's own, so that both begin with the same policy.
    plain = {"normalize_advantages": False, "normalize_values": False, "orthogonal_init": False}
    wrong = {}
    for name in ("coma", "central_v"):
        player = train(Levers(), name, settings | plain, updates=100, epsilon=0.1, seed=seed, episodes=2)
        wrong[name] = Levers.n_agents - mean_return(player, Exploration.SOFTMAX_FLOOR, episodes=200)
    assert wrong["coma"] < 1
    assert wrong["central_v"] > 2 * wrong["coma"]
