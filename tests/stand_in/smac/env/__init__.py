"""What `liir_common.smac` uses of SMAC v1's package, with our battle where StarCraft II would run.

Names, arguments, results and states are those of SMAC v1: no seed for a battle, no word about the limit
unless `continuing_episode`, lists where it returns lists, and nothing to see before the first reset.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from liir_common.battle.env import BattleEnv, battle_spec


class StarCraft2Env:
    """SMAC v1's environment; battle number k is our battle with seed `seed` + k."""

    def __init__(
        self,
        map_name: str = "8m",
        seed: int | None = None,
        continuing_episode: bool = False,
        state_last_action: bool = True,
        reward_only_positive: bool = True,
        reward_sparse: bool = False,
        obs_timestep_number: bool = False,
        obs_instead_of_state: bool = False,
    ) -> None:
        rules = {
            "obs_timestep_number": obs_timestep_number,
            "obs_instead_of_state": obs_instead_of_state,
            "state_last_action": state_last_action,
            "reward_only_positive": reward_only_positive,
            "reward_sparse": reward_sparse,
        }
        try:
            self._spec = battle_spec(map_name, **rules)
        except ValueError:
            raise KeyError(map_name) from None
        self._battle = BattleEnv(map_name, **rules)
        self._rules = rules
        self._continuing = continuing_episode
        self._seed = seed
        self._episode_count = 0

    def get_env_info(self) -> dict[str, int]:
        # The step's number is counted once, and takes two places.
        obs_shape = self._spec.obs_dim - self._rules["obs_timestep_number"]
        whole = self._rules["obs_instead_of_state"]
        return {
            "state_shape": self._spec.n_agents * obs_shape if whole else self._spec.state_dim,
            "obs_shape": obs_shape,
            "n_actions": self._spec.n_actions,
            "n_agents": self._spec.n_agents,
            "episode_limit": self._spec.episode_limit,
        }

    def reset(self) -> tuple[list[Any], Any]:
        self._look(self._battle.reset(None if self._seed is None else self._seed + self._episode_count)[0])
        self._episode_count += 1
        return self.get_obs(), self.get_state()

    def step(self, actions: Any) -> tuple[float, bool, dict[str, Any]]:
        agents = self._battle.agents
        for i, action in enumerate(actions):
            assert self.get_avail_agent_actions(i)[action] == 1, f"Agent {i} cannot perform action {action}"
        observations, rewards, terminations, truncations, infos = self._battle.step(
            dict(zip(agents, map(int, actions), strict=True))
        )
        self._look(observations)
        first, truncated = infos[agents[0]], truncations[agents[0]]
        info = {key: first[key] for key in ("battle_won", "dead_allies", "dead_enemies")}
        if truncated and self._continuing:
            info["episode_limit"] = True
        return rewards[agents[0]], terminations[agents[0]] or truncated, info

    def get_obs(self) -> list[Any]:
        return [seen["observation"] for seen in self._seen]

    def get_state(self) -> Any:
        return self._battle.state()

    def get_avail_agent_actions(self, agent_id: int) -> list[int]:
        return self._seen[agent_id]["action_mask"].tolist()

    def get_avail_actions(self) -> list[list[int]]:
        return [self.get_avail_agent_actions(i) for i in range(len(self._seen))]

    def get_unit_by_id(self, a_id: int) -> Any:
        return SimpleNamespace(health=self._battle.snapshot()[a_id]["health"])

    def close(self) -> None:
        self._battle.close()

    def _look(self, observations: dict[str, Any]) -> None:
        self._seen = list(observations.values())
