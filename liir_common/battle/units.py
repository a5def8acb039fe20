"""Unit types as data: StarCraft II 4.10, multiplayer layer, with the life and speed of SMAC's RL units.

Times are in seconds of the data files (16 game loops), lengths in cells, speeds in cells per second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

LOOPS_PER_SECOND = 16
SHIELD_REGENERATION = 2.0
"""Shield points per second, once `SHIELD_DELAY` seconds have passed without damage."""
SHIELD_DELAY = 10.0
MINIMUM_DAMAGE = 0.5
"""What a hit on life does at least, however thick the armor."""
FIRING_DELAY = (-0.0625, 0.125)
"""Bounds of the random part of the time between two attacks."""


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


@dataclass(frozen=True)
class UnitType:
    """What all units of one type share."""

    name: str
    health: float
    radius: float
    separation_radius: float
    speed: float
    attributes: frozenset[str]
    weapon: Weapon
    cooldown_norm: float
    """SMAC v1 divides the cooldown by this in its global state."""
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
        weapon=Weapon(6, range=5, scan_range=5.5, period=0.8608, damage_point=0.05, backswing=0.75),
        cooldown_norm=15,
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
        weapon=Weapon(13, range=6, scan_range=6.5, period=1.87, bonus={"armored": 5}, missile_speed=18.75),
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
    # Its second weapon, for short distances, does the same damage and is left out.
    UnitType(
        "hydralisk",
        health=80,
        regeneration=0.2734,
        radius=0.625,
        separation_radius=0.5,
        speed=2.25,
        attributes=frozenset({"light", "biological"}),
        weapon=Weapon(12, range=5, scan_range=5.5, period=0.825, damage_point=0.208, missile_speed=40),
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

_LIBERTY_WEAPONS: Mapping[str, Weapon] = {
    "marine": replace(UNIT_TYPES["marine"].weapon, scan_range=5),
    "stalker": replace(
        UNIT_TYPES["stalker"].weapon, damage=10, bonus={"armored": 4}, period=1.44, scan_range=6
    ),
    "hydralisk": replace(UNIT_TYPES["hydralisk"].weapon, period=0.83, scan_range=5),
    "spine_crawler": replace(UNIT_TYPES["spine_crawler"].weapon, period=1.6),
}
LIBERTY_UNIT_TYPES: Mapping[str, UnitType] = {
    name: replace(unit, weapon=_LIBERTY_WEAPONS.get(name, unit.weapon)) for name, unit in UNIT_TYPES.items()
}
"""The same with the weapons of the layer that the map archives name."""
