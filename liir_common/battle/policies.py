"""Scripted policies in compiled code, and whole episodes played with them: for calibration and benchmarks."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liir_common import rng, seeds
from liir_common.battle.engine import (
    DEAD_ALLIES,
    DEAD_ENEMIES,
    NO_OP,
    NORTH,
    STEPS,
    STOP,
    TERMINATED,
    TRUNCATED,
    WON,
    reset,
    step,
)
from liir_common.battle.observation import observe
from liir_common.battle.tables import FIRST_ATTACK, Tables, build_battle, inlined, kernel

RANDOM, STAND, STEP_ASIDE, CLOSEST_ENEMY = range(4)
"""Uniform over available actions; stop; north as long as possible; SMAC v1's built-in heuristic."""


class Buffers(NamedTuple):
    """Where one situation of a battle is written."""

    obs: NDArray[np.float32]
    """[n, O]"""
    state: NDArray[np.float32]
    """[S]"""
    mask: NDArray[np.bool_]
    """[n, A]"""
    alive: NDArray[np.bool_]
    """[n]"""


def make_buffers(tables: Tables) -> Buffers:
    """Buffers of the sizes that `observation.observe` fills."""
    n, actions, obs_dim, state_dim = (
        int(tables.rules[name][0]) for name in ("n_allies", "n_actions", "obs_dim", "state_dim")
    )
    return Buffers(
        np.zeros((n, obs_dim), np.float32),
        np.zeros(state_dim, np.float32),
        np.zeros((n, actions), np.bool_),
        np.zeros(n, np.bool_),
    )


class Memory(NamedTuple):
    """What a scripted team keeps between steps."""

    actions: NDArray[np.int64]
    """[n]"""
    targets: NDArray[np.int64]
    """[n], enemy numbers or -1"""
    stream: NDArray[np.uint64]
    """[1]"""


def play(tables: Tables, policy: int, episodes: int, seed: int = 0) -> NDArray[np.float64]:
    """Play episodes with one of the policies above.

    Returns:
        Outcomes [episodes, 5]: length, return, won, dead allies, dead enemies.
    """
    n = int(tables.rules["n_allies"][0])
    memory = Memory(np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(1, np.uint64))
    outcomes = np.zeros((episodes, 5))
    play_episodes(
        tables, build_battle(tables), make_buffers(tables), memory, policy, np.uint64(seed), outcomes
    )
    return outcomes


@kernel
def play_episodes(tables, battle, buffers, memory, policy, first_seed, outcomes):
    """`play` with everything allocated, one episode per row of outcomes."""
    for episode in range(len(outcomes)):
        seed = rng.derive(first_seed, episode)
        memory.stream[0] = rng.derive(seed, seeds.POLICY)
        memory.targets[:] = -1
        reset(tables, battle, seed)
        observe(tables, battle, buffers.obs, buffers.state, buffers.mask, buffers.alive)
        total = 0.0
        while not (battle.status[TERMINATED] or battle.status[TRUNCATED]):
            _act(tables, battle, buffers.mask, memory, policy)
            total += step(tables, battle, memory.actions)
            observe(tables, battle, buffers.obs, buffers.state, buffers.mask, buffers.alive)
        outcomes[episode, 0] = battle.status[STEPS]
        outcomes[episode, 1] = total
        outcomes[episode, 2] = battle.status[WON]
        outcomes[episode, 3] = battle.status[DEAD_ALLIES]
        outcomes[episode, 4] = battle.status[DEAD_ENEMIES]


@inlined
def _act(tables, battle, mask, memory, policy):
    if policy == RANDOM:
        _act_randomly(mask, memory.stream, memory.actions)
    elif policy == CLOSEST_ENEMY:
        _attack_closest(tables, battle, memory.targets, memory.actions)
    else:
        _act_always(NORTH if policy == STEP_ASIDE else STOP, mask, memory.actions)


@inlined
def _act_randomly(mask, stream, actions):
    for i in range(len(actions)):
        available = 0
        for a in range(mask.shape[1]):
            available += mask[i, a]
        skip, passed, action = np.int64(rng.uniform(stream) * available), 0, 0
        # Without branches, which the processor would guess wrongly.
        for a in range(mask.shape[1]):
            passed += mask[i, a]
            action += passed <= skip
        actions[i] = action


@inlined
def _act_always(action, mask, actions):
    for i in range(len(actions)):
        actions[i] = action if mask[i, action] else (NO_OP if mask[i, NO_OP] else STOP)


@inlined
def _attack_closest(tables, battle, targets, actions):
    """Attack the enemy nearest when the last one died, from any distance: availability does not bind it.

    Healers treat the nearest hurt ally in the same way, and stop where there is none.
    """
    n_allies = tables.rules[0].n_allies
    for i in range(n_allies):
        if not battle.alive[i]:
            actions[i] = NO_OP
            continue
        first = 0 if tables.specs[i].heals else n_allies
        if targets[i] < 0 or not _is_worth(tables, battle, i, first + targets[i]):
            targets[i] = -1
            nearest2 = np.inf
            for j in range(first, n_allies if tables.specs[i].heals else len(battle.units)):
                distance2 = (battle.x[j] - battle.x[i]) ** 2 + (battle.y[j] - battle.y[i]) ** 2
                if distance2 < nearest2 and _is_worth(tables, battle, i, j):
                    nearest2, targets[i] = distance2, j - first
        actions[i] = FIRST_ATTACK + targets[i] if targets[i] >= 0 else STOP


@inlined
def _is_worth(tables, battle, i, j):
    """Whether j is alive and one that i can do something about."""
    spec = tables.specs[j]
    if tables.specs[i].heals:
        return battle.alive[j] and not spec.heals and battle.units[j].health < spec.health
    return battle.alive[j] and tables.pairs[tables.specs[i].kind, spec.kind].damage > 0.0
