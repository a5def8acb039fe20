"""Maps as data: who stands where, on what terrain, with which goal and limit (SMAC v1's map scripts)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liir_common.battle.parameters import resolve
from liir_common.battle.tables import Battle, Tables, build_battle, build_tables

MAP_SIZE = 32


@dataclass(frozen=True)
class Spawn:
    """One call that creates `count` units around a point."""

    unit_type: str
    count: int
    x: float
    y: float


@dataclass(frozen=True)
class Scenario:
    """One map."""

    name: str
    allies: tuple[Spawn, ...]
    enemies: tuple[Spawn, ...]
    goal: tuple[float, float]
    """Where the enemies' only order, an attack-move, leads."""
    limit: int
    """Environment steps until the episode is truncated."""
    terrain: str
    ally_type_order: tuple[str, ...] = ()
    """Unit types in the order of the one-hot; empty where the map has a single type."""
    enemy_type_order: tuple[str, ...] = ()


def _arena(x0: int, x1: int, y0: int, y1: int, south: int = 0, north: int = 0) -> NDArray[np.bool_]:
    """Cells x0 <= x < x1, y0 <= y < y1 without the triangles of those sizes at the corners."""
    x, y = np.indices((MAP_SIZE, MAP_SIZE))
    inside = (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)
    from_side = np.minimum(x - x0, x1 - 1 - x)
    return inside & (from_side + y - y0 >= south) & (from_side + y1 - 1 - y >= north)


TERRAINS: Mapping[str, NDArray[np.bool_]] = {
    "lane": _arena(2, 30, 7, 25),
    "open": _arena(2, 30, 2, 30),
    "rounded_square": _arena(7, 23, 7, 21, south=3, north=3),
    "pentagon": _arena(7, 21, 7, 25, south=1, north=5),
}
"""[32, 32] by (x, y), true where ground units can stand."""

_WEST, _EAST = (9.0, 16.0), (23.0, 16.0)


def _facing(
    name: str, allies: Mapping[str, int], enemies: Mapping[str, int], limit: int, terrain: str = "lane"
) -> Scenario:
    """Allies in the west, enemies in the east and on their way to where the allies start."""
    several = len(allies) > 1
    return Scenario(
        name,
        allies=tuple(Spawn(unit, count, *_WEST) for unit, count in allies.items()),
        enemies=tuple(Spawn(unit, count, *_EAST) for unit, count in enemies.items()),
        goal=_WEST,
        limit=limit,
        terrain=terrain,
        # SMAC v1 numbers allied stalkers before zealots and enemy zealots before stalkers.
        ally_type_order=("stalker", "zealot") if several else (),
        enemy_type_order=("zealot", "stalker") if several else (),
    )


def _marines(name: str, allies: int, enemies: int, limit: int) -> Scenario:
    return _facing(name, {"marine": allies}, {"marine": enemies}, limit)


_SCENARIOS = (
    _marines("3m", 3, 3, limit=60),
    _marines("8m", 8, 8, limit=120),
    _marines("25m", 25, 25, limit=150),
    _marines("5m_vs_6m", 5, 6, limit=70),
    _marines("8m_vs_9m", 8, 9, limit=120),
    _marines("10m_vs_11m", 10, 11, limit=150),
    _marines("27m_vs_30m", 27, 30, limit=180),
    _facing("2s3z", {"stalker": 2, "zealot": 3}, {"stalker": 2, "zealot": 3}, limit=120),
    _facing("3s5z", {"stalker": 3, "zealot": 5}, {"stalker": 3, "zealot": 5}, limit=150),
    _facing("3s5z_vs_3s6z", {"stalker": 3, "zealot": 5}, {"stalker": 3, "zealot": 6}, limit=170),
    _facing("3s_vs_3z", {"stalker": 3}, {"zealot": 3}, limit=150, terrain="open"),
    _facing("3s_vs_4z", {"stalker": 3}, {"zealot": 4}, limit=200, terrain="open"),
    _facing("3s_vs_5z", {"stalker": 3}, {"zealot": 5}, limit=250, terrain="open"),
    Scenario(
        "6h_vs_8z",
        allies=(Spawn("hydralisk", 6, 14.5998, 9.49),),
        enemies=(Spawn("zealot", 8, 14.41, 16.7597),),
        goal=(14.5998, 9.49),
        limit=150,
        terrain="rounded_square",
    ),
    # The spine crawler has no order in the game; its goal here is where it stands.
    Scenario(
        "2s_vs_1sc",
        allies=(Spawn("stalker", 1, 11.1208, 10.338), Spawn("stalker", 1, 16.976, 10.3662)),
        enemies=(Spawn("spine_crawler", 1, 13.92, 20.0397),),
        goal=(13.92, 20.0397),
        limit=300,
        terrain="pentagon",
    ),
)

SCENARIOS: Mapping[str, Scenario] = {scenario.name: scenario for scenario in _SCENARIOS}


def find_scenario(map_name: str) -> Scenario:
    """The scenario of that name.

    Raises:
        ValueError: there is none; the message lists those that there are.
    """
    if map_name not in SCENARIOS:
        raise ValueError(f"unknown map {map_name!r}; known: {', '.join(SCENARIOS)}")
    return SCENARIOS[map_name]


def make_battle(map_name: str, **options: Any) -> tuple[Tables, Battle]:
    """The read-only tables of a map under some options, and a battle to play on them.

    Raises:
        ValueError: an unknown map or option, or an illegal value.
    """
    scenario = find_scenario(map_name)
    tables = build_tables(scenario, resolve(options), TERRAINS[scenario.terrain])
    return tables, build_battle(tables)
