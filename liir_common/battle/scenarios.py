"""Maps as data: who stands where, on what terrain, with which goal and limit (SMAC v1's map scripts)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from liir_common.battle.parameters import resolve
from liir_common.battle.tables import FIRST_ATTACK, Battle, Tables, build_battle, build_tables
from liir_common.battle.terrain import TERRAINS
from liir_common.errors import ConfigError


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
    goal: tuple[float, float] | None
    """Where the enemies' only order, an attack-move, leads; None leaves them where they start."""
    limit: int
    """Environment steps until the episode is truncated."""
    terrain: str
    """One of `terrain.TERRAINS`"""
    goal_end: tuple[float, float] | None = None
    """The goal is a random point between `goal` and this one, drawn anew in every episode."""
    hunts: bool = False
    """The enemies' order is to attack the agents themselves; they attack-move nowhere."""
    ally_type_order: tuple[str, ...] = ()
    """Unit types in the order of the one-hot; empty where the map has a single type."""
    enemy_type_order: tuple[str, ...] = ()
    uncertain: str = ""
    """What no source settles about this map in particular, beside the parameters of all maps"""


_WEST, _EAST = (9.0, 16.0), (23.0, 16.0)


def _facing(
    name: str,
    allies: Mapping[str, int],
    enemies: Mapping[str, int],
    limit: int,
    terrain: str = "lane",
    uncertain: str = "",
) -> Scenario:
    """Allies in the west, enemies in the east and on their way to where the allies start."""
    bits = tuple(sorted(allies)) if len(allies) > 1 else ()
    return Scenario(
        name,
        allies=tuple(Spawn(unit, count, *_WEST) for unit, count in allies.items()),
        enemies=tuple(Spawn(unit, count, *_EAST) for unit, count in enemies.items()),
        goal=_WEST,
        limit=limit,
        terrain=terrain,
        ally_type_order=bits,
        # SMAC v1 numbers by the ids of unit types: those of its own are in alphabetical order, but the game's
        # zealot comes before its stalker, which shows where there is no third type.
        enemy_type_order=("zealot", "stalker") if bits == ("stalker", "zealot") else bits,
        uncertain=uncertain,
    )


def _marines(name: str, allies: int, enemies: int, limit: int) -> Scenario:
    return _facing(name, {"marine": allies}, {"marine": enemies}, limit)


_MEDIVACS = (
    "what an enemy medivac does (medivac_follows), whether an agent's heals unasked (medivac_autocast), how "
    "it slows down and turns (here at once)"
)
_BEAMS = (
    "the direction in which beams sweep (inferred: across the shot) and whether an order cancels them "
    "(new_order_cancels_hits)"
)
_BLASTS = "when a blast follows a death (here in the same loop)"
_CROWD = "how a crowd keeps its places around a bend (hold_formation)"

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
    _facing(
        "1c3s5z",
        {"colossus": 1, "stalker": 3, "zealot": 5},
        {"colossus": 1, "stalker": 3, "zealot": 5},
        limit=180,
        uncertain=_BEAMS,
    ),
    _facing(
        "MMM",
        {"marine": 7, "marauder": 2, "medivac": 1},
        {"marine": 7, "marauder": 2, "medivac": 1},
        limit=150,
        uncertain=_MEDIVACS,
    ),
    _facing(
        "MMM2",
        {"marine": 7, "marauder": 2, "medivac": 1},
        {"marine": 8, "marauder": 3, "medivac": 1},
        limit=180,
        uncertain=_MEDIVACS,
    ),
    Scenario(
        "2m_vs_1z",
        allies=(Spawn("marine", 1, 13, 12), Spawn("marine", 1, 19, 12)),
        enemies=(Spawn("zealot", 1, 16, 19),),
        goal=(13, 12),
        goal_end=(19, 12),
        limit=150,
        terrain="octagon",
    ),
    Scenario(
        "corridor",
        allies=(Spawn("zealot", 6, 19.0397, 19.1198),),
        enemies=(Spawn("zergling", 24, 27.91, 28.24),),
        goal=(4.47, 4.3298),
        limit=400,
        terrain="corridor",
        uncertain=_CROWD,
    ),
    Scenario(
        "so_many_baneling",
        allies=(Spawn("zealot", 7, 11.469, 12.0234),),
        enemies=(Spawn("baneling", 32, 27.91, 28.24),),
        goal=(4.47, 4.3298),
        limit=100,
        terrain="baneling_path",
        uncertain=f"{_CROWD}; {_BLASTS}",
    ),
    Scenario(
        "bane_vs_bane",
        allies=(Spawn("zergling", 20, 16, 11), Spawn("baneling", 4, 16, 8)),
        enemies=(Spawn("zergling", 20, 16, 21), Spawn("baneling", 4, 16, 24)),
        goal=(16, 8),
        limit=200,
        terrain="octagon",
        ally_type_order=("baneling", "zergling"),
        enemy_type_order=("baneling", "zergling"),
        uncertain=_BLASTS,
    ),
    Scenario(
        "2c_vs_64zg",
        allies=(Spawn("colossus", 1, 16, 16), Spawn("colossus", 1, 16, 16)),
        enemies=(Spawn("zergling", 64, 16, 9),),
        goal=None,
        hunts=True,
        limit=400,
        terrain="ravine",
        uncertain=f"{_BEAMS}; which colossus a zergling is sent to (hunt_nearest), and what it does then",
    ),
    Scenario(
        "6h_vs_8z",
        allies=(Spawn("hydralisk", 6, 14.5998, 9.49),),
        enemies=(Spawn("zealot", 8, 14.41, 16.7597),),
        goal=(14.5998, 9.49),
        limit=150,
        terrain="rounded_square",
    ),
    Scenario(
        "2s_vs_1sc",
        allies=(Spawn("stalker", 1, 11.1208, 10.338), Spawn("stalker", 1, 16.976, 10.3662)),
        enemies=(Spawn("spine_crawler", 1, 13.92, 20.0397),),
        goal=None,
        limit=300,
        terrain="pentagon",
        uncertain="how long the crawler's tentacle takes (here none)",
    ),
)

SCENARIOS: Mapping[str, Scenario] = {scenario.name: scenario for scenario in _SCENARIOS}


def find_scenario(map_name: str) -> Scenario:
    """The scenario of that name.

    Raises:
        ConfigError: there is none; the message lists those that there are.
    """
    if map_name not in SCENARIOS:
        raise ConfigError(f"unknown map {map_name!r}; known: {', '.join(SCENARIOS)}")
    return SCENARIOS[map_name]


def describe(scenario: Scenario) -> dict[str, Any]:
    """A map as plain values: who fights whom, how long, where, and what is uncertain about it."""
    terrain = TERRAINS[scenario.terrain]
    enemies = _counts(scenario.enemies)
    return {
        "map": scenario.name,
        "agents": _counts(scenario.allies),
        "enemies": enemies,
        "n_actions": FIRST_ATTACK + sum(enemies.values()),
        "limit": scenario.limit,
        "terrain": scenario.terrain,
        "uncertain": "; ".join(filter(None, (terrain.uncertain, scenario.uncertain))),
    }


def _counts(spawns: Sequence[Spawn]) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for spawn in spawns:
        counts[spawn.unit_type] += spawn.count
    return dict(counts)


def make_battle(map_name: str, **options: Any) -> tuple[Tables, Battle]:
    """The read-only tables of a map under some options, and a battle to play on them.

    Raises:
        ValueError: an unknown map or option, or an illegal value.
    """
    tables = build_tables(find_scenario(map_name), resolve(options))
    return tables, build_battle(tables)
