"""How fast the simulator is, with everything written that training needs."""

from __future__ import annotations

import time
from statistics import median
from typing import Any

import numpy as np

from liir_common.battle.policies import RANDOM, make_buffers, play_episodes
from liir_common.battle.scenarios import make_battle


def bench_sim(map_name: str, episodes: int = 2000, repeats: int = 5) -> dict[str, Any]:
    """Median environment steps per second of CPU time on one core, uniformly random actions.

    Observations, state, masks and resets are included, compiling is not.
    """
    tables, battle = make_battle(map_name)
    buffers = make_buffers(tables)
    outcomes = np.zeros((episodes, 5))
    play_episodes(tables, battle, buffers, RANDOM, np.uint64(0), outcomes[:1])
    rates = []
    for repeat in range(repeats):
        start = time.process_time()
        play_episodes(tables, battle, buffers, RANDOM, np.uint64(repeat), outcomes)
        rates.append(float(outcomes[:, 0].sum()) / (time.process_time() - start))
    return {
        "map": map_name,
        "env_steps_per_s": median(rates),
        "mean_length": float(outcomes[:, 0].mean()),
        "episodes": episodes,
        "repeats": repeats,
    }
