"""The reward, recomputed the slow way from snapshots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from liir_common.battle.env import parallel_env
from liir_common.battle.snapshots import UnitRecord
from tests.unit.test_battle_mechanics import ATTACK, STOP, play, stage

DEFAULTS: dict[str, Any] = {
    "reward_only_positive": True,
    "reward_sparse": False,
    "reward_death_value": 10.0,
    "reward_win": 200.0,
    "reward_defeat": 0.0,
    "reward_negative_scale": 0.5,
    "reward_scale": True,
    "reward_scale_rate": 20.0,
    "double_max_reward": False,
}


def slow_reward(before: Sequence[UnitRecord], after: Sequence[UnitRecord], options: dict[str, Any]) -> float:
    """SMAC v1's reward of one step."""
    rules = DEFAULTS | options
    delta_ally = delta_enemy = delta_deaths = 0.0
    for old, new in zip(before, after, strict=True):
        if not old["alive"]:
            continue
        lost = old["health"] + old["shield"] - new["health"] - new["shield"]
        if new["team"] == "enemy":
            delta_enemy += lost
            delta_deaths += rules["reward_death_value"] * (not new["alive"])
        else:
            delta_ally += rules["reward_negative_scale"] * lost
            if not rules["reward_only_positive"]:
                delta_deaths -= (
                    rules["reward_negative_scale"] * rules["reward_death_value"] * (not new["alive"])
                )
    if rules["reward_only_positive"]:
        reward = abs(delta_enemy + delta_deaths)
    else:
        reward = delta_enemy + delta_deaths - delta_ally
    allies, enemies = ([u for u in after if u["team"] == team and u["alive"]] for team in ("ally", "enemy"))
    won, lost_all = bool(allies and not enemies), bool(enemies and not allies)
    if any(u["unit_type"] == "medivac" for u in after):
        # Medivacs alone have lost, which is asked first; a single one left of the enemies has lost too.
        lost_all = all(u["unit_type"] == "medivac" for u in allies)
        won = not lost_all and (won or [u["unit_type"] for u in enemies] == ["medivac"])
    reward += rules["reward_win"] * won + rules["reward_defeat"] * lost_all
    if rules["reward_sparse"]:
        reward = float(won) - float(lost_all)
    if rules["reward_scale"]:
        foes = [u for u in after if u["team"] == "enemy"]
        vitality = sum(u["health_max"] + u["shield_max"] for u in foes)
        largest = len(foes) * rules["reward_death_value"] + rules["reward_win"]
        largest += vitality * (1 + rules["double_max_reward"])
        reward /= largest / rules["reward_scale_rate"]
    return float(reward)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"reward_only_positive": False},
        {"reward_only_positive": False, "reward_negative_scale": 0.25, "reward_death_value": 3.0},
        {"reward_sparse": True},
        {"reward_sparse": True, "reward_scale": False},
        {"reward_defeat": -50.0, "reward_win": 100.0, "reward_scale_rate": 7.0},
        {"double_max_reward": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("map_name", ["3m", "8m", "2s3z", "MMM", "bane_vs_bane", "1c3s5z"])
def test_against_the_slow_one(map_name: str, options: dict[str, Any]) -> None:
    env = parallel_env(map_name, **options)
    for i, agent in enumerate(env.possible_agents):
        env.action_space(agent).seed(i)
    won = lost = 0
    for seed in range(8):
        env.reset(seed=seed)
        records = env.snapshot()
        # One team is nearly dead, so that both ends are seen.
        frail = "enemy" if seed % 2 else "ally"
        for record in records:
            if record["team"] == frail:
                record["health"], record["shield"] = 13.0, 0.0
        env.restore(records)
        infos: dict[str, dict[str, Any]] = {}
        while env.agents:
            before = env.snapshot()
            near = {
                a: next((k for k in range(ATTACK, len(m)) if m[k]), None)
                for a, m in zip(env.agents, env._masks, strict=True)
            }
            # Strong teams wait for the enemy, frail ones do anything.
            waits = frail == "enemy"
            actions = {
                a: near[a] or (STOP if waits and m[STOP] else env.action_space(a).sample())
                for a, m in zip(env.agents, env._masks, strict=True)
            }
            _, rewards, _, _, infos = env.step(actions)
            assert len(set(rewards.values())) == 1
            assert rewards["ally_0"] == pytest.approx(slow_reward(before, env.snapshot(), options), abs=1e-9)
        won += infos["ally_0"]["won"] == 1
        lost += infos["ally_0"]["dead_allies"] == len(infos)
    assert won
    assert lost


@pytest.mark.parametrize(
    ("map_name", "divisor"),
    [
        ("3m", 18.25),
        ("8m", 32),
        ("2s3z", 51),
        ("3s5z", 75.5),
        ("27m_vs_30m", 92.5),
        ("MMM", 50.75),
        ("MMM2", 60.25),
        ("1c3s5z", 93.5),
        ("2m_vs_1z", 18),
        ("corridor", 64),
        ("so_many_baneling", 74),
        ("bane_vs_bane", 63),
        ("2c_vs_64zg", 154),
        ("2s_vs_1sc", 25.5),
        ("6h_vs_8z", 74),
    ],
)
def test_divisors_are_those_of_smac(map_name: str, divisor: float) -> None:
    assert parallel_env(map_name)._tables.rules["reward_divisor"][0] == divisor


def test_regeneration_is_rewarded_in_the_positive_mode_and_charged_in_the_other() -> None:
    for only_positive, sign in [(True, 1), (False, -1)]:
        env = parallel_env("3s_vs_3z", reward_only_positive=only_positive)
        place = {"x": 28.0, "y": 28.0, "shield": 10.0}
        stage(env, {("ally", 0): {"x": 3.0, "y": 3.0}, ("enemy", 0): place})
        play(env, {}, steps=25)
        actions = {"ally_0": 1, "ally_1": 0, "ally_2": 0}
        assert env.step(actions)[1]["ally_0"] == pytest.approx(sign * 1 / 34)
