"""The rules of the battle, each seen on units put where it shows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import pytest

from liir_common.battle import scenarios
from liir_common.battle.env import BattleEnv, parallel_env
from liir_common.battle.parameters import Parameters, Settings
from liir_common.battle.policies import CLOSEST_ENEMY, RANDOM, STAND
from liir_common.battle.policies import play as play_policy
from liir_common.battle.scenarios import make_battle
from liir_common.battle.snapshots import UnitRecord
from liir_common.battle.terrain import MAP_SIZE, TERRAINS, routes

STOP, NORTH, SOUTH, EAST, WEST, ATTACK = range(1, 7)
FAR = {"x": 29.0, "y": 24.0}


def stage(env: BattleEnv, changes: Mapping[tuple[str, int], Mapping[str, Any]], seed: int = 1) -> None:
    """Start an episode in which only the units named take part, enemies idle unless said otherwise."""
    env.reset(seed=seed)
    records = env.snapshot()
    for record in records:
        key = (record["team"], record["id"])
        if key in changes:
            record.update({"order": "idle", "target": None, **changes[key]})  # type: ignore[typeddict-item]
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


def test_walls_hold() -> None:
    """A stalker walks 1.29 in its first step, and the open ground ends at 30."""
    env = parallel_env("3s_vs_3z")
    stage(env, {("ally", 0): {"x": 15.0, "y": 29.2}, ("enemy", 0): FAR})
    assert not env._masks[0, NORTH]
    stage(env, {("ally", 0): {"x": 15.0, "y": 28.95}, ("enemy", 0): FAR})
    play(env, {0: NORTH})
    assert 30 - 2.9531 / 16 <= unit(env, "ally", 0)["y"] < 30


def test_walls_are_slid_along() -> None:
    """The goal is as far beyond the wall at 25 as it is eastward; that part of the way is walked."""
    env = parallel_env("3m")
    aslant = {"x": 15.0, "y": 24.9, "order": "move", "goal_x": 23.0, "goal_y": 32.9}
    stage(env, {("ally", 0): {"x": 3.0, "y": 8.0}, ("enemy", 0): aslant})
    play(env, {}, steps=3)
    walker = unit(env, "enemy", 0)
    assert 24.9 <= walker["y"] < 25
    assert walker["x"] > 17


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


@pytest.mark.parametrize(("redirects", "hurt"), [(False, 0), (True, 13)])
def test_a_missile_is_lost_with_its_target(redirects: bool, hurt: int) -> None:
    """Two stalkers fire at a point of life: the second shot costs its cooldown, and hits nobody unless told
    to fly on."""
    env = parallel_env("3s_vs_3z", redirect_missiles=redirects)
    stage(
        env,
        {
            ("ally", 0): {"x": 10.0, "y": 15.0},
            ("ally", 1): {"x": 10.0, "y": 17.0},
            ("enemy", 0): {"x": 15.0, "y": 16.0, "health": 1.0, "shield": 0.0},
            ("enemy", 1): {"x": 17.0, "y": 16.0},
        },
    )
    play(env, {0: ATTACK, 1: ATTACK}, steps=2)
    assert not unit(env, "enemy", 0)["alive"]
    assert unit(env, "enemy", 1)["shield"] == 50 - hurt
    assert all(unit(env, "ally", i)["cooldown"] > 10 for i in range(2))


@pytest.mark.parametrize(("from_release", "windup"), [(False, 0.0), (True, 0.167 * 16)])
def test_the_cooldown_starts_with_the_attack_or_at_its_damage_point(
    from_release: bool, windup: float
) -> None:
    """A stalker's attacks are 1.87 s and a delay of -1 to 2 loops apart, and half a loop of waiting."""
    env = parallel_env("3s_vs_3z", step_mul=1, order_latency=0, cooldown_from_release=from_release)
    env._tables.rules["limit"] = 10_000
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 14.0, "y": 15.0}})
    fired, before = [], 0.0
    for loop in range(9000):
        play(env, {0: ATTACK})
        after = unit(env, "ally", 0)["cooldown"]
        if after > before:
            fired.append(loop)
        before = after
        env._battle.units["health"][3] = 100.0
    # The standard deviation of an interval is 0.9 loops.
    assert np.diff(fired).mean() == pytest.approx(1.87 * 16 + 0.5 + 0.5 + windup, abs=0.3)


@pytest.mark.parametrize("from_release", [False, True])
def test_an_attack_interrupted_before_its_hit_is_free_if_the_cooldown_starts_there(
    from_release: bool,
) -> None:
    env = parallel_env("3s_vs_3z", step_mul=2, order_latency=0, cooldown_from_release=from_release)
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 14.0, "y": 15.0}})
    play(env, {0: ATTACK})
    play(env, {0: STOP}, steps=3)
    assert unit(env, "enemy", 0)["shield"] == 50
    assert (unit(env, "ally", 0)["cooldown"] == 0) is from_release


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
    outcome = {key: infos["ally_0"][key] for key in ("alive", "won", "dead_allies", "dead_enemies")}
    assert outcome == {"alive": False, "won": 0.0, "dead_allies": 5.0, "dead_enemies": 5.0}
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


def test_six_zealots_surround_one_and_a_seventh_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six equal discs fit around another, and a zealot reaches 0.1 beyond touching."""
    crowd = scenarios._facing("7z_vs_1z", {"zealot": 7}, {"zealot": 1}, limit=60)
    monkeypatch.setitem(scenarios.SCENARIOS, "7z_vs_1z", crowd)  # type: ignore[arg-type]
    env = parallel_env("7z_vs_1z")
    ring = {
        ("ally", k): {"x": 15 + 1.05 * math.cos(k * math.pi / 3), "y": 15 + 1.05 * math.sin(k * math.pi / 3)}
        for k in range(6)
    }
    stage(env, {**ring, ("ally", 6): {"x": 18.0, "y": 15.4}, ("enemy", 0): {"x": 15.0, "y": 15.0}})
    for _ in range(6):
        play(env, dict.fromkeys(range(7), ATTACK))
        env._battle.units["health"][7] = 100.0
        assert unit(env, "ally", 6)["cooldown"] == 0
    assert all(unit(env, "ally", k)["cooldown"] > 0 for k in range(6))
    assert 1.1 < distance(unit(env, "ally", 6), unit(env, "enemy", 0)) < 2.5
    records = env.snapshot()
    records[0] |= {"alive": False, "health": 0.0, "shield": 0.0}
    env.restore(records)
    play(env, dict.fromkeys(range(7), ATTACK), steps=2)
    assert unit(env, "ally", 6)["cooldown"] > 0, "there is room for it now"


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


MEDIVAC = 9
"""The number of the medivac in both teams of MMM; 0 and 1 are marauders, from 2 on marines, among allies."""


def test_a_medivac_heals_for_energy() -> None:
    """9 points of life per second at 0.33 energy each, while 0.5625 energy per second come back."""
    env = parallel_env("MMM")
    medivac, hurt = {"x": 10.0, "y": 15.0, "energy": 50.0}, {"x": 12.0, "y": 15.0, "health": 20.0}
    stage(env, {("ally", MEDIVAC): medivac, ("ally", 4): hurt, ("enemy", 0): FAR})
    play(env, {MEDIVAC: ATTACK + 4}, steps=4)
    loops = 4 * 8 - 1
    assert unit(env, "ally", 4)["health"] == pytest.approx(20 + loops * 9 / 16)
    spent = loops * 9 / 16 * 0.33
    assert unit(env, "ally", MEDIVAC)["energy"] == pytest.approx(50 - spent + 32 * 0.5625 / 16)
    assert unit(env, "ally", MEDIVAC)["target"] == 4


def test_healing_ends_with_the_energy_and_at_full_health() -> None:
    env = parallel_env("MMM")
    medivac, hurt = {"x": 10.0, "y": 15.0, "energy": 1.0}, {"x": 12.0, "y": 15.0, "health": 20.0}
    stage(env, {("ally", MEDIVAC): medivac, ("ally", 4): hurt, ("enemy", 0): FAR})
    play(env, {MEDIVAC: ATTACK + 4}, steps=8)
    assert unit(env, "ally", 4)["health"] == pytest.approx(20 + (1 + 64 * 0.5625 / 16) / 0.33, abs=0.2)
    medivac["energy"], hurt["health"] = 50.0, 44.0
    stage(env, {("ally", MEDIVAC): medivac, ("ally", 4): hurt, ("enemy", 0): FAR})
    play(env, {MEDIVAC: ATTACK + 4}, steps=8)
    assert unit(env, "ally", 4)["health"] == 45.0


def test_a_medivac_flies_up_slowly_and_over_others() -> None:
    """It reaches 4 beyond the radii, takes 19 loops to full speed, and pushes nobody."""
    env = parallel_env("MMM")
    hurt = {"x": 20.0, "y": 15.0, "health": 5.0}
    between = {"x": 12.0, "y": 15.0}
    medivac = {"x": 10.0, "y": 15.0, "energy": 50.0}
    stage(env, {("ally", MEDIVAC): medivac, ("ally", 4): hurt, ("ally", 5): between, ("enemy", 0): FAR})
    env._masks[MEDIVAC, ATTACK + 4] = True
    play(env, {MEDIVAC: ATTACK + 4})
    paces = sum(min(2.75 / 16, k * 2.3125 / 256) for k in range(1, 8))
    assert unit(env, "ally", MEDIVAC)["x"] == pytest.approx(10 + paces)
    for _ in range(5):
        env._masks[MEDIVAC, ATTACK + 4] = True
        play(env, {MEDIVAC: ATTACK + 4})
    assert distance(unit(env, "ally", MEDIVAC), unit(env, "ally", 4)) <= 4 + 0.75 + 0.375
    assert unit(env, "ally", 5)["y"] == 15.0
    assert unit(env, "ally", 4)["health"] > 5.0


def test_nobody_is_pushed_off_the_map() -> None:
    """Two aircraft at its very border, one of which flies into the other."""
    env = parallel_env("MMM", obs_terrain_height=True)
    stage(env, {("ally", MEDIVAC): {"x": 30.98, "y": 15.97}, ("enemy", MEDIVAC): {"x": 30.96, "y": 16.0}})
    env._masks[MEDIVAC, NORTH] = True
    play(env, {MEDIVAC: NORTH})
    ally = unit(env, "ally", MEDIVAC)
    assert ally["x"] < MAP_SIZE - 1
    assert ally["y"] < 15.5, "pushed back all the same"


def test_an_enemy_medivac_treats_the_worst_hurt_of_its_own_accord() -> None:
    env = parallel_env("MMM")
    medivac = {"x": 20.0, "y": 15.0, "order": "attack_move"}
    stage(
        env,
        {
            ("ally", 0): {"x": 3.0, "y": 8.0},
            ("enemy", MEDIVAC): medivac,
            ("enemy", 0): {"x": 21.0, "y": 15.0, "health": 30.0},
            ("enemy", 1): {"x": 23.0, "y": 15.0, "health": 10.0},
        },
    )
    play(env, {})
    assert unit(env, "enemy", MEDIVAC)["target"] == 1
    assert unit(env, "enemy", 1)["health"] == pytest.approx(10 + 8 * 9 / 16)
    assert unit(env, "enemy", 0)["health"] == 30.0


@pytest.mark.parametrize("autocast", [False, True])
def test_an_agents_medivac_is_as_passive_as_the_others(autocast: bool) -> None:
    env = parallel_env("MMM", medivac_autocast=autocast)
    hurt = {"x": 12.0, "y": 15.0, "health": 20.0}
    medivac = {"x": 10.0, "y": 15.0, "energy": 50.0}
    stage(env, {("ally", MEDIVAC): medivac, ("ally", 4): hurt, ("enemy", 0): FAR})
    play(env, {})
    assert (unit(env, "ally", 4)["health"] > 20.0) is autocast


def test_marauders_cannot_hit_what_flies_and_marines_can() -> None:
    env = parallel_env("MMM")
    flying = {"x": 14.0, "y": 15.0}
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", MEDIVAC): flying, ("enemy", 0): FAR})
    play(env, {0: ATTACK + MEDIVAC}, steps=3)
    assert unit(env, "enemy", MEDIVAC)["health"] == 150.0
    stage(env, {("ally", 2): {"x": 10.0, "y": 15.0}, ("enemy", MEDIVAC): flying, ("enemy", 0): FAR})
    play(env, {2: ATTACK + MEDIVAC})
    assert unit(env, "enemy", MEDIVAC)["health"] == 150.0 - 5


def test_an_attack_on_what_flies_is_no_order_for_a_marauder() -> None:
    """It goes on with what it did before."""
    env = parallel_env("MMM")
    flying = {"x": 14.0, "y": 15.0}
    stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", MEDIVAC): flying, ("enemy", 0): FAR})
    play(env, {0: NORTH})
    play(env, {0: ATTACK + MEDIVAC})
    marauder = unit(env, "ally", 0)
    assert (marauder["order"], marauder["target"]) == ("move", None)
    assert marauder["y"] == 17.0, "where the first order led"


@pytest.mark.parametrize(
    ("left", "won", "over"),
    [
        ([("ally", MEDIVAC), ("enemy", 0)], 0, True),
        ([("ally", 0), ("enemy", MEDIVAC)], 1, True),
        ([("ally", MEDIVAC), ("enemy", MEDIVAC)], 0, True),
        ([("ally", 0), ("enemy", 0)], 0, False),
    ],
    ids=["only our medivac", "only theirs", "only medivacs", "fighters"],
)
def test_medivacs_alone_are_beaten(left: list[tuple[str, int]], won: int, over: bool) -> None:
    env = parallel_env("MMM")
    places = ({"x": 4.0, "y": 9.0}, {"x": 28.0, "y": 23.0})
    stage(env, dict(zip(left, places, strict=True)))
    infos = play(env, {})
    assert (not env.agents) is over
    assert infos["ally_0"].get("won", 0) == won


def test_beams_sweep_across_the_shot() -> None:
    """Two beams of 10 + 5 on light units: the target and what stands beside it within the beams' length."""
    env = parallel_env("2c_vs_64zg")
    at = {0: (16.0, 10.0), 1: (16.8, 10.0), 2: (14.9, 10.0), 3: (18.0, 10.0), 4: (16.0, 9.2)}
    changes: dict[tuple[str, int], dict[str, Any]] = {
        ("enemy", k): {"x": x, "y": y} for k, (x, y) in at.items()
    }
    stage(env, {("ally", 0): {"x": 16.0, "y": 15.0}, **changes})
    play(env, {0: ATTACK}, steps=2)
    lost = {k: 35 - unit(env, "enemy", k)["health"] for k in at}
    # Zerglings win back a little of it.
    assert lost == pytest.approx({0: 30, 1: 30, 2: 30, 3: 0, 4: 0}, abs=0.3)
    assert lost[3] == lost[4] == 0


def test_beams_spare_friends() -> None:
    env = parallel_env("1c3s5z")
    friend = {"x": 13.0, "y": 16.0}
    stage(
        env,
        {
            ("ally", 0): {"x": 8.0, "y": 15.0},
            ("ally", 4): friend,
            ("enemy", 4): {"x": 13.0, "y": 15.0},
            ("enemy", 5): {"x": 13.0, "y": 14.0},
        },
    )
    play(env, {0: ATTACK + 4}, steps=2)
    assert unit(env, "ally", 4)["shield"] == 50
    assert [unit(env, "enemy", k)["shield"] for k in (4, 5)] == [20, 20]


def test_colossi_cross_the_cliff_and_zerglings_go_around() -> None:
    env = parallel_env("2c_vs_64zg")
    far = {"x": 28.5, "y": 8.0}
    stage(env, {("ally", 0): {"x": 16.0, "y": 15.1}, ("enemy", 0): far})
    play(env, {0: SOUTH}, steps=3)
    assert unit(env, "ally", 0)["y"] == pytest.approx(15.1 - 23 * 2.25 / 16)
    stage(env, {("ally", 0): {"x": 16.0, "y": 15.0}, ("enemy", 0): {"x": 16.0, "y": 10.0, "order": "attack"}})
    env._battle.units["target"][2] = 0
    trail = []
    while unit(env, "ally", 0)["shield"] == 150 and len(trail) < 40:
        play(env, {})
        trail.append((unit(env, "enemy", 0)["x"], unit(env, "enemy", 0)["y"]))
    assert max(abs(x - 16) for x, _ in trail) > 11.5, "over a ramp"
    assert unit(env, "ally", 0)["shield"] < 150


def test_the_whole_pack_reaches_its_prey() -> None:
    """64 zerglings from below the cliff; two colossi that stand are dead long before the limit."""
    outcomes = play_policy(make_battle("2c_vs_64zg")[0], STAND, episodes=20)
    assert (outcomes[:, 3] == 2).all()
    assert outcomes[:, 0].max() < 60


@pytest.mark.parametrize("terrain", TERRAINS)
def test_routes_lead_everywhere(terrain: str) -> None:
    """From any open cell to any other in a few bends; straight where the table is silent."""
    table, cells = routes(terrain), np.flatnonzero(TERRAINS[terrain].pathing)
    assert bool(table.size) is TERRAINS[terrain].has_obstacles
    if not table.size:
        return
    for goal in cells[::5]:
        at = cells.copy()
        for _ in range(6):
            bend = table[at, goal]
            at = np.where(bend < 0, at, bend)
        assert (table[at, goal] < 0).all()


def walks_straight(terrain: str) -> bool:
    """Whether every straight way between open cells stays on open ground: what convex means."""
    pathing = TERRAINS[terrain].pathing
    cells = np.argwhere(pathing)[::3] + 0.5
    shares = np.linspace(0, 1, MAP_SIZE)[:, None, None, None]
    ways = (cells[None, :, None] + shares * (cells[None, None] - cells[None, :, None])).astype(int)
    return bool(pathing[ways[..., 0], ways[..., 1]].all())


@pytest.mark.parametrize("terrain", TERRAINS)
def test_obstacles_are_where_straight_ways_fail(terrain: str) -> None:
    assert walks_straight(terrain) is not TERRAINS[terrain].has_obstacles


def test_a_baneling_bursts_among_its_enemies_only() -> None:
    """35 on light units within 2.2 of its centre and their own radius; it dies, its friends do not."""
    env = parallel_env("bane_vs_bane")
    stage(
        env,
        {
            ("ally", 0): {"x": 16.0, "y": 15.0},
            ("ally", 5): {"x": 15.2, "y": 15.0},
            ("enemy", 0): {"x": 16.8, "y": 15.0, "health": 20.0},
            ("enemy", 1): {"x": 16.0, "y": 17.5, "health": 35.0},
            ("enemy", 2): {"x": 16.0, "y": 12.3, "health": 35.0},
            ("enemy", 20): {"x": 18.0, "y": 15.0, "health": 30.0},
        },
    )
    play(env, {0: ATTACK})
    assert not unit(env, "ally", 0)["alive"]
    assert unit(env, "ally", 5)["health"] == 35
    # Zerglings are light, banelings are not: 35 and 20.
    assert [unit(env, "enemy", k)["alive"] for k in (0, 1, 2, 20)] == [False, False, True, True]
    assert unit(env, "enemy", 20)["health"] == pytest.approx(10, abs=0.2)


def test_a_baneling_that_is_killed_bursts_too() -> None:
    """And what its blast kills bursts in turn."""
    env = parallel_env("bane_vs_bane")
    stage(
        env,
        {
            ("ally", 4): {"x": 16.0, "y": 15.0},
            ("ally", 0): {"x": 17.0, "y": 16.0, "health": 15.0},
            ("ally", 6): {"x": 22.0, "y": 15.0},
            ("enemy", 20): {"x": 16.85, "y": 15.0, "health": 4.0},
            ("enemy", 3): {"x": 17.5, "y": 17.5},
            ("enemy", 4): {"x": 24.0, "y": 20.0},
        },
    )
    play(env, {4: ATTACK + 20})
    assert not unit(env, "enemy", 20)["alive"]
    assert not unit(env, "ally", 4)["alive"], "in the blast"
    assert not unit(env, "ally", 0)["alive"], "in the blast"
    assert not unit(env, "enemy", 3)["alive"], "in the blast of the baneling that the blast killed"
    assert unit(env, "ally", 6)["alive"]


def test_zerglings_bite_every_eleven_loops() -> None:
    """Period 0.696 s and a random delay of -1 to 2 loops: 0.5 loop on average, and half a loop of waiting."""
    env = parallel_env("bane_vs_bane")
    bites = 0
    for seed in range(40):
        stage(env, {("ally", 4): {"x": 16.0, "y": 15.0}, ("enemy", 0): {"x": 16.8, "y": 15.0}}, seed)
        for _ in range(60):
            play(env, {4: ATTACK})
            bites += round((35 - unit(env, "enemy", 0)["health"]) / 5)
            env._battle.units["health"][24] = 35.0
    assert bites / 40 == pytest.approx(480 / (0.696 * 16 + 0.5 + 0.5), rel=0.02)


def test_the_zealot_of_2m_vs_1z_walks_to_a_random_point_between_the_marines() -> None:
    env, goals = parallel_env("2m_vs_1z"), []
    for seed in range(200):
        env.reset(seed=seed)
        goals.append((env._battle.units["goal_x"][2], env._battle.units["goal_y"][2]))
    xs = np.array(goals)[:, 0]
    assert 13 <= xs.min() < 13.3
    assert 18.7 < xs.max() <= 19
    assert {y for _, y in goals} == {12.0}


def test_base_liberty_has_the_weapons_that_the_archives_name() -> None:
    lost = {}
    for balance in ("multiplayer", "base_liberty"):
        env = parallel_env("3s_vs_3z", balance=balance)
        stage(env, {("ally", 0): {"x": 10.0, "y": 15.0}, ("enemy", 0): {"x": 14.0, "y": 15.0}})
        play(env, {0: ATTACK}, steps=2)
        lost[balance] = 50 - unit(env, "enemy", 0)["shield"]
    assert lost == {"multiplayer": 13, "base_liberty": 10}


def test_longer_steps_and_moves() -> None:
    env = parallel_env("3m", step_mul=16, move_amount=1.0)
    stage(env, {("ally", 0): {"x": 15.0, "y": 15.0}, ("enemy", 0): FAR})
    play(env, {0: EAST})
    assert unit(env, "ally", 0)["x"] == pytest.approx(16.0), "where the order led"
    assert env._battle.clock[0] == Settings().head_start + 16


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
    "balance": "base_liberty",
}


def play_some(map_name: str, **changed: Any) -> Iterator[np.ndarray]:
    """Outcomes by policy."""
    tables, _ = make_battle(map_name, **changed)
    for policy in (RANDOM, CLOSEST_ENEMY):
        yield play_policy(tables, policy, episodes=20)


@cache
def by_default(map_name: str) -> list[np.ndarray]:
    return list(play_some(map_name))


@pytest.mark.parametrize("name", [field.name for field in fields(Parameters)])
def test_every_parameter_matters(name: str) -> None:
    """In some battle of four maps; what it does has tests above, or none if it only moves the statistics."""
    default = getattr(Settings(), name)
    other = CHANGED.get(name, not default)
    assert other != default
    assert any(
        not np.array_equal(changed, usual)
        for map_name in ("3s5z", "3s_vs_5z", "MMM", "2c_vs_64zg")
        for changed, usual in zip(play_some(map_name, **{name: other}), by_default(map_name), strict=True)
    )
