"""StarCraft II itself as a PettingZoo ParallelEnv, through SMAC v1's own package.

Source of the methods called here: Samvelyan et al., "The StarCraft Multi-Agent Challenge", 2019, and
its code, SMAC v1. The package and the game are no requirements of this project.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict
from pettingzoo import ParallelEnv

from liir_common.battle.spaces import (
    INFO_KEYS,
    AvailableActions,
    Observation,
    joint_action,
    masked_observations,
)
from liir_common.errors import ConfigError, EpisodeLostError
from liir_common.types import FloatArray

_FIGURES: Mapping[str, type] = {"battle_won": bool, "dead_allies": int, "dead_enemies": int}
"""What SMAC says of the battle in every step"""


class SmacEnv(ParallelEnv[str, Observation, np.int64]):
    """A map of SMAC v1, from outside the same as `BattleEnv` of that map.

    The game starts with the first reset and goes on from battle to battle. It takes a seed when it
    starts, from SMAC's option `seed`, and none for a single battle.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # PettingZoo declares it so
        "name": "smac_v1",
        "render_modes": [],
        "is_parallelizable": True,
    }
    info_keys = INFO_KEYS

    def __init__(self, map_name: str, **options: Any) -> None:
        self._game = _start(map_name, options)
        sizes = self._game.get_env_info()
        n, n_actions, obs_dim = sizes["n_agents"], sizes["n_actions"], sizes["obs_shape"]
        # Observations with the step's number have one place more than SMAC says.
        obs_dim += bool(options.get("obs_timestep_number"))
        state_dim = n * obs_dim if options.get("obs_instead_of_state") else sizes["state_shape"]
        self.episode_limit = int(sizes["episode_limit"])
        self.possible_agents = [f"ally_{i}" for i in range(n)]
        self.agents: list[str] = []
        self._obs = np.zeros((n, obs_dim), np.float32)
        self._masks = np.zeros((n, n_actions), np.int8)
        self._action_spaces = {
            a: AvailableActions(self._masks, i) for i, a in enumerate(self.possible_agents)
        }
        self._observation_spaces = dict.fromkeys(
            self.possible_agents, masked_observations(obs_dim, n_actions)
        )
        self.state_space = Box(-np.inf, np.inf, (state_dim,), np.float32)

    def observation_space(self, agent: str) -> Dict:
        """The observation in [-1, 1] and the action mask of one agent."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> AvailableActions:
        """SMAC's actions: no-op, stop, north, south, east, west, then one per enemy."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start a battle; seed and options are part of PettingZoo's signature, SMAC has neither here."""
        self._game.reset()
        self.agents = list(self.possible_agents)
        self._observe()
        return self._observations(), self._infos(dict.fromkeys(_FIGURES, 0), ended=False)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Play one step.

        Raises:
            EpisodeLostError: StarCraft II broke down, and SMAC started it again.
            RuntimeError: no battle is running.
            ValueError: an agent's action is missing or not available.
        """
        if not self.agents:
            raise RuntimeError("no battle is running; call reset() before step()")
        reward, ended, outcome = self._game.step(joint_action(actions, self._action_spaces))
        if "battle_won" not in outcome:
            self.agents = []
            raise EpisodeLostError("StarCraft II broke down in this battle; SMAC started it again")
        self._observe()
        # Only `continuing_episode` makes SMAC say so.
        at_limit = bool(outcome.get("episode_limit", False))
        results = (
            self._observations(),
            dict.fromkeys(self.agents, float(reward)),
            dict.fromkeys(self.agents, bool(ended) and not at_limit),
            dict.fromkeys(self.agents, at_limit),
            self._infos(outcome, ended),
        )
        if ended:
            self.agents = []
        return results

    def state(self) -> FloatArray:
        """SMAC's global state [S]."""
        return np.asarray(self._game.get_state(), np.float32)

    def close(self) -> None:
        """End the game."""
        self._game.close()

    def _observe(self) -> None:
        self._obs[:] = self._game.get_obs()
        self._masks[:] = self._game.get_avail_actions()

    def _observations(self) -> dict[str, Observation]:
        return {
            agent: {"observation": obs.copy(), "action_mask": mask.copy()}
            for agent, obs, mask in zip(self.agents, self._obs, self._masks, strict=True)
        }

    def _infos(self, outcome: dict[str, Any], ended: bool) -> dict[str, dict[str, Any]]:
        figures = {name: kind(outcome[name]) for name, kind in _FIGURES.items()}
        if ended:
            figures["won"] = int(outcome["battle_won"])
        return {
            agent: {
                "alive": bool(self._game.get_unit_by_id(i).health > 0),
                "action_mask": mask.copy(),
                **figures,
            }
            for i, (agent, mask) in enumerate(zip(self.agents, self._masks, strict=True))
        }


def _start(map_name: str, options: dict[str, Any]) -> Any:
    """SMAC's own environment, which tells its sizes before the game runs."""
    try:
        from smac.env import StarCraft2Env
    # protobuf raises a TypeError when it meets StarCraft's older generated code.
    except (ImportError, TypeError) as error:
        raise ConfigError(
            "env.kind smac wants StarCraft II and the package smac of github.com/oxwhirl/smac, not the "
            f"optimiser of that name; docs/environments.md says how to install them. Importing it: {error}"
        ) from error
    try:
        return StarCraft2Env(map_name=map_name, continuing_episode=True, **options)
    except (KeyError, TypeError) as error:
        raise ConfigError(
            f"SMAC's StarCraft2Env refuses env.map {map_name!r} with env.options {options}: {error!r}"
        ) from error
