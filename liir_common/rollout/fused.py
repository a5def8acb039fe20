"""Battle episodes as one compiled call: simulator, policy and sampling without Python in between."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from liir_common.battle.engine import DEAD_ALLIES, DEAD_ENEMIES, TERMINATED, TRUNCATED, WON, reset, step
from liir_common.battle.env import battle_spec
from liir_common.battle.observation import observe
from liir_common.battle.scenarios import make_battle
from liir_common.rollout.player import Ending, Player
from liir_common.rollout.policy import Choice, Policy, act, first_stuck, stuck_message


@njit(cache=True, nogil=True)
def _play_episode(tables, battle, policy, hidden, rows, seed, choice):
    """Fill `rows`; return the number of steps, and the agent without an action at the end or -1."""
    chosen = np.full(len(hidden), -1)
    t = 0
    reset(tables, battle, seed)
    observe(tables, battle, rows.obs[t], rows.state[t], rows.mask[t], rows.alive[t])
    stuck = first_stuck(rows.mask[t])
    while stuck < 0 and not (battle.status[TERMINATED] or battle.status[TRUNCATED]):
        act(policy, hidden, rows.obs[t], chosen, rows.mask[t], choice, chosen, rows.log_mu[t])
        rows.actions[t] = chosen
        rows.reward[t] = step(tables, battle, chosen)
        t += 1
        observe(tables, battle, rows.obs[t], rows.state[t], rows.mask[t], rows.alive[t])
        stuck = first_stuck(rows.mask[t])
    return t, stuck


class FusedPlayer(Player):
    """Plays battles on one map; the interpreter is free for other threads meanwhile."""

    tickets_held = 4

    def __init__(self, map_name: str, options: dict[str, Any], policy_hidden: int) -> None:
        super().__init__(battle_spec(map_name, **options), policy_hidden)
        self._tables, self._battle = make_battle(map_name, **options)

    def _run(self, policy: Policy, seed: int, choice: Choice) -> Ending:
        length, stuck = _play_episode(
            self._tables, self._battle, policy, self._hidden, self._rows, np.uint64(seed), choice
        )
        if stuck >= 0:
            raise ValueError(stuck_message(stuck, length))
        status = self._battle.status
        figures = {"won": WON, "dead_allies": DEAD_ALLIES, "dead_enemies": DEAD_ENEMIES}
        return Ending(
            length,
            bool(status[TERMINATED]),
            bool(status[TRUNCATED]),
            {key: float(status[figures[key]]) for key in self.spec.info_keys},
        )
