"""What an agent of a battle may do and sees, as spaces; the same for our battle and for StarCraft II."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete
from numpy.typing import NDArray

INFO_KEYS = ("won", "dead_allies", "dead_enemies")
"""End-of-episode figures of a battle."""

Observation = dict[str, Any]


class AvailableActions(Discrete):
    """Discrete actions of which `sample` without a mask draws one that is available now."""

    def __init__(self, masks: NDArray[np.int8], row: int) -> None:
        """`masks` [n, A] is the environment's, which keeps it up to date; this agent's is one row."""
        super().__init__(masks.shape[1])
        # Not a view of the row: a copy of the environment would tear it from the masks.
        self._masks, self._row = masks, row

    @property
    def available(self) -> NDArray[np.int8]:
        """[A], the mask of now."""
        mask: NDArray[np.int8] = self._masks[self._row]
        return mask

    def sample(
        self, mask: NDArray[np.int8] | None = None, probability: NDArray[Any] | None = None
    ) -> np.int64:
        """One action; at random among the available ones unless a mask or probabilities say otherwise."""
        if mask is None and probability is None:
            mask = self.available
        return super().sample(mask, probability)


def masked_observations(obs_dim: int, n_actions: int) -> Dict:
    """Space of an observation in [-1, 1] with the mask of the actions that are available."""
    return Dict(
        {
            "observation": Box(-1, 1, (obs_dim,), np.float32),
            "action_mask": Box(0, 1, (n_actions,), np.int8),
        }
    )


def joint_action(actions: Mapping[str, Any], spaces: Mapping[str, AvailableActions]) -> NDArray[np.int64]:
    """The team's actions [n], in the order of `spaces`.

    Raises:
        ValueError: an agent's action is missing or not available, or an agent is unknown.
    """
    if set(actions) != set(spaces):
        raise ValueError(f"step wants one action for each of {list(spaces)}, got {sorted(actions)}")
    for agent, space in spaces.items():
        if not (actions[agent] in space and space.available[actions[agent]]):
            raise ValueError(
                f"action {actions[agent]!r} of {agent} is not available; "
                f"its mask allows {np.flatnonzero(space.available).tolist()}"
            )
    return np.array([actions[agent] for agent in spaces], np.int64)
