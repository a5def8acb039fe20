"""Episodes of any PettingZoo ParallelEnv whose agents share one reward, stepped in Python."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import structlog
from gymnasium import spaces
from pettingzoo import ParallelEnv

from liir_common.errors import EpisodeLostError
from liir_common.rollout.player import Ending, Player
from liir_common.rollout.policy import Choice, Policy, act, first_stuck, stuck_message
from liir_common.types import BoolArray, EnvSpec, FloatArray, Ticket, Trajectory

log = structlog.get_logger()

Env = ParallelEnv[str, Any, Any]
NO_OP = 0
"""The action of an agent that left the game."""
_ATTEMPTS = 3


class LoopPlayer(Player):
    """Plays through the PettingZoo interface.

    Observations are a Box, or a Dict of "observation" and "action_mask". With a Box the mask is
    info["action_mask"], or without one every action is available. An agent that leaves `env.agents` is
    dead: it observes zeros and has only action 0. An env that keeps its dead listed says so with
    info["alive"].
    """

    def __init__(self, env: Env, spec: EnvSpec, policy_hidden: int) -> None:
        super().__init__(spec, policy_hidden)
        self._env = env
        self._agents = env.possible_agents

    def play(self, ticket: Ticket) -> Trajectory:
        """As `Player.play`; an episode in which the game breaks down is played again.

        Raises:
            EpisodeLostError: it broke down every time.
        """
        for attempt in range(1, _ATTEMPTS):
            try:
                return super().play(ticket)
            except EpisodeLostError as error:
                log.warning(
                    "an episode is lost", episode=ticket.episode_id, attempt=attempt, reason=str(error)
                )
        return super().play(ticket)

    def _run(self, policy: Policy, seed: int, choice: Choice) -> Ending:
        env, rows = self._env, self._rows
        chosen = np.full(self.spec.n_agents, -1)
        observations, infos = env.reset(seed=seed)
        self._look(0, observations, infos)
        for t in range(self.spec.episode_limit):
            act(policy, self._hidden, rows.obs[t], chosen, rows.mask[t], choice, chosen, rows.log_mu[t])
            rows.actions[t] = chosen
            actions = dict(zip(self._agents, chosen.tolist(), strict=True))
            observations, rewards, terminations, truncations, infos = env.step(
                {agent: actions[agent] for agent in env.agents}
            )
            rows.reward[t] = _team_reward(rewards, t)
            self._look(t + 1, observations, infos)
            if not env.agents:
                return self._ending(t + 1, terminations, truncations, infos)
        raise ValueError(
            f"{self.spec.name}: wanted an end within the episode limit of {self.spec.episode_limit} steps, "
            f"but {env.agents} are still listed; correct the limit that the environment states"
        )

    def _ending(
        self,
        length: int,
        terminations: Mapping[str, bool],
        truncations: Mapping[str, bool],
        infos: Mapping[str, Mapping[str, Any]],
    ) -> Ending:
        """The game decided the end if it did so for all who were left."""
        terminated, truncated = all(terminations.values()), any(truncations.values())
        if not terminated and not truncated:
            raise ValueError(
                f"{self.spec.name}: env.agents is empty after {length} steps, but not all agents were "
                f"terminated or truncated: {dict(terminations)}, {dict(truncations)}"
            )
        last = next(iter(infos.values()), {})
        missing = [key for key in self.spec.info_keys if key not in last]
        if missing:
            raise ValueError(f"{self.spec.name}: the last info wants {missing}, got {sorted(last)}")
        info = {key: float(last[key]) for key in self.spec.info_keys}
        return Ending(length, bool(terminated), bool(truncated), info)

    def _look(self, step: int, observations: Mapping[str, Any], infos: Mapping[str, Any]) -> None:
        """Write what the team sees before `step`."""
        # PettingZoo empties env.agents when the episode ends, also of those who lived to see it.
        present = self._env.agents or observations
        for i, agent in enumerate(self._agents):
            if agent in present:
                self._look_as(i, step, observations[agent], infos[agent])
            else:
                self._look_dead(i, step)
        check_seen(step, self._rows.obs[step], self._rows.mask[step])
        self._rows.state[step] = _state(self._env, self._rows.obs[step])

    def _look_as(self, i: int, step: int, observation: Any, info: Mapping[str, Any]) -> None:
        self._rows.obs[step, i], self._rows.mask[step, i] = read_observation(observation, info)
        self._rows.alive[step, i] = info.get("alive", True)

    def _look_dead(self, i: int, step: int) -> None:
        self._rows.obs[step, i] = 0
        self._rows.mask[step, i] = np.arange(self.spec.n_actions) == NO_OP
        self._rows.alive[step, i] = False


def read_observation(observation: Any, info: Mapping[str, Any]) -> tuple[FloatArray, Any]:
    """One agent's observation [O] and its action mask [A], which is True where every action is available."""
    mask = info.get("action_mask", True)
    if isinstance(observation, Mapping):
        observation, mask = observation["observation"], observation["action_mask"]
    return np.ravel(observation), mask


def check_seen(step: int, obs: FloatArray, mask: BoolArray) -> None:
    """Return if a team can decide on obs [n, O] and mask [n, A].

    Raises:
        ValueError: an observation is not finite, or an agent has no available action.
    """
    if not np.isfinite(obs).all():
        raise ValueError(f"step {step}: wanted finite observations, got {obs}")
    stuck = first_stuck(mask)
    if stuck >= 0:
        raise ValueError(stuck_message(stuck, step))


def _team_reward(rewards: Mapping[str, float], step: int) -> float:
    if len(set(rewards.values())) != 1:
        raise ValueError(
            f"step {step}: wanted one team reward, the same for all agents, got {dict(rewards)}; "
            "give every agent the sum or the mean"
        )
    return next(iter(rewards.values()))


def _state(env: Env, obs: FloatArray) -> FloatArray:
    """[S], the state, or all observations in a row where the environment has none."""
    try:
        return np.asarray(env.state(), np.float32).ravel()
    except NotImplementedError:
        return obs.ravel()


def loop_spec(env: Env, name: str, options: Mapping[str, Any]) -> EnvSpec:
    """What `env` looks like from outside; without a `state_space` it is reset once to see its state.

    The step limit is the attribute `episode_limit` of the unwrapped environment, or `max_cycles`, as
    PettingZoo's own environments call it; `info_keys`, if there, names the figures of the last info;
    the version is the name in the metadata, which ends in one.

    Raises:
        ValueError: agents differ in their spaces, a space is of an unsupported kind, no limit is stated, or
            a figure is called like one that every episode has.
    """
    game = env.unwrapped
    limit = getattr(game, "episode_limit", getattr(game, "max_cycles", None))
    if limit is None:
        raise ValueError(f"{name}: wanted the most steps it plays as attribute episode_limit or max_cycles")
    info_keys = tuple(getattr(game, "info_keys", ()))
    if taken := sorted({"return", "length"} & set(info_keys)):
        raise ValueError(
            f"{name}: info_keys: {', '.join(taken)} is what every episode has; wanted other names"
        )
    n_agents, obs_dim, n_actions = team_sizes(env, name)
    return EnvSpec(
        name=name,
        version=str(env.metadata.get("name", type(game).__name__)),
        options=json.dumps(dict(options), sort_keys=True, separators=(",", ":")),
        n_agents=n_agents,
        n_actions=n_actions,
        obs_dim=obs_dim,
        state_dim=_state_dim(env, np.zeros((n_agents, obs_dim), np.float32)),
        episode_limit=int(limit),
        info_keys=info_keys,
    )


def team_sizes(env: Env, name: str) -> tuple[int, int, int]:
    """Number of agents, of the values that each observes, and of its actions.

    Raises:
        ValueError: agents differ in their spaces, or a space is of an unsupported kind.
    """
    sizes = {agent: (_obs_dim(env, agent), _n_actions(env, agent)) for agent in env.possible_agents}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"{name}: wanted equal (observation, action) sizes for all agents, got {sizes}")
    return len(sizes), *next(iter(sizes.values()))


def _state_dim(env: Env, obs: FloatArray) -> int:
    space = getattr(env, "state_space", None)
    if isinstance(space, spaces.Box):
        return int(np.prod(space.shape))
    env.reset(seed=0)
    return len(_state(env, obs))


def _obs_dim(env: Env, agent: str) -> int:
    space = env.observation_space(agent)
    if isinstance(space, spaces.Dict) and {"observation", "action_mask"} <= space.keys():
        space = space["observation"]
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"{agent}: wanted a Box, or a Dict of observation and action_mask, to observe; got {space}"
        )
    return int(np.prod(space.shape))


def _n_actions(env: Env, agent: str) -> int:
    space = env.action_space(agent)
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        raise ValueError(f"{agent}: wanted Discrete actions that start at 0, got {space}")
    return int(space.n)
