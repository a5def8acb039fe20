"""How fast the simulator is, with everything written that training needs."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from liir_common.battle.policies import RANDOM, play
from liir_common.battle.scenarios import make_battle


def bench_sim(map_name: str, episodes: int = 2000, repeats: int = 5) -> dict[str, Any]:
    """Median over repeats of the environment steps per second of CPU time, on one core.

    Uniformly random available actions; observations, state, masks and resets are included, compiling is not.
    """
    tables, _ = make_battle(map_name)
    play(tables, RANDOM, episodes=1)
    rates = []
    for repeat in range(repeats):
        start = time.process_time()
        outcomes = play(tables, RANDOM, episodes, seed=repeat)
        rates.append(float(outcomes[:, 0].sum()) / (time.process_time() - start))
    return {
        "map": map_name,
        "env_steps_per_s": median(rates),
        "mean_length": float(outcomes[:, 0].mean()),
        "episodes": episodes,
        "repeats": repeats,
    }


_FIRST_EPISODE = """
import sys, time
from liir_common.battle.policies import RANDOM, play
from liir_common.battle.scenarios import make_battle
tables, _ = make_battle(sys.argv[1])
start = time.process_time()
play(tables, RANDOM, episodes=1)
print(time.process_time() - start)
"""


def bench_compile(map_name: str) -> dict[str, float]:
    """Seconds of CPU time of a process's first episode: compiling, and loading what has been compiled."""
    with TemporaryDirectory() as cache:
        return {name: _first_episode(map_name, cache) for name in ("compile_s", "load_s")}


def _first_episode(map_name: str, cache: str) -> float:
    command = [sys.executable, "-c", _FIRST_EPISODE, map_name]
    env = {**os.environ, "NUMBA_CACHE_DIR": cache}
    done = subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)
