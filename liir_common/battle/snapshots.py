"""Units as plain records, and how a battle is put into a recorded situation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NotRequired, TypedDict

from liir_common.battle.tables import ORDERS, Battle, Tables
from liir_common.battle.terrain import MAP_SIZE
from liir_common.battle.units import ENERGY_MAX

_LONGEST_COOLDOWN = 1e6
"""In loops; far beyond any weapon's, and within what the state's float32 can hold."""


class UnitRecord(TypedDict):
    """One unit as plain values, for people and tests."""

    team: str
    """"ally" or "enemy" """
    id: int
    """Number within the team"""
    unit_type: str
    x: float
    y: float
    health: float
    health_max: float
    shield: float
    shield_max: float
    energy: float
    cooldown: float
    """Loops until the weapon may fire"""
    radius: float
    alive: bool
    order: str
    """One of `tables.ORDERS`"""
    target: int | None
    """Number of the unit attacked, within the other team; of the unit healed, within its own"""
    goal_x: NotRequired[float]
    goal_y: NotRequired[float]
    """Where a move or an attack-move leads; a record put back without it has the unit stay"""


def take(tables: Tables, battle: Battle, unit_types: Sequence[str]) -> list[UnitRecord]:
    """All units as records, allies first."""
    return [_record(tables, battle, i, unit_type) for i, unit_type in enumerate(unit_types)]


def put(tables: Tables, battle: Battle, unit_types: Sequence[str], records: Sequence[UnitRecord]) -> None:
    """Write the records into the battle, or nothing if one of them is refused.

    Raises:
        ValueError: other units than the battle's, or a unit that cannot be so.
    """
    expected = [_identity(record) for record in take(tables, battle, unit_types)]
    got = [_identity(record) for record in records]
    if got != expected:
        raise ValueError(f"this map wants the units {expected}, got {got}")
    for i, record in enumerate(records):
        _check(tables, i, record)
    for i, record in enumerate(records):
        _put(tables, battle, i, record)


def _identity(record: UnitRecord) -> tuple[str, int, str]:
    return record["team"], record["id"], record["unit_type"]


def _record(tables: Tables, battle: Battle, i: int, unit_type: str) -> UnitRecord:
    unit, spec, n = battle.units[i], tables.specs[i], int(tables.rules["n_allies"][0])
    return UnitRecord(
        team="ally" if i < n else "enemy",
        id=i if i < n else i - n,
        unit_type=unit_type,
        x=float(battle.x[i]),
        y=float(battle.y[i]),
        health=float(unit["health"]),
        health_max=float(spec["health"]),
        shield=float(unit["shield"]),
        shield_max=float(spec["shield"]),
        energy=float(unit["energy"]),
        cooldown=max(0.0, float(unit["ready_at"] - battle.clock[0])),
        radius=float(spec["radius"]),
        alive=bool(battle.alive[i]),
        order=ORDERS[unit["order"]],
        target=None if unit["target"] < 0 else int(unit["target"]) - _side(tables, i).start,
        goal_x=float(unit["goal_x"]),
        goal_y=float(unit["goal_y"]),
    )


def _side(tables: Tables, i: int) -> range:
    """The units among which i has its targets: the other team, or its own if it heals."""
    n = int(tables.rules["n_allies"][0])
    aims_at_allies = (i < n) == bool(tables.specs["heals"][i])
    return range(n) if aims_at_allies else range(n, len(tables.specs))


def _check(tables: Tables, i: int, record: UnitRecord) -> None:
    spec, who = tables.specs[i], f"{record['team']} {record['id']}"
    # A move order may lead beyond the map, by the length of a move.
    goals = (-MAP_SIZE, 2 * MAP_SIZE)
    bounds: dict[str, Any] = {
        "health": (0, spec["health"]),
        "shield": (0, spec["shield"]),
        "energy": (0, ENERGY_MAX),
        "cooldown": (0, _LONGEST_COOLDOWN),
        "goal_x": goals,
        "goal_y": goals,
    }
    values: dict[str, Any] = {"goal_x": record["x"], "goal_y": record["y"], **record}
    for name, (low, high) in bounds.items():
        # So that NaN is refused too.
        if not low <= values[name] <= high:
            raise ValueError(f"{who} wants {name} in [{low}, {high}], got {values[name]}")
    if not _is_open(tables, i, record["x"], record["y"]):
        raise ValueError(f"{who} wants a place that units can reach, got {record['x'], record['y']}")
    if record["alive"] != (record["health"] > 0):
        raise ValueError(f"{who} wants alive to mean health above 0, got {record['alive']}")
    if record["order"] not in ORDERS:
        raise ValueError(f"{who} wants an order of {ORDERS}, got {record['order']!r}")
    if not _is_target(tables, i, record["target"]):
        raise ValueError(f"{who} wants None or a unit that it can target, got {record['target']!r}")


def _is_open(tables: Tables, i: int, x: float, y: float) -> bool:
    cells = tables.layers[tables.specs["layer"][i]]
    inside = 0 <= x < cells.shape[0] and 0 <= y < cells.shape[1]
    return inside and bool(cells[int(x), int(y)])


def _is_target(tables: Tables, i: int, number: int | None) -> bool:
    """Whether i can aim at nobody or at that unit of its targets' team."""
    side, specs = _side(tables, i), tables.specs
    if number is None or number not in range(len(side)):
        return number is None
    target = specs[side[number]]
    if specs["heals"][i]:
        return not target["heals"]
    return bool(tables.pairs["damage"][specs["kind"][i], target["kind"]] > 0)


def _put(tables: Tables, battle: Battle, i: int, record: UnitRecord) -> None:
    unit, now, target = battle.units[i], battle.clock[0], record["target"]
    battle.x[i], battle.y[i] = record["x"], record["y"]
    unit["health"], unit["shield"], unit["energy"] = record["health"], record["shield"], record["energy"]
    battle.alive[i], unit["order"] = record["alive"], ORDERS.index(record["order"])
    unit["goal_x"], unit["goal_y"] = record.get("goal_x", record["x"]), record.get("goal_y", record["y"])
    unit["ready_at"], unit["free_at"], unit["hits"] = now + record["cooldown"], now, 0
    unit["hurt_at"] = now
    unit["target"] = -1 if target is None else _side(tables, i)[target]
    unit["attacker"] = unit["missile_target"] = -1
