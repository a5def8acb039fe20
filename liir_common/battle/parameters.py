"""Everything about a battle that can be set: SMAC v1's options, and the parameters of the simulator."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import Field, asdict, dataclass, field, fields
from typing import Any

from liir_common.battle.units import BASE_LIBERTY, MULTIPLAYER

_LARGEST = 1e9
"""No option means anything beyond it, and infinity and NaN are not within."""


def _at_least(default: Any, minimum: float) -> Any:
    return field(default=default, metadata={"minimum": minimum})


@dataclass(frozen=True)
class Options:
    """SMAC v1's options, under its names and with its defaults.

    Those that concern the game's window, version, difficulty and replays have nothing to act on here;
    `heuristic_ai` is a policy (`policies.CLOSEST_ENEMY`); `heuristic_rest`, which changes it, is not there.
    """

    step_mul: int = field(default=8, metadata={"minimum": 1, "maximum": 1000})
    """Game loops per step."""
    move_amount: float = field(default=2.0, metadata={"minimum": 0.01, "maximum": 32})
    """Length of a move order in cells; half of it ahead the ground must be open."""

    obs_all_health: bool = True
    """Observations have the life and shield of visible units; implies `obs_own_health`."""
    obs_own_health: bool = True
    obs_last_action: bool = False
    obs_pathing_grid: bool = False
    """Observations say whether the ground is open at eight points around the unit."""
    obs_terrain_height: bool = False
    """Observations have the height of the ground at these points and under the unit."""
    obs_timestep_number: bool = False
    obs_instead_of_state: bool = False
    """The state is all observations in a row."""
    state_last_action: bool = True
    state_timestep_number: bool = False
    reward_only_positive: bool = True
    """Reward damage and kills, without a charge for losses."""
    reward_sparse: bool = False
    """Only +1 for a win and -1 for a defeat."""
    reward_death_value: float = _at_least(10.0, 0)
    reward_win: float = _at_least(200.0, 0)
    reward_defeat: float = 0.0
    reward_negative_scale: float = _at_least(0.5, 0)
    """Weight of own losses without `reward_only_positive`."""
    reward_scale: bool = True
    """Divide so that the largest return is `reward_scale_rate`."""
    reward_scale_rate: float = _at_least(20.0, 1e-9)
    continuing_episode: bool = False
    """The info has `episode_limit` where the limit ends an episode; truncation says so in any case."""


@dataclass(frozen=True)
class Parameters:
    """What no source settles about the game; the defaults together fit the
    published figures best (`calibrate`)."""

    head_start: int = _at_least(1, 0)
    """Loops that the enemies walk before the first observation."""
    order_latency: int = _at_least(1, 0)
    """Loops from a decision to its first effect."""
    grid_spawn: bool = False
    """Units stand on a square grid around their point instead of in hexagonal rings."""
    separation_collision: bool = False
    """Discs collide with the separation radius instead of the radius."""
    slide: float = field(default=1.0, metadata={"minimum": 0, "maximum": 1})
    """Share of the blocked motion that goes sideways around the blocker."""
    push_idle: bool = True
    """Walking units push idle units of their team aside."""
    stand_after_hit: bool = True
    """A unit stands through the backswing of its weapon unless it gets a move order."""
    repeated_order_restarts: bool = False
    """An attack order on the same target starts the attack again."""
    new_order_cancels_hits: bool = True
    """A new order cancels hits of a several-hit attack that are still to come."""
    cooldown_from_release: bool = False
    """The time between attacks counts from the first hit, not from the attack's beginning, so that the way to
    the damage point lengthens it and an attack that is interrupted before costs nothing."""
    integer_delay: bool = False
    """The random delay between attacks is a whole number of loops."""
    rescan_period: int = _at_least(8, 1)
    """Loops between two looks for a target, for a unit that has none."""
    drop_beyond_reach: bool = False
    """Enemies drop a target that is beyond their weapon instead of one beyond their scan range."""
    scan_adds_radii: bool = True
    """The scan range counts from edge to edge, as the weapon's does."""
    call_for_help: bool = True
    """An enemy hit by a unit that it has not acquired calls others nearby."""
    chase_attacker: bool = True
    """Enemies follow the unit that hit them last beyond their scan range."""
    hold_formation: bool = True
    """Enemies keep their places in the group while they walk to their goal."""
    redirect_missiles: bool = False
    """A missile whose target died flies on to the nearest unit of that team instead of being lost."""
    balance: str = field(default=MULTIPLAYER, metadata={"choices": (MULTIPLAYER, BASE_LIBERTY)})
    """Data layer of the weapons: what measurements show, or what the map archives name."""
    medivac_follows: bool = True
    """Enemy medivacs take their group's attack-move as a move; else they stay. They heal in both cases."""
    medivac_autocast: bool = False
    """Agents' medivacs without an order heal of their own accord, as the ability does for other players."""
    hunt_nearest: bool = True
    """Enemies ordered to attack a group take its member nearest to them; else each a random one."""
    double_max_reward: bool = False
    """Count the enemies twice in the divisor of the reward, as SMAC v1 does after a second launch."""


@dataclass(frozen=True)
class Settings(Options, Parameters):
    """All of them, resolved."""

    def canonical(self) -> str:
        """Sorted JSON of all values that are played by: equal texts mean equal rules."""
        values = asdict(self)
        del values["continuing_episode"]
        return json.dumps(values, sort_keys=True)


def resolve(options: Mapping[str, Any]) -> Settings:
    """Check options and fill in the defaults.

    Raises:
        ValueError: an unknown option, a value of the wrong type or outside its bounds.
    """
    known = {item.name: item for item in fields(Settings)}
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(f"unknown battle options {unknown}; known: {', '.join(sorted(known))}")
    settings = Settings(**{name: _checked(known[name], value) for name, value in options.items()})
    if settings.order_latency >= settings.step_mul:
        raise ValueError(
            f"battle option order_latency wants to be less than step_mul, "
            f"got {settings.order_latency} and {settings.step_mul}"
        )
    return settings


def _checked(option: Field[Any], value: Any) -> Any:
    kind = type(option.default)
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise ValueError(f"battle option {option.name} wants {kind.__name__}, got {value!r}")
    if kind is str:
        if value not in option.metadata["choices"]:
            raise ValueError(
                f"battle option {option.name} wants one of {option.metadata['choices']}, got {value!r}"
            )
        return value
    low, high = option.metadata.get("minimum", -_LARGEST), option.metadata.get("maximum", _LARGEST)
    if not low <= value <= high:
        raise ValueError(f"battle option {option.name} wants a value in [{low}, {high}], got {value!r}")
    return value
