"""The arrays that the compiled kernels work on, and how they are built from a scenario and settings.

`Tables` is read-only and holds everything that does not change during a battle; `Battle` is all of the
mutable state. Units are numbered allies first, in SMAC v1's order, then enemies. Times are game loops.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from math import cos, dist, pi, sin
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from liir_common.battle.parameters import Settings
from liir_common.battle.terrain import AIR, TERRAINS, routes
from liir_common.battle.units import (
    ENERGY_START,
    HEALING_RANGE,
    HEALING_SEARCH,
    LOOPS_PER_SECOND,
    UnitType,
    Weapon,
    unit_types,
)

if TYPE_CHECKING:
    from liir_common.battle.scenarios import Scenario, Spawn

_Place = tuple[float, float]
_Disc = tuple[_Place, float]
"""A place and the radius of what stands there"""

# Without numba's reference counting a kernel is five times as fast, and cannot allocate.
_OPTIONS: Any = {"error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True}
# What takes all those arrays apart for calls from Python was half of the time to compile.
_PART_OPTIONS: Any = _OPTIONS | {"no_cpython_wrapper": True}
kernel = njit(cache=True, nogil=True, **_OPTIONS)
"""Decorator of the functions that are called from outside."""
inlined = njit(forceinline=True, **_PART_OPTIONS)
"""Decorator of their parts, which become one piece of code with them."""
apart = njit(**_PART_OPTIONS)
"""Decorator of parts that few maps need, which stay pieces of code of their own."""

FIRST_ATTACK = 6
"""Actions below: no-op, stop, north, south, east, west."""
IDLE, MOVE, ATTACK, ATTACK_MOVE = range(4)
"""Only a unit that attack-moves picks targets of its own: all enemies do, no ally does."""
ORDERS = ("idle", "move", "attack", "attack_move")
SET_SIZE = 64
"""The most units that a set of `nearby` holds, and so the largest team."""
SIGHT, SHOOT_RANGE = 9.0, 6.0
"""SMAC v1's ranges, from centre to centre and for all unit types."""
SURROUNDINGS = ((0, 2), (0, -2), (2, 0), (-2, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
"""Where SMAC v1 probes the ground around a unit, in lengths of a move."""

_SCALAR = {bool: np.bool_, int: np.int64, float: np.float64}
_NUMBERS = [item.name for item in fields(Settings) if type(item.default) in _SCALAR]

RULES = np.dtype(
    [(name, _SCALAR[type(getattr(Settings, name))]) for name in _NUMBERS]
    + [
        (name, np.int64)
        for name in (
            "n_allies", "n_enemies", "n_actions", "limit", "obs_dim", "state_dim",
            "ally_bits", "enemy_bits", "ally_shields", "enemy_shields", "has_missiles",
            "has_healers", "has_areas", "has_obstacles", "hunts",
        )
    ]
    + [
        (name, np.float64)
        for name in ("reward_divisor", "widest_scan2", "goal_span_x", "goal_span_y")
    ],
    align=True,
)  # fmt: skip
"""Settings that are numbers, sizes and switches; `Tables.rules` has one row. The `has_` switches keep what a
map lacks out of its loops."""

SPEC = np.dtype(
    [(name, np.uint32) for name in ("kind", "layer")]
    + [(name, np.int64) for name in ("type_bit", "hits", "beams", "heals", "biological")]
    + [
        (name, np.float64)
        for name in (
            "health", "shield", "armor", "regeneration", "radius", "speed", "period", "damage_point",
            "backswing", "hit_interval", "missile_speed", "cooldown_norm", "per_health", "per_shield",
            "spawn_x", "spawn_y", "goal_x", "goal_y", "energy", "acceleration", "blast",
        )
    ],
    align=True,
)  # fmt: skip
"""What does not change about a unit; speeds per loop. Row numbers are unsigned, because a signed index costs
a test for being negative."""

_UNARMED = Weapon(damage=0, range=0, scan_range=0, period=0, damage_point=0, backswing=0, hits=0)

PAIR = np.dtype([(name, np.float64) for name in ("reach2", "scan2", "hold2", "contact", "damage")])
"""Numbers of an (attacker, target) pair of unit types; names ending in 2 are squared distances. Damage is 0
and the scan range negative where there can be no attack; a healer's ranges are those of healing."""

UNIT = np.dtype(
    [
        (name, np.float64)
        for name in (
            "health", "shield", "energy", "ready_at", "hit_at", "free_at", "hurt_at", "help_at",
            "walked_at", "pace", "heading_x", "heading_y", "goal_x", "goal_y", "missile_x", "missile_y",
        )
    ]
    + [(name, np.int64) for name in ("order", "target", "aim", "hits", "attacker", "missile_target")],
    align=True,
)  # fmt: skip
"""The state of a unit. Unit numbers are -1 for nobody; `ready_at` is when the weapon may fire, `hit_at` when
the next of the `hits` still to come lands on `aim`, `free_at` when the unit may walk again. Beams keep in
`missile_x` and `missile_y` where they were aimed at, and a dead unit's `hits` is a blast to come."""


class Tables(NamedTuple):
    """All that is fixed about a battle."""

    rules: NDArray[np.void]
    """[1] of RULES"""
    specs: NDArray[np.void]
    """[units] of SPEC"""
    pairs: NDArray[np.void]
    """[kinds, kinds] of PAIR"""
    contact2: NDArray[np.float64]
    """[kinds, room], the squared distance at which a unit of that kind touches that unit"""
    pathing: NDArray[np.bool_]
    """[32, 32] by (x, y), as SMAC v1 sees it"""
    layers: NDArray[np.bool_]
    """[3, 32, 32], the cells that units of a layer can enter"""
    height: NDArray[np.float64]
    """[32, 32], as SMAC v1 normalises it"""
    routes: NDArray[np.int16]
    """[1024, 1024] or [0, 0], see `terrain.routes`"""


class Battle(NamedTuple):
    """All that changes.

    Positions and lives have arrays of their own, of which `nearby` makes sets of units; all have room for
    SET_SIZE more behind the last unit, who never live.
    """

    x: NDArray[np.float64]
    """[room]"""
    y: NDArray[np.float64]
    """[room]"""
    alive: NDArray[np.bool_]
    """[room]"""
    units: NDArray[np.void]
    """[units] of UNIT"""
    status: NDArray[np.int64]
    """[7], indexed by the constants of `engine`"""
    last_actions: NDArray[np.int64]
    """[n], -1 before the first step"""
    clock: NDArray[np.float64]
    """[1], game loops played"""
    stream: NDArray[np.uint64]
    """[1], the battle's random stream"""


def roster(scenario: Scenario, settings: Settings) -> tuple[list[UnitType], NDArray[np.float64]]:
    """Unit types and spawn positions [units, 2] in the order of unit numbers."""
    layers = TERRAINS[scenario.terrain].layers
    allies = _muster(scenario.allies, unit_types(settings.balance, enemy=False), settings, layers)
    # SMAC v1 sorts its agents by (type, x, y); the ids of its unit types are in alphabetical order.
    allies.sort(key=lambda unit: (unit[0].name, *unit[1]))
    enemies = _muster(scenario.enemies, unit_types(settings.balance, enemy=True), settings, layers)
    units = allies + enemies
    return [unit for unit, _ in units], np.array([place for _, place in units])


def _muster(
    spawns: Sequence[Spawn], types: Mapping[str, UnitType], settings: Settings, layers: NDArray[np.bool_]
) -> list[tuple[UnitType, _Place]]:
    """Put units one by one on the free place nearest to their point, as the candidates come."""
    candidates = _on_grid if settings.grid_spawn else _in_rings
    units: list[tuple[UnitType, _Place]] = []
    for spawn in spawns:
        unit, point = types[spawn.unit_type], (spawn.x, spawn.y)
        body = _body(unit, settings)
        for _ in range(spawn.count):
            discs = [(place, _body(other, settings)) for other, place in units if other.layer == unit.layer]
            near_first = sorted(
                candidates(point, body, discs), key=lambda place: round(dist(place, point), 6)
            )
            ground = layers[unit.layer]
            units.append((unit, next(place for place in near_first if _is_free(place, body, discs, ground))))
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


def _is_free(place: _Place, body: float, discs: Sequence[_Disc], ground: NDArray[np.bool_]) -> bool:
    x, y = place
    inside = 0 <= x < ground.shape[0] and 0 <= y < ground.shape[1] and ground[int(x), int(y)]
    return bool(inside) and all(dist(place, other) > body + radius - 1e-6 for other, radius in discs)


def build_tables(scenario: Scenario, settings: Settings) -> Tables:
    """Compile a scenario and settings into arrays.

    Raises:
        ValueError: a team is too large.
    """
    terrain = TERRAINS[scenario.terrain]
    units, spawns = roster(scenario, settings)
    n_allies = sum(spawn.count for spawn in scenario.allies)
    sizes = n_allies, len(units) - n_allies
    if max(sizes) > SET_SIZE:
        raise ValueError(f"{scenario.name} wants teams of at most {SET_SIZE} units, got {sizes}")
    # By name: teams may differ in how fast a type is, but not in how it fights.
    kinds = {unit.name: unit for unit in units}
    kind_names = list(kinds)
    specs = np.zeros(len(units), SPEC)
    for i, (unit, spawn) in enumerate(zip(units, spawns, strict=True)):
        bits = scenario.ally_type_order if i < n_allies else scenario.enemy_type_order
        specs[i] = _spec(unit, kind_names.index(unit.name), bits.index(unit.name) if bits else 0, spawn)
    if scenario.goal is not None:
        _set_goals(specs[n_allies:], scenario.goal, settings)
    pairs = np.array([[_pair(a, b, settings) for b in kinds.values()] for a in kinds.values()], PAIR)
    rules = _rules(scenario, settings, units, n_allies)
    rules["widest_scan2"] = pairs["scan2"].max()
    return Tables(
        rules=rules,
        specs=specs,
        pairs=pairs,
        contact2=np.pad(pairs["contact"].take(specs["kind"], axis=1) ** 2, ((0, 0), (0, SET_SIZE))),
        pathing=terrain.pathing,
        layers=terrain.layers,
        height=terrain.height,
        routes=routes(scenario.terrain),
    )


def _spec(unit: UnitType, kind: int, type_bit: int, spawn: NDArray[np.float64]) -> tuple[float, ...]:
    loops = LOOPS_PER_SECOND
    weapon = unit.weapon or _UNARMED
    values = {
        "kind": kind,
        "layer": unit.layer,
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
        "goal_x": spawn[0],
        "goal_y": spawn[1],
        "beams": weapon.beams,
        "blast": weapon.blast,
        "heals": unit.weapon is None,
        "biological": "biological" in unit.attributes,
        "energy": ENERGY_START if unit.weapon is None else 0.0,
        "acceleration": unit.acceleration / loops**2,
    }
    assert SPEC.names is not None
    return tuple(values[name] for name in SPEC.names)


def _set_goals(enemies: NDArray[np.void], goal: tuple[float, float], settings: Settings) -> None:
    walks = np.full(len(enemies), True) if settings.medivac_follows else enemies["heals"] == 0
    for axis, centre in zip("xy", goal, strict=True):
        places = enemies[f"spawn_{axis}"]
        offsets = places - places.mean() if settings.hold_formation else 0.0
        enemies[f"goal_{axis}"] = np.where(walks, centre + offsets, places)


def _pair(attacker: UnitType, target: UnitType, settings: Settings) -> tuple[float, ...]:
    radii = attacker.radius + target.radius
    scanned = radii * settings.scan_adds_radii
    contact = 0.0
    if attacker.layer == target.layer:
        # A hair less than the sum, so that rounding makes no overlap of units that stand side by side.
        contact = (_body(attacker, settings) + _body(target, settings)) * (1 - 1e-9)
    weapon = attacker.weapon
    if weapon is None:
        search2 = (HEALING_SEARCH + scanned) ** 2
        return (HEALING_RANGE + radii) ** 2, search2, search2, contact, 0.0
    reach = weapon.range + radii
    if target.layer == AIR and not weapon.hits_air:
        return reach**2, -1.0, -1.0, contact, 0.0
    scan = max(weapon.range, weapon.scan_range) + scanned
    bonus = sum(extra for name, extra in (weapon.bonus or {}).items() if name in target.attributes)
    hold = reach if settings.drop_beyond_reach else scan
    return reach**2, scan**2, hold**2, contact, weapon.damage + bonus


def _rules(
    scenario: Scenario, settings: Settings, units: Sequence[UnitType], n_allies: int
) -> NDArray[np.void]:
    rules = np.zeros(1, RULES)
    for name in _NUMBERS:
        rules[name] = getattr(settings, name)
    rules["obs_own_health"] |= settings.obs_all_health
    enemies = units[n_allies:]
    rules["n_allies"], rules["n_enemies"] = n_allies, len(enemies)
    rules["n_actions"] = FIRST_ATTACK + len(enemies)
    rules["limit"] = scenario.limit
    rules["ally_bits"], rules["enemy_bits"] = len(scenario.ally_type_order), len(scenario.enemy_type_order)
    # SMAC v1 shows shields of the race that has them.
    rules["ally_shields"] = any(unit.shield for unit in units[:n_allies])
    rules["enemy_shields"] = any(unit.shield for unit in enemies)
    weapons = [unit.weapon for unit in units if unit.weapon]
    rules["has_missiles"] = any(weapon.missile_speed for weapon in weapons)
    rules["has_areas"] = any(weapon.beams or weapon.blast for weapon in weapons)
    rules["has_healers"] = len(weapons) < len(units)
    rules["has_obstacles"] = TERRAINS[scenario.terrain].has_obstacles
    rules["hunts"] = scenario.hunts
    if scenario.goal is not None and scenario.goal_end is not None:
        rules["goal_span_x"] = scenario.goal_end[0] - scenario.goal[0]
        rules["goal_span_y"] = scenario.goal_end[1] - scenario.goal[1]
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
    obs = 4 + int(rules["obs_pathing_grid"]) * len(SURROUNDINGS)
    obs += int(rules["obs_terrain_height"]) * (len(SURROUNDINGS) + 1)
    obs += m * (4 + seen * enemy_health + enemy)
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
    n_allies, room = int(tables.rules["n_allies"][0]), tables.contact2.shape[1]
    return Battle(
        x=np.zeros(room),
        y=np.zeros(room),
        alive=np.zeros(room, np.bool_),
        units=np.zeros(len(tables.specs), UNIT),
        status=np.zeros(7, np.int64),
        last_actions=np.full(n_allies, -1, np.int64),
        clock=np.zeros(1),
        stream=np.zeros(1, np.uint64),
    )
