"""How fast episodes are played, and how fast the policy's arithmetic alone would let them be."""

from __future__ import annotations

import time
from statistics import median
from typing import Any

import numpy as np
from numba import njit

from liir_common.config import EnvConfig
from liir_common.rollout.play import make_player
from liir_common.rollout.policy import random_weights
from liir_common.types import EnvSpec, Exploration, Ticket

_DEGREE = 8


def bench_rollout(
    env: EnvConfig, episodes: int = 500, repeats: int = 5, policy_hidden: int = 64
) -> dict[str, Any]:
    """Median environment steps per second of CPU time on one core, with a random policy.

    The whole of `Player.play` is timed, compiling is not. The floor is the time that the policy's
    multiply-adds take at the rate `multiply_add_peak` measures: what is above it is the simulator,
    sampling, and memory traffic.
    """
    player = make_player(env, policy_hidden)
    player.load(random_weights(player.spec, policy_hidden, seed=0))
    tickets = [Ticket.for_training(0, i, 0, Exploration.SOFTMAX_FLOOR, 0.1) for i in range(episodes)]
    player.play(tickets[0])
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        steps = sum(player.play(ticket).length for ticket in tickets)
        seconds.append((time.process_time() - start) / steps)
    multiply_adds, peak = multiply_adds_per_step(player.spec, policy_hidden), multiply_add_peak()
    return {
        "env": player.spec.name,
        "env_steps_per_s": 1 / median(seconds),
        "mean_length": steps / episodes,
        "multiply_adds_per_step": multiply_adds,
        "multiply_add_peak_per_s": peak,
        "floor_steps_per_s": peak / multiply_adds,
        "fraction_of_floor": multiply_adds / peak / median(seconds),
        "episodes": episodes,
        "repeats": repeats,
    }


def multiply_adds_per_step(spec: EnvSpec, policy_hidden: int) -> int:
    """Multiply-adds of one decision of the team; one-hot inputs are additions and do not count."""
    layers = spec.obs_dim + 6 * policy_hidden + spec.n_actions
    return spec.n_agents * policy_hidden * layers


def multiply_add_peak(repeats: int = 7) -> float:
    """Float32 multiply-adds per second of compiled code on this core, with everything in registers."""
    values, passes = np.full(1024, 0.5, np.float32), 500
    _polynomial(values, 1)
    rates = []
    for _ in range(repeats):
        start = time.process_time()
        _polynomial(values, passes)
        rates.append(passes * values.size * _DEGREE / (time.process_time() - start))
    return median(rates)


@njit(cache=True, fastmath={"contract"})
def _polynomial(values, passes):
    """Horner's scheme on every value: independent chains, short enough for the core to overlap them."""
    factor, term = np.float32(0.5), np.float32(0.25)
    for _ in range(passes):
        for i in range(len(values)):
            x = values[i]
            for _ in range(_DEGREE):
                x = x * factor + term
            values[i] = x
