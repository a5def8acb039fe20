"""The rules of the battle, each seen on units put where it shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from liir_common.battle.env import BattleEnv, UnitRecord, parallel_env
from liir_common.battle.parameters import Parameters, Settings
from liir_common.battle.policies import CLOSEST_ENEMY, RANDOM
from liir_common.battle.policies import play as play_policy
from liir_common.battle.scenarios import make_battle
from liir_common.battle.terrain import TERRAINS

STOP, NORTH, SOUTH, EAST, WEST, ATTACK = range(1, 7)
FAR = {"x": 29.0, "y": 24.0}


def stage(env: BattleEnv, changes: Mapping[tuple[str, int], Mapping[str, Any]], seed: int = 1) -> None:
    """Start an episode in which only the units named take part, enemies idle unless said otherwise."""
    env.reset(seed=seed)
    records = env.snapshot()
    for record in records:
        key = (record["team"], record["id"])
        if key in changes:
            record.update({"order": "idle", **changes[key]})  # type: ignore[typeddict-item]
        else:
            record.update({"alive": False, "health": 0.0, "shield": 0.0})  # type: ignore[typeddict-item]
    env.restore(records)


def play(env: BattleEnv, actions: Mapping[int, int], steps: int = 1) -> dict[str, dict[str, Any]]:
    """Let the allies named act for some steps; the dead and the others do what they must."""
    infos: dict[str, dict[str, Any]] = {}
    for _ in range(steps):
        alive = [u["alive"] for u in env.snapshot() if u["team"] == "ally"]
        infos = env.step({f"ally_{i}": actions.get(i, STOP) if alive[i] else 0 for i in range(len(alive))})[
            -1
        ]
        if not env.agents:
            break
    return infos


def unit(env: BattleEnv, team: str, number: int) -> UnitRecord:
    return next(u for u in env.snapshot() if (u["team"], u["id"]) == (team, number))


def distance(a: UnitRecord, b: UnitRecord) -> float:
    return math.hypot(a["x"] - b["x"], a["y"] - b["y"])


@pytest.mark.parametrize(
    ("map_name", "per_step"),
    [("3m", 2.25 * 8 / 16), ("3s_vs_3z", 2.9531 * 8 / 16)],
    ids=["marine", "stalker"],
)
@pytest.mark.parametrize(("action", "dx", "dy"), [(NORTH, 0, 1), (SOUTH, 0, -1), (EAST, 1, 0), (WEST, -1, 0)])
def test_a_repeated_move_is_steady(map_name: str, per_step: float, action: int, dx: int, dy: int) -> None:
    env = parallel_env(map_name)
    stage(env, {("ally", 0): {"x": 15.0, "y": 15.0}, ("enemy", 0): FAR})
    play(env, {0: action})
    before = unit(env, "ally", 0)
    play(env, {0: action})
    after = unit(env, "ally", 0)
    assert after["x"] - before["x"] == pytest.approx(dx * per_step)
    assert after["y"] - before["y"] == pytest.approx(dy * per_step)


@pytest.mark.parametrize("latency", [0, 3])
def test_the_first_move_loses_the_latency(latency: int) -> None:
    env = parallel_env("3m", order_latency=latency)
    stage(env, {("ally", 0): {"x": 15.0, "y": 15.0}, ("enemy", 0): FAR})
    play(env, {0: EAST})
    assert unit(env, "ally", 0)["x"] == pytest.approx(15 + (8 - latency) * 2.25 / 16)


def test_walls_hold_and_are_slid_along() -> None:
    env = parallel_env("3m")
    stage(env, {("ally", 0): {"x": 15.0, "y": 24.2}, ("enemy", 0): {"x": 29.0, "y": 8.0}})
    assert not env._masks[0, NORTH]
    stage(env, {("ally", 0): {"x": 29.5, "y": 23.9}, ("enemy", 0): {"x": 2.5, "y": 8.0}})
    play(env, {0: NORTH}, steps=1)
    assert 24 < unit(env, "ally", 0)["y"] < 25


def test_an_order_beyond_the_weapon_walks_up_and_fires() -> None:
    """An attack may be ordered within 6 although a marine reaches 5.75: it walks the rest."""
    env = parallel_env("3m")
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 15.99, "y": 15.0}})
    play(env, {0: ATTACK})
    ally, enemy = unit(env, "ally", 0), unit(env, "enemy", 0)
    assert 5.75 - 2.25 / 16 < distance(ally, enemy) <= 5.75
    assert enemy["health"] == 45 - 6


def test_an_attacker_chases_beyond_the_shoot_range() -> None:
    """A marine whose target walks away at its own speed follows it for the whole step."""
    env = parallel_env("3m")
    leaving = {"x": 14.9, "y": 15.0, "order": "move"}
    stage(env, {("ally", 0): {"x": 9.0, "y": 15.0}, ("enemy", 0): leaving})
    env._battle.units["goal_x"][3], env._battle.units["goal_y"][3] = 25.0, 15.0
    play(env, {0: ATTACK})
    ally, enemy = unit(env, "ally", 0), unit(env, "enemy", 0)
    assert enemy["x"] == pytest.approx(14.9 + 1.125)
    assert ally["x"] == pytest.approx(9.0 + 7 / 8 * 1.125)
    assert distance(ally, enemy) > 6


def expected_steps_to_kill(rng: np.random.Generator, shots: int) -> int:
    """Steps until a marine has fired: order at loop 1, first hit 0.8 loops later, then whole loops."""
    loop = 1
    for _ in range(shots - 1):
        loop += math.ceil(0.8608 * 16 + rng.uniform(-1, 2))
    return (loop + 1) // 8 + 1


def test_rate_of_fire() -> None:
    """45 points of life are 8 shots of 6; the time they take follows from period and random delay."""
    env = parallel_env("3m")
    measured = []
    for seed in range(120):
        stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 14.0, "y": 15.0}}, seed)
        steps = 0
        while env.agents:
            play(env, {0: ATTACK})
            steps += 1
        measured.append(steps)
    rng = np.random.default_rng(0)
    expected = [expected_steps_to_kill(rng, 8) for _ in range(20_000)]
    # The standard error of the mean of 120 is about 0.03 steps.
    assert np.mean(measured) == pytest.approx(np.mean(expected), abs=0.12)


def test_damage_takes_shield_then_armor_off() -> None:
    """Stalker on zealot: 13 on the shield, 12 on life, and 1 on both when a hit crosses over."""
    for shield, lost_shield, lost_health in [(50, 13, 0), (0, 0, 12), (3, 3, 9), (13, 13, 0)]:
        env = parallel_env("3s_vs_3z")
        stage(
            env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 15.0, "y": 15.0, "shield": shield}}
        )
        play(env, {0: ATTACK}, steps=2)
        enemy = unit(env, "enemy", 0)
        assert enemy["shield"] == shield - lost_shield
        assert enemy["health"] == 100 - lost_health


def test_bonus_damage_against_armored() -> None:
    env = parallel_env("2s3z")
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 15.0, "y": 15.0}})
    play(env, {0: ATTACK}, steps=2)
    assert unit(env, "enemy", 0)["shield"] == 80 - 18


def test_missiles_take_time() -> None:
    """At distance 5 a stalker's missile needs about 4 loops after a wind-up of 3."""
    env = parallel_env("3s_vs_3z")
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 15.0, "y": 15.0}})
    play(env, {0: ATTACK})
    assert unit(env, "enemy", 0)["shield"] == 50
    assert unit(env, "ally", 0)["cooldown"] > 0
    play(env, {0: STOP})
    assert unit(env, "enemy", 0)["shield"] == 50 - 13


@pytest.mark.parametrize(("cancels", "lost"), [(True, 8), (False, 16)])
def test_zealot_hits_twice_unless_told_otherwise(cancels: bool, lost: int) -> None:
    """The second hit comes 4.48 loops after the first; a new order in between cancels it by the rules."""
    env = parallel_env("2s3z", new_order_cancels_hits=cancels)
    ready_just_before_the_next_order = 6.0
    place = {"x": 10.0, "y": 15.0, "cooldown": ready_just_before_the_next_order}
    stage(env, {("ally", 2): place, ("enemy", 2): {"x": 11.05, "y": 15.0}})
    play(env, {2: ATTACK + 2})
    assert unit(env, "enemy", 2)["shield"] == 50 - 8
    play(env, {2: STOP})
    assert unit(env, "enemy", 2)["shield"] == 50 - lost


def test_shields_come_back_after_ten_seconds() -> None:
    env = parallel_env("3s_vs_3z")
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 15.0, "y": 15.0}})
    play(env, {0: ATTACK}, steps=2)
    play(env, {0: STOP}, steps=18)
    assert unit(env, "enemy", 0)["shield"] == 50 - 13
    play(env, {0: STOP}, steps=4)
    shield = unit(env, "enemy", 0)["shield"]
    play(env, {0: STOP})
    assert unit(env, "enemy", 0)["shield"] == shield + 1
    play(env, {0: STOP}, steps=20)
    assert unit(env, "enemy", 0)["shield"] == 50


def test_enemies_take_the_nearest_and_stick_to_it() -> None:
    env = parallel_env("3m", rescan_period=1)
    enemy = {"x": 15.0, "y": 15.0, "order": "attack_move"}
    stage(
        env,
        {("ally", 0): {"x": 10.0, "y": 15.0}, ("ally", 1): {"x": 10.0, "y": 17.5}, ("enemy", 0): enemy},
    )
    play(env, {})
    assert unit(env, "enemy", 0)["target"] == 0
    records = env.snapshot()
    records[1]["x"], records[1]["y"] = 12.0, 15.0
    env.restore(records)
    play(env, {})
    assert unit(env, "enemy", 0)["target"] == 0, "a nearer unit is no reason to change"
    records = env.snapshot()
    records[0]["alive"], records[0]["health"] = False, 0.0
    env.restore(records)
    play(env, {})
    assert unit(env, "enemy", 0)["target"] == 1, "a dead target is"


def test_enemies_drop_a_target_beyond_their_scan_range() -> None:
    env = parallel_env("3m")
    for gap, kept in [(6.2, True), (6.4, False)]:
        enemy = {"x": 15.0, "y": 15.0, "order": "attack_move", "target": 0}
        stage(env, {("ally", 0): {"x": 15.0 - gap, "y": 15.0}, ("enemy", 0): enemy})
        # So that walking to the goal does not bring it nearer.
        env._battle.units["goal_x"][3], env._battle.units["goal_y"][3] = 15.0, 15.0
        play(env, {0: STOP})
        assert (unit(env, "enemy", 0)["target"] == 0) is kept


def test_an_enemy_stands_through_its_backswing() -> None:
    """12 loops after a marine's hit; without the rule it walks after its target at once."""
    walked = {}
    for stands in (True, False):
        env = parallel_env("3m", stand_after_hit=stands)
        enemy = {"x": 15.0, "y": 15.0, "order": "attack_move", "target": 0}
        stage(env, {("ally", 0): {"x": 9.3, "y": 15.0}, ("enemy", 0): enemy})
        play(env, {0: WEST})
        assert unit(env, "ally", 0)["health"] == 45 - 6
        walked[stands] = 15.0 - unit(env, "enemy", 0)["x"]
    assert walked[True] == 0
    assert walked[False] > 0.5


def test_an_enemy_that_is_hit_answers_and_calls_for_help() -> None:
    """A stalker reaches farther than zealots scan."""
    env = parallel_env("3s_vs_3z")
    stage(
        env,
        {
            ("ally", 0): {"x": 8.0, "y": 23.0},
            ("enemy", 0): {"x": 14.9, "y": 23.0, "order": "attack_move"},
            ("enemy", 1): {"x": 17.9, "y": 23.0, "order": "attack_move"},
            ("enemy", 2): {"x": 21.0, "y": 8.0, "order": "attack_move"},
        },
    )
    env._battle.units["goal_x"][3:], env._battle.units["goal_y"][3:] = env._battle.x[3:6], env._battle.y[3:6]
    env._masks[0, ATTACK] = True
    play(env, {0: ATTACK}, steps=1)
    env._masks[0, ATTACK] = True
    play(env, {0: ATTACK}, steps=1)
    assert [unit(env, "enemy", i)["target"] for i in range(3)] == [0, 0, None]


@pytest.mark.parametrize("map_name", ["3m", "8m", "2s3z"])
def test_enemies_do_not_hunt_a_team_that_steps_aside(map_name: str) -> None:
    env = parallel_env(map_name)
    observations, _ = env.reset(seed=5)
    infos: dict[str, dict[str, Any]] = {}
    while env.agents:
        observations, _, terminated, truncated, infos = env.step(
            {a: NORTH if observations[a]["action_mask"][NORTH] else STOP for a in env.agents}
        )
    assert all(truncated.values())
    assert not any(terminated.values())
    assert infos["ally_0"]["dead_allies"] == 0


def test_simultaneous_death_is_no_win() -> None:
    """Two stalkers with a point of life each, whose missiles cross."""
    env = parallel_env("2s3z")
    frail = {"health": 1.0, "shield": 0.0}
    enemy = {"x": 12.0, "y": 15.0, "order": "attack_move", "target": 0, **frail}
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0, **frail}, ("enemy", 0): enemy})
    observation = env._observations()["ally_0"]["action_mask"]
    assert observation[ATTACK]
    _, rewards, terminated, _, infos = env.step({f"ally_{i}": ATTACK if i == 0 else 0 for i in range(5)})
    assert all(terminated.values())
    assert infos["ally_0"] == {"alive": False, "won": 0.0, "dead_allies": 5.0, "dead_enemies": 5.0}
    assert rewards["ally_0"] == pytest.approx((1 + 10) / 51), "no bonus for a win"


def test_units_do_not_walk_through_each_other() -> None:
    env = parallel_env("3m", slide=0.0)
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 12.0, "y": 15.0}})
    play(env, {0: EAST}, steps=4)
    assert unit(env, "ally", 0)["x"] == pytest.approx(12 - 0.75, abs=1e-6)
    assert unit(env, "enemy", 0)["x"] == 12.0, "who stands is not pushed by the other team"


def test_walkers_slide_around_a_blocker() -> None:
    env = parallel_env("3m", slide=1.0)
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.01}, ("enemy", 0): {"x": 12.0, "y": 15.0}})
    play(env, {0: EAST}, steps=5)
    ally = unit(env, "ally", 0)
    assert ally["x"] > 12.5
    assert ally["y"] > 15.3


@pytest.mark.parametrize(("pushes", "moved"), [(True, True), (False, False)])
def test_idle_friends_are_pushed_aside(pushes: bool, moved: bool) -> None:
    env = parallel_env("3m", push_idle=pushes)
    stage(
        env,
        {
            ("ally", 0): {"x": 10.0, "y": 15.0},
            ("ally", 1): {"x": 11.0, "y": 15.0},
            ("enemy", 0): {"x": 29.0, "y": 24.0},
        },
    )
    play(env, {0: EAST}, steps=3)
    assert (unit(env, "ally", 1)["x"] > 11.1) is moved


def test_enemies_walk_to_the_goal_in_formation() -> None:
    env = parallel_env("3m")
    env.reset(seed=2)
    start = [(u["x"], u["y"]) for u in env.snapshot() if u["team"] == "enemy"]
    play(env, {}, steps=4)
    now = [(u["x"], u["y"]) for u in env.snapshot() if u["team"] == "enemy"]
    walked = np.array(now) - np.array(start)
    assert walked == pytest.approx(np.tile(walked[0], (3, 1)))
    assert np.hypot(*walked[0]) == pytest.approx(4 * 1.125)


def test_zerg_life_regenerates() -> None:
    env = parallel_env("6h_vs_8z")
    stage(env, {("ally", 0): {"x": 12.0, "y": 9.0, "health": 50.0}, ("enemy", 0): {"x": 18.0, "y": 19.0}})
    play(env, {}, steps=4)
    assert unit(env, "ally", 0)["health"] == pytest.approx(50 + 2 * 0.2734)


def test_a_spine_crawler_stays_and_reaches_far() -> None:
    env = parallel_env("2s_vs_1sc")
    crawler = {"order": "attack_move"}
    stage(env, {("ally", 0): {"x": 13.92, "y": 20.0397 - 8.4}, ("enemy", 0): crawler})
    play(env, {}, steps=3)
    assert unit(env, "ally", 0)["shield"] == 80 - 30
    assert (unit(env, "enemy", 0)["x"], unit(env, "enemy", 0)["y"]) == (13.92, 20.0397)


def test_terrains_have_cut_corners() -> None:
    pentagon = TERRAINS["pentagon"].pathing
    assert np.flatnonzero(pentagon[:, 24]).tolist() == [12, 13, 14, 15]
    assert np.flatnonzero(pentagon[:, 19]).tolist() == list(range(7, 21))
    assert np.flatnonzero(pentagon[:, 7]).tolist() == list(range(8, 20))
    assert TERRAINS["rounded_square"].pathing.sum() == 16 * 14 - 4 * 6
    assert TERRAINS["lane"].pathing.sum() == 28 * 18


CHANGED: dict[str, Any] = {
    "head_start": 5,
    "order_latency": 3,
    "slide": 0.2,
    "rescan_period": 1,
    "redirect_missiles": True,
    "cooldown_from_release": True,
}


@pytest.mark.parametrize("name", [field.name for field in fields(Parameters)])
def test_every_parameter_matters(name: str) -> None:
    """In some battle of two maps; what it does has tests above, or none if it only moves the statistics."""
    default = getattr(Settings(), name)
    other = CHANGED.get(name, not default)
    assert other != default
    differs = False
    for map_name in ("3s5z", "3s_vs_5z"):
        outcomes = [
            play_policy(make_battle(map_name, **{name: value})[0], policy, episodes=40)
            for value in (default, other)
            for policy in (RANDOM, CLOSEST_ENEMY)
        ]
        differs |= not np.array_equal(outcomes[:2], outcomes[2:])
    assert differs
