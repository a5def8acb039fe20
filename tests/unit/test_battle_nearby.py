"""Sets of units against plain loops."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numba import njit

from liir_common.battle.engine import reset
from liir_common.battle.motion import separate, separate_many
from liir_common.battle.nearby import above, holds, lowest, members, near, only
from liir_common.battle.parameters import Settings
from liir_common.battle.scenarios import SCENARIOS, Spawn, make_battle
from liir_common.battle.tables import SET_SIZE, Battle, Tables, build_battle, build_tables

NOW = 1000.0


@njit
def sets_of(battle: Any, i: int, radii2: Any, first: int, last: int) -> Any:
    return near(battle, i, radii2, first, last), members(battle.alive, first)


@njit
def bits(k: int, numbers: Any) -> Any:
    return only(k), above(k), lowest(only(k)), lowest(only(k) | above(k)), holds(numbers, k)


@njit
def separate_both(tables: Any, one: Any, other: Any, walkers: Any, now: float) -> None:
    separate(tables, one, walkers)
    separate_many(tables, other, now)


def make(name: str) -> tuple[Tables, Battle]:
    """A battle of a map, or of as many marines a side as a set can hold together."""
    if name != "32m":
        return make_battle(name)
    half = (Spawn("marine", SET_SIZE // 2, 16, 16),)
    tables = build_tables(replace(SCENARIOS["3m"], allies=half, enemies=half), Settings())
    return tables, build_battle(tables)


def crowd(map_name: str, seed: int, side: float) -> tuple[Tables, Battle, np.ndarray[Any, Any]]:
    """Units in a square, a third of them dead and half of all walking somewhere; and who walks."""
    tables, battle = make(map_name)
    reset(tables, battle, np.uint64(seed))
    rng, n = np.random.default_rng(seed), len(battle.units)
    battle.x[:n], battle.y[:n] = 16 + side * rng.random((2, n))
    battle.alive[:n] = rng.random(n) < 2 / 3
    walks = rng.random(n) < 0.5
    battle.units["walked_at"] = np.where(walks, NOW, NOW - 1)
    battle.units["heading_x"], battle.units["heading_y"] = rng.normal(size=(2, n))
    battle.units["order"] = rng.integers(0, 4, n)
    return tables, battle, walks


def as_set(truths: Any) -> int:
    return sum(1 << k for k, truth in enumerate(truths) if truth)


@pytest.mark.parametrize("k", [0, 1, 31, 32, 62, 63])
def test_bits(k: int) -> None:
    everybody = 2**SET_SIZE - 1
    for numbers in (0, 1 << k, everybody - (1 << k), everybody):
        found = bits(k, np.uint64(numbers))
        assert found == (1 << k, everybody - (2 ** (k + 1) - 1), k, k, bool(numbers >> k & 1))


@pytest.mark.parametrize(
    ("map_name", "first", "last"), [("3m", 0, 3), ("3m", 3, 6), ("3s5z", 0, 16), ("2c_vs_64zg", 2, 66)]
)
@pytest.mark.parametrize("one_radius", [True, False])
def test_near_and_living_are_what_loops_find(map_name: str, first: int, last: int, one_radius: bool) -> None:
    shares = []
    for seed in range(20):
        tables, battle, _ = crowd(map_name, seed, side=4.0)
        units = range(first, last)
        radii2 = 4.0 if one_radius else tables.contact2[tables.specs["kind"][-1]]
        limits2 = np.broadcast_to(radii2, len(battle.x))
        found, living = sets_of(battle, 0, radii2, first, last)
        x, y = battle.x - battle.x[0], battle.y - battle.y[0]
        is_near = [x[j] ** 2 + y[j] ** 2 < limits2[j] for j in units]
        # Whoever stands behind the last one is not asked for.
        within = 2 ** (last - first) - 1
        assert found & within == as_set(is_near), "near"
        assert living & within == as_set(battle.alive[first:last]), "living"
        shares.append(np.mean(is_near))
    assert 0 < np.mean(shares) < 1


def test_nobody_lives_behind_the_last_unit() -> None:
    _, battle, _ = crowd("2c_vs_64zg", seed=1, side=4.0)
    battle.alive[: len(battle.units)] = True
    for first in (2, 40, 65):
        _, living = sets_of(battle, 0, 1.0, first, 66)
        assert living == as_set([True] * (66 - first))


def test_a_team_larger_than_a_set_is_refused() -> None:
    many = replace(SCENARIOS["3m"], enemies=(Spawn("marine", 65, 16, 16),))
    with pytest.raises(ValueError, match=r"3m wants teams of at most 64 units, got \(3, 65\)"):
        build_tables(many, Settings())


@pytest.mark.parametrize("map_name", ["3m", "3s5z", "MMM", "27m_vs_30m", "32m"])
def test_units_are_pushed_as_by_plain_loops(map_name: str) -> None:
    """Bit for bit, in crowds where pushes make new overlaps."""
    pushed = 0
    for seed in range(50):
        tables, battle, walks = crowd(map_name, seed, side=0.2 * len(make(map_name)[1].units) ** 0.5 + 1)
        other = deepcopy(battle)
        before = battle.x.copy()
        separate_both(tables, battle, other, np.uint64(as_set(walks)), NOW)
        assert all(np.array_equal(a, b) for a, b in zip(battle, other, strict=True))
        pushed += int((battle.x != before).sum())
    assert pushed > 50
