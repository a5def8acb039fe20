"""The generic loop on real PettingZoo games: what it records, and which environments it refuses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from liir_common import seeds
from liir_common.pursuit import Pursuit, parallel_env
from liir_common.rollout.loop import LoopPlayer, loop_spec
from liir_common.rollout.policy import random_weights
from liir_common.types import TRAJECTORY_ARRAYS, Exploration, Ticket, Trajectory, expected_shape

HIDDEN = 8
AGENTS = ["agent_0", "agent_1"]


def ticket(episode_id: int = 0) -> Ticket:
    return Ticket.for_training(1, episode_id, 3, Exploration.SOFTMAX_FLOOR, 0.5)


def player_for(game: Any, **changes: Any) -> LoopPlayer:
    spec = replace(loop_spec(game, "pursuit", {}), **changes)
    player = LoopPlayer(game, spec, HIDDEN)
    player.load(random_weights(spec, HIDDEN, seed=0))
    return player


def play(game: Any, episode_id: int = 0) -> Trajectory:
    return player_for(game).play(ticket(episode_id))


class Masked(Pursuit):
    """Pursuit in which nobody may stay: observations carry an action mask."""

    mask = (0, 1, 1)

    def observation_space(self, agent: str) -> Any:
        box = super().observation_space(agent)
        return spaces.Dict({"observation": box, "action_mask": spaces.Box(0, 1, (3,), np.int8)})

    def _observe(self) -> dict[str, Any]:
        plain = super()._observe()
        return {a: {"observation": o, "action_mask": np.array(self.mask, np.int8)} for a, o in plain.items()}


class Stuck(Masked):
    """Nothing is available from the start."""

    mask = (0, 0, 0)


class Leaving(Pursuit):
    """agent_1 leaves for good after three steps; afterwards it stands still."""

    def step(self, actions: dict[str, int]) -> Any:
        results = super().step({"agent_1": 0} | actions)
        if self._steps >= 3 and self.agents:
            self.agents = ["agent_0"]
        if self._steps == 3:
            results[2]["agent_1"] = True
        if self._steps > 3:
            return tuple({"agent_0": result["agent_0"]} for result in results)
        return results


class Stateless(BaseParallelWrapper[str, Any, Any]):
    """A game without a state of its own, in a wrapper."""

    state_space = None

    def state(self) -> Any:
        raise NotImplementedError


class MaskedInInfo(Pursuit):
    """The same mask in the info, where PettingZoo games with plain observations have it."""

    def _inform(self) -> Any:
        return {agent: {**info, "action_mask": Masked.mask} for agent, info in super()._inform().items()}


class Selfish(Pursuit):
    """Pays the agents differently."""

    def step(self, actions: dict[str, int]) -> Any:
        results = super().step(actions)
        results[1]["agent_1"] += 1
        return results


class Fainting(Pursuit):
    """Keeps a dead agent listed and says so in its info."""

    def _inform(self) -> dict[str, Any]:
        infos = {agent: dict(info) for agent, info in super()._inform().items()}
        infos["agent_0"]["alive"] = self._steps < 2
        return infos


class Blind(Pursuit):
    """Shows what is no number."""

    def _observe(self) -> dict[str, Any]:
        return dict.fromkeys(AGENTS, np.full(2, np.nan, np.float32))


class Silent(Pursuit):
    """Empties the list of agents without ending the episode."""

    def step(self, actions: dict[str, int]) -> Any:
        results = super().step(actions)
        self.agents = []
        return results


class Unequal(Pursuit):
    """Agents with different numbers of actions."""

    def action_space(self, agent: str) -> Any:
        return spaces.Discrete(3 + AGENTS.index(agent))


class Continuous(Pursuit):
    """Actions that are not discrete."""

    def action_space(self, agent: str) -> Any:
        return spaces.Box(-1, 1, (1,))


class Counting(Pursuit):
    """Observations that are not vectors."""

    def observation_space(self, agent: str) -> Any:
        return spaces.Discrete(5)


def test_spec_is_read_off_the_game() -> None:
    spec = loop_spec(parallel_env(horizon=7), "mine", {"start": 10, "horizon": 7})
    assert (spec.name, spec.version) == ("mine", "pursuit_1d_v1")
    assert spec.options == '{"horizon":7,"start":10}'
    assert (spec.n_agents, spec.n_actions, spec.obs_dim, spec.state_dim) == (2, 3, 2, 2)
    assert (spec.episode_limit, spec.info_keys) == (7, ("distance",))
    assert loop_spec(Stateless(parallel_env()), "mine", {}).state_dim == 4
    assert loop_spec(Masked(), "mine", {}).obs_dim == 2


@pytest.mark.parametrize("episode_id", range(30))
def test_trajectory_is_what_the_game_shows_when_its_actions_are_played_again(episode_id: int) -> None:
    played = play(parallel_env(), episode_id)
    game = parallel_env()
    observations, _ = game.reset(seed=seeds.episode_seed(1, seeds.TRAINING, episode_id))
    for t in range(played.length):
        assert (played.obs[t] == np.stack([observations[a] for a in AGENTS])).all()
        assert (played.state[t] == game.state()).all()
        actions = dict(zip(AGENTS, played.actions[t].tolist(), strict=True))
        observations, rewards, terminations, truncations, infos = game.step(actions)
        assert played.reward[t] == np.float32(rewards["agent_0"])
    assert not game.agents
    assert (played.obs[-1] == np.stack([observations[a] for a in AGENTS])).all()
    assert (played.state[-1] == game.state()).all()
    assert (played.terminated, played.truncated) == (terminations["agent_0"], truncations["agent_0"])
    assert played.info == infos["agent_0"]
    assert played.mask.all()
    assert played.alive.all()


def test_shapes_and_dtypes_are_the_declared_ones() -> None:
    player = player_for(parallel_env())
    played = player.play(ticket())
    for name, (dtype, _) in TRAJECTORY_ARRAYS.items():
        array = getattr(played, name)
        assert array.dtype == dtype
        assert array.shape == expected_shape(name, player.spec, played.length)
    assert (played.episode_id, played.policy_version) == (0, 3)


@pytest.mark.parametrize("game", [Masked(), MaskedInInfo()])
def test_action_mask_is_obeyed(game: Any) -> None:
    played = play(game)
    assert (played.mask == np.array([False, True, True])).all()
    assert (played.actions > 0).all()


def test_an_agent_that_leaves_is_dead_from_then_on() -> None:
    played = play(Leaving(ending="never"))
    assert played.length == 20
    assert played.alive[:, 0].all()
    assert played.alive[:, 1].tolist() == [True] * 3 + [False] * 18
    assert not played.obs[3:, 1].any()
    assert (played.mask[3:, 1] == np.array([True, False, False])).all()
    assert (played.actions[3:, 1] == 0).all()
    assert (played.log_mu[3:, 1] == 0).all()
    assert played.obs[:, 0].any(1).all()


def test_info_says_who_is_alive() -> None:
    played = play(Fainting(ending="never"))
    assert played.alive[:, 0].tolist() == [True] * 2 + [False] * 19
    assert played.alive[:, 1].all()
    assert played.obs[5:, 0].any()


def test_without_a_state_the_observations_are_it() -> None:
    played = play(Stateless(parallel_env()))
    assert (played.state == played.obs.reshape(played.length + 1, 4)).all()


@pytest.mark.parametrize(
    ("game", "message"),
    [
        (Selfish(), r"step 0: wanted one team reward, .*'agent_1': 1"),
        (Stuck(), "step 0: agent 0 has no available action"),
        (Blind(), "step 0: wanted finite observations"),
        (Silent(ending="never"), "env.agents is empty after 1 steps, but not all agents were"),
    ],
)
def test_broken_promises_are_named(game: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        play(game)


def test_a_limit_that_is_too_low_is_named() -> None:
    player = player_for(parallel_env(ending="never"), episode_limit=5)
    with pytest.raises(ValueError, match="wanted an end within the episode limit of 5 steps"):
        player.play(ticket())


def test_a_missing_figure_is_named() -> None:
    player = player_for(parallel_env(), info_keys=("won",))
    with pytest.raises(ValueError, match=r"the last info wants \['won'\], got \['distance'\]"):
        player.play(ticket())


@pytest.mark.parametrize(
    ("game", "message"),
    [
        (Unequal(), r"equal \(observation, action\) sizes for all agents, got .*'agent_1': \(2, 4\)"),
        (Continuous(), "agent_0: wanted Discrete actions that start at 0, got Box"),
        (Counting(), "agent_0: wanted a Box, or a Dict of observation and action_mask, .* Discrete"),
    ],
)
def test_unsupported_games_are_named(game: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        loop_spec(game, "pursuit", {})


def test_a_game_without_a_limit_is_refused() -> None:
    game = parallel_env()
    del game.episode_limit
    with pytest.raises(ValueError, match="as attribute episode_limit or max_cycles"):
        loop_spec(game, "pursuit", {})
    game.max_cycles = 11  # type: ignore[attr-defined]
    assert loop_spec(game, "pursuit", {}).episode_limit == 11


def test_a_figure_called_like_one_of_every_episode_is_refused() -> None:
    game = parallel_env()
    game.info_keys = ("return", "won")  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="info_keys: return is what every episode has"):
        loop_spec(game, "pursuit", {})


def test_playing_wants_weights_and_a_possible_ticket() -> None:
    game = parallel_env()
    player = LoopPlayer(game, loop_spec(game, "pursuit", {}), HIDDEN)
    with pytest.raises(ValueError, match=r"call load\(weights\) first"):
        player.play(ticket())
    player.load(random_weights(player.spec, HIDDEN, 0))
    for broken in (replace(ticket(), epsilon=1.5), replace(ticket(), seed=2**64)):
        with pytest.raises(ValueError, match=r"a ticket wants epsilon in \[0, 1\] and a 64-bit seed"):
            player.play(broken)
