"""1D Pursuit, the two-agent game of section 5.1 of the LIIR paper, as a PettingZoo ParallelEnv.

Two agents stand on integers and want to reach 0, which nobody tells them. Each moves by +1 or -1 or
stays. The team is paid 0.01 when both approach, -0.01 when both move away, else nothing.

The paper leaves open where the agents start, how long they have and what ends the game. Here they start
on integers of equal chance in [-start, start] without 0, and by default the first agent on the target
ends it: a game that goes on there would pay for stepping off and on again.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv

from liir_common.types import FloatArray

MOVES = (0, 1, -1)
"""What each action adds to the position."""
SCALE = 10.0
"""Positions are divided by this where they are observed."""
REWARD = 0.01

Endings = Literal["any", "all", "never"]
PerAgent = dict[str, Any]


class Pursuit(ParallelEnv[str, Any, Any]):
    """The game; observation [own position, other's position] / 10, state both positions / 10."""

    metadata = {"name": "pursuit_1d_v1", "render_modes": []}  # noqa: RUF012
    info_keys = ("distance",)
    """Sum of the distances to the target at the end."""

    def __init__(self, horizon: int = 20, ending: Endings = "any", start: int = 10) -> None:
        if horizon < 1 or start < 1 or ending not in ("any", "all", "never"):
            raise ValueError(
                "pursuit wants horizon >= 1, start >= 1 and ending any, all or never; "
                f"got horizon={horizon}, start={start}, ending={ending!r}"
            )
        self.episode_limit = horizon
        self._ending, self._start = ending, start
        self.possible_agents = ["agent_0", "agent_1"]
        self.agents: list[str] = []
        farthest = (start + horizon) / SCALE
        self.state_space = spaces.Box(-farthest, farthest, (2,), np.float32)
        self._spaces = {
            agent: (self.state_space, spaces.Discrete(len(MOVES))) for agent in self.possible_agents
        }
        self._random, _ = seeding.np_random()
        self._positions = np.zeros(2, np.int64)
        self._steps = 0

    def observation_space(self, agent: str) -> spaces.Box:
        """Space of one agent's observation."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Space of one agent's action: an index into MOVES."""
        return self._spaces[agent][1]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[PerAgent, PerAgent]:
        """Place both agents; without a seed the random sequence goes on."""
        if seed is not None:
            self._random, _ = seeding.np_random(seed)
        # 0 would be the target: what is below 1 moves down by one, to -start at the lowest.
        draws = self._random.integers(1 - self._start, self._start, 2, endpoint=True)
        self._positions = draws - (draws < 1)
        self._steps = 0
        self.agents = list(self.possible_agents)
        return self._observe(), self._inform()

    def step(self, actions: dict[str, int]) -> tuple[PerAgent, PerAgent, PerAgent, PerAgent, PerAgent]:
        """Move both agents at once.

        Raises:
            ValueError: an agent has no action, or one that is not 0, 1 or 2.
        """
        before = np.abs(self._positions)
        self._positions += [_move(agent, actions) for agent in self.possible_agents]
        self._steps += 1
        nearer = before - np.abs(self._positions)
        reward = REWARD if (nearer > 0).all() else -REWARD if (nearer < 0).all() else 0.0
        terminated, truncated = self._reached(), self._steps >= self.episode_limit
        result = (
            self._observe(),
            self._each(reward),
            self._each(terminated),
            self._each(truncated),
            self._inform(),
        )
        if terminated or truncated:
            self.agents = []
        return result

    def state(self) -> FloatArray:
        """[2], both positions / 10."""
        return (self._positions / SCALE).astype(np.float32)

    def _reached(self) -> bool:
        on_target = self._positions == 0
        return bool({"any": on_target.any(), "all": on_target.all(), "never": False}[self._ending])

    def _observe(self) -> PerAgent:
        first, second = self.state()
        return {
            "agent_0": np.array([first, second], np.float32),
            "agent_1": np.array([second, first], np.float32),
        }

    def _inform(self) -> PerAgent:
        return self._each({"distance": float(np.abs(self._positions).sum())})

    def _each(self, value: Any) -> PerAgent:
        return dict.fromkeys(self.possible_agents, value)


def _move(agent: str, actions: dict[str, int]) -> int:
    action = actions.get(agent, -1)
    if action not in range(len(MOVES)):
        raise ValueError(f"{agent}: wanted an action from 0 to {len(MOVES) - 1}, got {actions.get(agent)}")
    return MOVES[action]


def parallel_env(horizon: int = 20, ending: Endings = "any", start: int = 10) -> Pursuit:
    """The game with at most `horizon` steps, ended early by `any` or `all` agents on the target, or `never`.

    Raises:
        ValueError: a value out of range.
    """
    return Pursuit(horizon, ending, start)
