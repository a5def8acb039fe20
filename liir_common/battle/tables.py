"""The arrays that the compiled kernels work on, and how they are built from a scenario and settings.

`Tables` is read-only and holds everything that does not change during a battle; `Battle` is all of the
mutable state. Units are numbered allies first, in SMAC v1's order, then enemies. Times are game loops.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from math import cos, dist, pi, sin
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from liir_common.battle.parameters import Settings
from liir_common.battle.units import LIBERTY_UNIT_TYPES, LOOPS_PER_SECOND, UNIT_TYPES, UnitType

if TYPE_CHECKING:
    from liir_common.battle.scenarios import Scenario, Spawn

_Place = tuple[float, float]
_Disc = tuple[_Place, float]
"""A place and the radius of what stands there"""

# Without numba's reference counting a kernel is five times as fast, and cannot allocate.
_OPTIONS: Any = {"error_model": "numpy", "_nrt": False}
kernel = njit(cache=True, nogil=True, **_OPTIONS)
"""Decorator of the functions that are called from outside."""
inlined = njit(forceinline=True, **_OPTIONS)
"""Decorator of their parts, which become one piece of code with them."""

FIRST_ATTACK = 6
"""Actions below: no-op, stop, north, south, east, west."""
SIGHT, SHOOT_RANGE = 9.0, 6.0
"""SMAC v1's ranges, from centre to centre and for all unit types."""
SURROUNDINGS = ((0, 4), (0, -4), (4, 0), (-4, 0), (2, 2), (-2, -2), (2, -2), (-2, 2))
"""Where SMAC v1 probes the ground around a unit."""

_SCALAR = {bool: np.bool_, int: np.int64, float: np.float64}

RULES = np.dtype(
    [(item.name, _SCALAR[type(item.default)]) for item in fields(Settings)]
    + [
        (name, np.int64)
        for name in (
            "n_allies", "n_enemies", "n_actions", "limit", "obs_dim", "state_dim",
            "ally_bits", "enemy_bits", "ally_shields", "enemy_shields", "has_missiles",
        )
    ]
    + [(name, np.float64) for name in ("reward_divisor", "widest_scan2", "widest_contact2")],
    align=True,
)  # fmt: skip
"""Settings, sizes and switches; `Tables.rules` has one row."""

SPEC = np.dtype(
    [(name, np.int64) for name in ("kind", "type_bit", "hits")]
    + [
        (name, np.float64)
        for name in (
            "health", "shield", "armor", "regeneration", "radius", "speed", "period", "damage_point",
            "backswing", "hit_interval", "missile_speed", "cooldown_norm", "per_health", "per_shield",
            "spawn_x", "spawn_y", "goal_x", "goal_y",
        )
    ],
    align=True,
)  # fmt: skip
"""What does not change about a unit; speeds per loop."""

PAIR = np.dtype([(name, np.float64) for name in ("reach2", "scan2", "hold2", "contact", "damage")])
"""Numbers of an (attacker, target) pair of unit types; names ending in 2 are squared distances."""

UNIT = np.dtype(
    [
        (name, np.float64)
        for name in (
            "health", "shield", "energy", "ready_at", "hit_at", "free_at", "hurt_at", "help_at",
            "walked_at", "heading_x", "heading_y", "goal_x", "goal_y", "missile_x", "missile_y",
        )
    ]
    + [(name, np.int64) for name in ("order", "target", "aim", "hits", "attacker", "missile_target")]
    + [("alive", np.bool_)],
    align=True,
)  # fmt: skip
"""The state of a unit. Unit numbers are -1 for nobody; `ready_at` is when the weapon may fire, `hit_at` when
the next of the `hits` still to come lands on `aim`, `free_at` when the unit may walk again."""


class Tables(NamedTuple):
    """All that is fixed about a battle."""

    rules: NDArray[np.void]
    """[1] of RULES"""
    specs: NDArray[np.void]
    """[units] of SPEC"""
    pairs: NDArray[np.void]
    """[kinds, kinds] of PAIR"""
    pathing: NDArray[np.bool_]
    """[32, 32] by (x, y)"""


class Battle(NamedTuple):
    """All that changes."""

    x: NDArray[np.float64]
    """[units]; positions have arrays of their own because most of the time goes into distances"""
    y: NDArray[np.float64]
    """[units]"""
    units: NDArray[np.void]
    """[units] of UNIT"""
    status: NDArray[np.int64]
    """[6], indexed by the constants of `engine`"""
    last_actions: NDArray[np.int64]
    """[n], -1 before the first step"""
    clock: NDArray[np.float64]
    """[1], game loops played"""
    stream: NDArray[np.uint64]
    """[1], the battle's random stream"""


def roster(scenario: Scenario, settings: Settings) -> tuple[list[UnitType], NDArray[np.float64]]:
    """Unit types and spawn positions [units, 2] in the order of unit numbers."""
    types = LIBERTY_UNIT_TYPES if settings.liberty_balance else UNIT_TYPES
    allies = _muster(scenario.allies, types, settings)
    # SMAC v1 sorts its agents by (type, x, y); the ids of its unit types are in alphabetical order.
    allies.sort(key=lambda unit: (unit[0].name, *unit[1]))
    units = allies + _muster(scenario.enemies, types, settings)
    return [unit for unit, _ in units], np.array([place for _, place in units])


def _muster(
    spawns: Sequence[Spawn], types: Mapping[str, UnitType], settings: Settings
) -> list[tuple[UnitType, _Place]]:
    """Put units one by one on the free place nearest to their point, as the candidates come."""
    candidates = _on_grid if settings.grid_spawn else _in_rings
    units: list[tuple[UnitType, _Place]] = []
    discs: list[_Disc] = []
    for spawn in spawns:
        unit, point = types[spawn.unit_type], (spawn.x, spawn.y)
        body = _body(unit, settings)
        for _ in range(spawn.count):
            free = [place for place in candidates(point, body, discs) if _is_free(place, body, discs)]
            place = min(free, key=lambda place: round(dist(place, point), 6))
            discs.append((place, body))
            units.append((unit, place))
    return units


def _body(unit: UnitType, settings: Settings) -> float:
    return unit.separation_radius if settings.separation_collision else unit.radius


def _in_rings(point: _Place, body: float, discs: Sequence[_Disc]) -> list[_Place]:
    """The point, and the six places around every unit that already stands."""
    return [point] + [
        (x + (body + other) * cos(k * pi / 3), y + (body + other) * sin(k * pi / 3))
        for (x, y), other in discs
        for k in range(6)
    ]


def _on_grid(point: _Place, body: float, discs: Sequence[_Disc]) -> list[_Place]:
    """A square grid around the point, with more places than units."""
    side = range(-len(discs) - 1, len(discs) + 2)
    return [(point[0] + 2 * body * i, point[1] + 2 * body * j) for i in side for j in side]


def _is_free(place: _Place, body: float, discs: Sequence[_Disc]) -> bool:
    return all(dist(place, other) > body + radius - 1e-6 for other, radius in discs)


def build_tables(scenario: Scenario, settings: Settings, pathing: NDArray[np.bool_]) -> Tables:
    """Compile a scenario and settings into arrays."""
    units, spawns = roster(scenario, settings)
    n_allies = sum(spawn.count for spawn in scenario.allies)
    kinds = list({unit.name: unit for unit in units}.values())
    specs = np.zeros(len(units), SPEC)
    for i, (unit, spawn) in enumerate(zip(units, spawns, strict=True)):
        bits = scenario.ally_type_order if i < n_allies else scenario.enemy_type_order
        specs[i] = _spec(unit, kinds.index(unit), bits.index(unit.name) if bits else 0, spawn)
    _set_goals(specs[n_allies:], scenario.goal, settings.hold_formation)
    pairs = np.array([[_pair(a, b, settings) for b in kinds] for a in kinds], PAIR)
    rules = _rules(scenario, settings, units, n_allies)
    rules["widest_scan2"], rules["widest_contact2"] = pairs["scan2"].max(), pairs["contact"].max() ** 2
    return Tables(
        rules=rules,
        specs=specs,
        pairs=pairs,
        pathing=pathing,
    )


def _spec(unit: UnitType, kind: int, type_bit: int, spawn: NDArray[np.float64]) -> tuple[float, ...]:
    weapon, loops = unit.weapon, LOOPS_PER_SECOND
    values = {
        "kind": kind,
        "type_bit": type_bit,
        "hits": weapon.hits,
        "health": unit.health,
        "shield": unit.shield,
        "armor": unit.armor,
        "regeneration": unit.regeneration / loops,
        "per_health": 1 / unit.health,
        "per_shield": 1 / unit.shield if unit.shield else 0.0,
        "radius": unit.radius,
        "speed": unit.speed / loops,
        "period": weapon.period * loops,
        "damage_point": weapon.damage_point * loops,
        "backswing": weapon.backswing * loops,
        "hit_interval": weapon.hit_interval * loops,
        "missile_speed": weapon.missile_speed / loops,
        "cooldown_norm": unit.cooldown_norm,
        "spawn_x": spawn[0],
        "spawn_y": spawn[1],
        "goal_x": 0.0,
        "goal_y": 0.0,
    }
    assert SPEC.names is not None
    return tuple(values[name] for name in SPEC.names)


def _set_goals(enemies: NDArray[np.void], goal: tuple[float, float], hold_formation: bool) -> None:
    for axis, centre in zip("xy", goal, strict=True):
        places = enemies[f"spawn_{axis}"]
        enemies[f"goal_{axis}"] = centre + (places - places.mean() if hold_formation else 0.0)


def _pair(attacker: UnitType, target: UnitType, settings: Settings) -> tuple[float, ...]:
    radii = attacker.radius + target.radius
    weapon = attacker.weapon
    reach = weapon.range + radii
    scan = max(weapon.range, weapon.scan_range) + radii * settings.scan_adds_radii
    contact = _body(attacker, settings) + _body(target, settings)
    bonus = sum(extra for name, extra in (weapon.bonus or {}).items() if name in target.attributes)
    hold = reach if settings.drop_beyond_reach else scan
    # A hair less than the sum, so that rounding makes no overlap of units that stand side by side.
    return reach**2, scan**2, hold**2, contact * (1 - 1e-9), weapon.damage + bonus


def _rules(
    scenario: Scenario, settings: Settings, units: Sequence[UnitType], n_allies: int
) -> NDArray[np.void]:
    rules = np.zeros(1, RULES)
    for name, value in asdict(settings).items():
        rules[name] = value
    rules["obs_own_health"] |= settings.obs_all_health
    enemies = units[n_allies:]
    rules["n_allies"], rules["n_enemies"] = n_allies, len(enemies)
    rules["n_actions"] = FIRST_ATTACK + len(enemies)
    rules["limit"] = scenario.limit
    rules["ally_bits"], rules["enemy_bits"] = len(scenario.ally_type_order), len(scenario.enemy_type_order)
    # SMAC v1 shows shields of the race that has them.
    rules["ally_shields"] = any(unit.shield for unit in units[:n_allies])
    rules["enemy_shields"] = any(unit.shield for unit in enemies)
    rules["has_missiles"] = any(unit.weapon.missile_speed for unit in units)
    rules["obs_dim"], rules["state_dim"] = _sizes(rules[0])
    rules["reward_divisor"] = _reward_divisor(settings, enemies)
    return rules


def _sizes(rules: Any) -> tuple[int, int]:
    """Lengths of an observation and of the state."""
    n, m, actions = int(rules["n_allies"]), int(rules["n_enemies"]), int(rules["n_actions"])
    ally = int(rules["ally_bits"])
    enemy = int(rules["enemy_bits"])
    ally_health, enemy_health = 1 + int(rules["ally_shields"]), 1 + int(rules["enemy_shields"])
    seen = int(rules["obs_all_health"])
    obs = 4 + int(rules["obs_pathing_grid"]) * len(SURROUNDINGS) + m * (4 + seen * enemy_health + enemy)
    obs += (n - 1) * (4 + seen * ally_health + ally + int(rules["obs_last_action"]) * actions)
    obs += int(rules["obs_own_health"]) * ally_health + ally
    # SMAC v1 leaves one more place in the own features than it fills, and then appends the step number.
    obs += 2 * int(rules["obs_timestep_number"])
    state = n * (3 + ally_health + ally) + m * (2 + enemy_health + enemy)
    state += int(rules["state_last_action"]) * n * actions + int(rules["state_timestep_number"])
    return obs, n * obs if rules["obs_instead_of_state"] else state


def _reward_divisor(settings: Settings, enemies: Sequence[UnitType]) -> float:
    if not settings.reward_scale:
        return 1.0
    vitality = sum(unit.health + unit.shield for unit in enemies) * (2 if settings.double_max_reward else 1)
    largest = len(enemies) * settings.reward_death_value + settings.reward_win + vitality
    return largest / settings.reward_scale_rate


def build_battle(tables: Tables) -> Battle:
    """A battle to be started with `engine.reset`."""
    n_allies = int(tables.rules["n_allies"][0])
    return Battle(
        x=np.zeros(len(tables.specs)),
        y=np.zeros(len(tables.specs)),
        units=np.zeros(len(tables.specs), UNIT),
        status=np.zeros(6, np.int64),
        last_actions=np.full(n_allies, -1, np.int64),
        clock=np.zeros(1),
        stream=np.zeros(1, np.uint64),
    )
