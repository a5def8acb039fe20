"""The battle as a PettingZoo parallel environment."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray
from pettingzoo.utils.env import ParallelEnv

from liir_common.battle import engine, snapshots
from liir_common.battle.observation import observe
from liir_common.battle.parameters import resolve
from liir_common.battle.policies import make_buffers
from liir_common.battle.render import draw_ansi, draw_rgb
from liir_common.battle.scenarios import find_scenario
from liir_common.battle.snapshots import UnitRecord
from liir_common.battle.spaces import (
    INFO_KEYS,
    AvailableActions,
    Observation,
    joint_action,
    masked_observations,
)
from liir_common.battle.tables import build_battle, build_tables, roster
from liir_common.types import EnvSpec


class BattleEnv(ParallelEnv[str, Observation, np.int64]):
    """Micromanagement battle with SMAC v1's rules, actions, observations and rewards.

    Agents stay listed until the episode ends; a dead one has the no-op as its only action, and
    `info["alive"]` says so. All agents get the team's reward. The action mask is in the observation, and
    again in the info for those who wrap observations.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # PettingZoo declares it so
        "name": "battle_v1",
        "render_modes": ["human", "ansi", "rgb_array"],
        "render_fps": 2.8,
        "is_parallelizable": True,
    }
    info_keys = INFO_KEYS

    def __init__(self, map_name: str, render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode wants one of {self.metadata['render_modes']}, got {render_mode!r}")
        scenario, settings = find_scenario(map_name), resolve(options)
        self.render_mode = render_mode
        self.episode_limit = scenario.limit
        self._unit_types = [unit.name for unit in roster(scenario, settings)[0]]
        self._tables = build_tables(scenario, settings)
        self._battle = build_battle(self._tables)
        self._buffers = make_buffers(self._tables)
        n, n_actions = self._buffers.mask.shape
        self._masks = np.zeros((n, n_actions), np.int8)
        self.possible_agents = [f"ally_{i}" for i in range(n)]
        self.agents: list[str] = []
        self._action_spaces = {
            a: AvailableActions(self._masks, i) for i, a in enumerate(self.possible_agents)
        }
        self._observation_spaces = dict.fromkeys(
            self.possible_agents, masked_observations(self._buffers.obs.shape[1], n_actions)
        )
        self.state_space = Box(-np.inf, np.inf, self._buffers.state.shape, np.float32)

    def observation_space(self, agent: str) -> Dict:
        """The observation in [-1, 1] and the action mask of one agent."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> AvailableActions:
        """SMAC v1's actions: no-op, stop, north, south, east, west, then one per enemy: attack it.

        For a medivac they mean allies: heal it.
        """
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: 64-bit seed that determines the whole episode; None takes a random one.
            options: part of PettingZoo's signature; the battle has none.

        Raises:
            ValueError: the seed does not fit 64 bits.
        """
        seed = secrets.randbits(64) if seed is None else seed
        if not 0 <= seed < 2**64:
            raise ValueError(f"a seed wants an integer in [0, 2**64), got {seed!r}")
        engine.reset(self._tables, self._battle, np.uint64(seed))
        self.agents = list(self.possible_agents)
        self._observe()
        return self._observations(), self._infos()

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Play one step of eight game loops.

        Raises:
            RuntimeError: no episode is running.
            ValueError: an agent's action is missing or not available.
        """
        if not self.agents:
            raise RuntimeError("no episode is running; call reset() before step()")
        reward = engine.step(self._tables, self._battle, joint_action(actions, self._action_spaces))
        self._observe()
        status = self._battle.status
        results = (
            self._observations(),
            dict.fromkeys(self.agents, float(reward)),
            dict.fromkeys(self.agents, bool(status[engine.TERMINATED])),
            dict.fromkeys(self.agents, bool(status[engine.TRUNCATED])),
            self._infos(),
        )
        if status[engine.TERMINATED] or status[engine.TRUNCATED]:
            self.agents = []
        return results

    def state(self) -> NDArray[np.float32]:
        """SMAC v1's global state [S]."""
        return self._buffers.state.copy()

    def snapshot(self) -> list[UnitRecord]:
        """All units as plain records, allies first."""
        return snapshots.take(self._tables, self._battle, self._unit_types)

    def restore(self, snapshot: Sequence[UnitRecord]) -> None:
        """Put units into the recorded situation.

        Attacks and missiles that are under way end, and shields wait as after a hit. A refused snapshot
        changes nothing.

        Raises:
            RuntimeError: no episode is running.
            ValueError: other units than the map's, or a unit that cannot be so.
        """
        if not self.agents:
            raise RuntimeError("no episode is running; call reset() before restore()")
        snapshots.put(self._tables, self._battle, self._unit_types, snapshot)
        n, alive = len(self.possible_agents), self._battle.alive
        self._battle.status[engine.DEAD_ALLIES] = n - alive[:n].sum()
        self._battle.status[engine.DEAD_ENEMIES] = len(self._battle.units) - n - alive[n:].sum()
        self._observe()

    def render(self) -> str | NDArray[np.uint8] | None:
        """The battlefield as text ("ansi"), printed ("human") or as an image [H, W, 3] ("rgb_array")."""
        if self.render_mode == "ansi":
            return draw_ansi(self.snapshot(), self._tables.pathing)
        if self.render_mode == "rgb_array":
            return draw_rgb(self.snapshot(), self._tables.pathing)
        if self.render_mode == "human":
            print(draw_ansi(self.snapshot(), self._tables.pathing))
        return None

    def _observe(self) -> None:
        observe(self._tables, self._battle, *self._buffers)
        self._masks[:] = self._buffers.mask

    def _observations(self) -> dict[str, Observation]:
        return {
            agent: {"observation": obs.copy(), "action_mask": mask.copy()}
            for agent, obs, mask in zip(self.agents, self._buffers.obs, self._masks, strict=True)
        }

    def _infos(self) -> dict[str, dict[str, Any]]:
        figures = self._figures()
        return {
            agent: {"alive": bool(alive), "action_mask": mask.copy(), **figures}
            for agent, alive, mask in zip(self.agents, self._buffers.alive, self._masks, strict=True)
        }

    def _figures(self) -> dict[str, Any]:
        """What SMAC v1 says of the battle in every step, and at its end what training reads."""
        status = self._battle.status
        figures: dict[str, Any] = {
            "battle_won": bool(status[engine.WON]),
            "dead_allies": int(status[engine.DEAD_ALLIES]),
            "dead_enemies": int(status[engine.DEAD_ENEMIES]),
        }
        if status[engine.TERMINATED] or status[engine.TRUNCATED]:
            figures["won"] = int(status[engine.WON])
        if status[engine.TRUNCATED] and self._tables.rules["continuing_episode"][0]:
            figures["episode_limit"] = True
        return figures


def parallel_env(map_name: str, render_mode: str | None = None, **options: Any) -> BattleEnv:
    """Make a battle.

    Args:
        map_name: one of `scenarios.SCENARIOS`.
        render_mode: None, "human", "ansi" or "rgb_array".
        options: fields of `parameters.Settings`.

    Raises:
        ValueError: an unknown map or option, or an illegal value.
    """
    return BattleEnv(map_name, render_mode, **options)


def battle_spec(map_name: str, **options: Any) -> EnvSpec:
    """What `parallel_env` and `make_battle` with the same arguments look like from outside.

    Raises:
        ValueError: an unknown map or option, or an illegal value.
    """
    scenario, settings = find_scenario(map_name), resolve(options)
    rules = build_tables(scenario, settings).rules[0]
    return EnvSpec(
        name=f"battle/{map_name}",
        version=engine.SIMULATOR_VERSION,
        options=settings.canonical(),
        n_agents=int(rules["n_allies"]),
        n_actions=int(rules["n_actions"]),
        obs_dim=int(rules["obs_dim"]),
        state_dim=int(rules["state_dim"]),
        episode_limit=scenario.limit,
        info_keys=INFO_KEYS,
    )
