"""Unit types as data: StarCraft II 4.10, multiplayer layer, with the life and speed of SMAC's RL units.

Times are in seconds of the data files (16 game loops), lengths in cells, speeds in cells per second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from liir_common.battle.terrain import AIR, CLIFFS, GROUND

LOOPS_PER_SECOND = 16
SHIELD_REGENERATION = 2.0
"""Shield points per second, once `SHIELD_DELAY` seconds have passed without damage."""
SHIELD_DELAY = 10.0
MINIMUM_DAMAGE = 0.5
"""What a hit on life does at least, however thick the armor."""
FIRING_DELAY = (-0.0625, 0.125)
"""Bounds of the random part of the time between two attacks."""

HEALING = 9.0
"""Points of life per second; every point costs `HEALING_COST` of energy."""
HEALING_COST = 0.33
HEALING_RANGE, HEALING_SEARCH = 4.0, 6.0
"""From edge to edge: how far a healer reaches, and looks for patients of its own accord."""
HEALING_RESERVE = 5.0
"""Energy without which a healer begins no treatment of its own accord."""
ENERGY_START, ENERGY_MAX, ENERGY_REGENERATION = 50.0, 200.0, 0.5625

BEAM_LENGTH, BEAM_WIDTH = 2.5, 0.3
"""What a beam sweeps over, at right angles to the shot and centred on the target."""


@dataclass(frozen=True)
class Weapon:
    """How a unit attacks; ranges are from edge to edge."""

    damage: float
    range: float
    scan_range: float
    """Radius in which targets are acquired."""
    period: float
    damage_point: float = 0.167
    """From the start of an attack to its first hit."""
    backswing: float = 0.5
    """Follow-through after a hit."""
    bonus: Mapping[str, float] | None = None
    """Extra damage against units with an attribute."""
    hits: int = 1
    hit_interval: float = 0.0
    missile_speed: float = 0.0
    """0 means that the hit is instant."""
    hits_air: bool = False
    beams: int = 0
    """Beams that sweep at the first hit over what stands beside the target, and at the second hit it."""
    blast: float = 0.0
    """The attack is the attacker's death, and its death damages all enemies within this range."""


@dataclass(frozen=True)
class UnitType:
    """What all units of one type share."""

    name: str
    health: float
    radius: float
    separation_radius: float
    speed: float
    attributes: frozenset[str]
    weapon: Weapon | None
    """None for a healer"""
    cooldown_norm: float
    """SMAC v1 divides the cooldown by this in its global state, and the energy of a healer."""
    layer: int = GROUND
    acceleration: float = 1000.0
    shield: float = 0.0
    armor: float = 0.0
    regeneration: float = 0.0
    """Points of life per second"""


_TYPES = (
    UnitType(
        "marine",
        health=45,
        radius=0.375,
        separation_radius=0.375,
        speed=2.25,
        attributes=frozenset({"light", "biological"}),
        weapon=Weapon(
            6,
            range=5,
            hits_air=True,
            scan_range=5.5,
            period=0.8608,
            damage_point=0.05,
            backswing=0.75,
        ),
        cooldown_norm=15,
    ),
    # Its slowing grenades need research, which no map has.
    UnitType(
        "marauder",
        health=125,
        armor=1,
        radius=0.5625,
        separation_radius=0.5,
        speed=2.25,
        attributes=frozenset({"armored", "biological"}),
        weapon=Weapon(
            10,
            range=6,
            scan_range=6.5,
            period=1.5,
            damage_point=0,
            backswing=0,
            bonus={"armored": 10},
            missile_speed=20,
        ),
        cooldown_norm=25,
    ),
    UnitType(
        "medivac",
        health=150,
        armor=1,
        radius=0.75,
        separation_radius=0.75,
        speed=2.75,
        acceleration=2.3125,
        attributes=frozenset({"armored", "mechanical"}),
        weapon=None,
        cooldown_norm=ENERGY_MAX,
        layer=AIR,
    ),
    UnitType(
        "stalker",
        health=80,
        shield=80,
        armor=1,
        radius=0.625,
        separation_radius=0.625,
        speed=2.9531,
        attributes=frozenset({"armored", "mechanical"}),
        weapon=Weapon(
            13,
            range=6,
            hits_air=True,
            scan_range=6.5,
            period=1.87,
            bonus={"armored": 5},
            missile_speed=18.75,
        ),
        cooldown_norm=35,
    ),
    UnitType(
        "zealot",
        health=100,
        shield=50,
        armor=1,
        radius=0.5,
        separation_radius=0.375,
        speed=2.25,
        attributes=frozenset({"light", "biological"}),
        weapon=Weapon(8, range=0.1, scan_range=5, period=1.2, damage_point=0, hits=2, hit_interval=0.28),
        cooldown_norm=22,
    ),
    # Its two beams hit what stands beside the target 0.25 to 0.48 s after they set out, here at the middle of
    # that, and the target at their end after 0.73 s.
    UnitType(
        "colossus",
        health=200,
        shield=150,
        armor=1,
        radius=1,
        separation_radius=0.75,
        speed=2.25,
        attributes=frozenset({"armored", "mechanical", "massive"}),
        weapon=Weapon(
            10,
            range=7,
            scan_range=7.5,
            period=1.5,
            damage_point=0.0832 + 0.365,
            bonus={"light": 5},
            hits=2,
            hit_interval=0.73 - 0.365,
            beams=2,
        ),
        cooldown_norm=24,
        layer=CLIFFS,
    ),
    UnitType(
        "zergling",
        health=35,
        regeneration=0.2734,
        radius=0.375,
        separation_radius=0.375,
        speed=2.9531,
        attributes=frozenset({"light", "biological"}),
        weapon=Weapon(5, range=0.1, scan_range=5, period=0.696),
        cooldown_norm=11,
    ),
    UnitType(
        "baneling",
        health=30,
        regeneration=0.2734,
        radius=0.375,
        separation_radius=0.375,
        speed=2.5,
        attributes=frozenset({"biological"}),
        weapon=Weapon(
            20, range=0.25, scan_range=5, period=0.833, damage_point=0, bonus={"light": 15}, blast=2.2
        ),
        cooldown_norm=1,
    ),
    # Its second weapon, for short distances, does the same damage and is left out.
    UnitType(
        "hydralisk",
        health=80,
        regeneration=0.2734,
        radius=0.625,
        separation_radius=0.5,
        speed=2.25,
        attributes=frozenset({"light", "biological"}),
        weapon=Weapon(
            12, range=5, hits_air=True, scan_range=5.5, period=0.825, damage_point=0.208, missile_speed=40
        ),
        cooldown_norm=10,
    ),
    # How long its tentacle takes is not known; the hit comes at the damage point.
    UnitType(
        "spine_crawler",
        health=300,
        regeneration=0.2734,
        armor=2,
        radius=0.875,
        separation_radius=0.875,
        speed=0,
        attributes=frozenset({"armored", "biological", "structure"}),
        weapon=Weapon(25, range=7, scan_range=7, period=1.85, damage_point=0.3332, bonus={"armored": 5}),
        cooldown_norm=15,
    ),
)

UNIT_TYPES: Mapping[str, UnitType] = {unit.name: unit for unit in _TYPES}


def _rearmed(name: str, **changes: Any) -> UnitType:
    weapon = UNIT_TYPES[name].weapon
    assert weapon is not None
    return replace(UNIT_TYPES[name], weapon=replace(weapon, **changes))


MULTIPLAYER, BASE_LIBERTY = "multiplayer", "base_liberty"
"""Balance layers: the one that measurements of SMAC v1 show, and the one that its map archives name."""

_CHANGES: Mapping[str, tuple[UnitType, ...]] = {
    MULTIPLAYER: (),
    BASE_LIBERTY: (
        _rearmed("marine", scan_range=5),
        _rearmed("marauder", scan_range=6),
        _rearmed("stalker", damage=10, bonus={"armored": 4}, period=1.44, scan_range=6),
        _rearmed(
            "colossus",
            damage=20,
            bonus=None,
            range=6,
            scan_range=6,
            period=2.2,
            damage_point=0.0832 + 0.375,
            hit_interval=0.0,
        ),
        _rearmed("hydralisk", period=0.83, scan_range=5),
        _rearmed("spine_crawler", period=1.6),
    ),
}
_ENEMY_CHANGES: Mapping[str, tuple[UnitType, ...]] = {
    # SMAC v1's own units keep the life and speed of the base game in either layer.
    MULTIPLAYER: (replace(UNIT_TYPES["medivac"], speed=2.5, acceleration=2.25),),
    BASE_LIBERTY: (),
}


def unit_types(balance: str, enemy: bool) -> Mapping[str, UnitType]:
    """The unit types of a team by name, in one of the balance layers."""
    changes = (*_CHANGES[balance], *(_ENEMY_CHANGES[balance] if enemy else ()))
    return {**UNIT_TYPES, **{unit.name: unit for unit in changes}}
