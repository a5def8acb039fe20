"""What holds in every battle, whatever is played."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liir_common.battle.engine import STEPS
from liir_common.battle.env import BattleEnv, parallel_env
from liir_common.battle.scenarios import SCENARIOS
from tests.unit.test_battle_observation import Reference

# The return is then what was taken from the enemies, and 10 for each of them.
DAMAGE = {
    "reward_scale": False,
    "reward_win": 0.0,
    "reward_only_positive": False,
    "reward_negative_scale": 0.0,
}
ENVS = {name: parallel_env(name, **DAMAGE) for name in SCENARIOS}


REFERENCES = {name: Reference(name, {}) for name in SCENARIOS}


def check_units(env: BattleEnv) -> None:
    for unit, spec in zip(env.snapshot(), env._tables.specs, strict=True):
        assert 0 <= unit["health"] <= unit["health_max"]
        assert 0 <= unit["shield"] <= unit["shield_max"]
        assert unit["alive"] == (unit["health"] > 0)
        assert 0 <= unit["energy"] <= 200
        assert env._tables.layers[spec["layer"], int(unit["x"]), int(unit["y"])]
        assert np.isfinite([unit["x"], unit["y"], unit["cooldown"]]).all()


def check_dead(env: BattleEnv, dead: Any, x: Any, y: Any, before: Any) -> None:
    """Units that were dead a step ago are so still, have not moved, and have begun nothing."""
    after = env._battle.units[dead]
    assert not env._battle.alive[dead].any()
    assert np.array_equal((env._battle.x[dead], env._battle.y[dead]), (x, y))
    for name in ("health", "shield", "ready_at", "hit_at", "aim"):
        assert np.array_equal(after[name], before[name])
    assert (after["hits"] == 0).all()
    flying = after["missile_target"] >= 0
    assert np.array_equal(after["missile_target"][flying], before["missile_target"][flying])


def vitality(env: BattleEnv, team: str) -> float:
    return sum(u["health"] + u["shield"] for u in env.snapshot() if u["team"] == team)


@pytest.mark.parametrize("map_name", SCENARIOS)
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**64 - 1), bold=st.booleans())
def test_invariants(map_name: str, seed: int, bold: bool) -> None:
    env, rng = ENVS[map_name], np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed)
    total, limit = 0.0, int(env._tables.rules["limit"][0])
    started_with = vitality(env, "enemy")
    for _ in range(limit):
        dead = np.flatnonzero(~env._battle.alive[: len(env._battle.units)])
        before = env._battle.x[dead], env._battle.y[dead], env._battle.units[dead]
        actions = {}
        for agent in env.agents:
            available = np.flatnonzero(observations[agent]["action_mask"])
            actions[agent] = int(available[-1] if bold else rng.choice(available))
        observations, rewards, terminated, truncated, infos = env.step(actions)
        total += rewards["ally_0"]
        check_units(env)
        check_dead(env, dead, *before)
        units = env.snapshot()
        for i, (agent, observation) in enumerate(observations.items()):
            assert observation["action_mask"].tolist() == REFERENCES[map_name].mask(units[i], units)
            assert np.isfinite(observation["observation"]).all()
            assert np.abs(observation["observation"]).max() <= 1
            assert observation["action_mask"].any()
            assert observation["action_mask"][0] == (not infos[agent]["alive"])
        assert np.isfinite(env.state()).all()
        if not env.agents:
            break
    assert not env.agents, "an episode ends at the limit at the latest"
    assert any(terminated.values()) != any(truncated.values())
    assert any(terminated.values()) or env._battle.status[STEPS] == limit
    dead_enemies = infos["ally_0"]["dead_enemies"]
    assert total == pytest.approx(started_with - vitality(env, "enemy") + 10 * dead_enemies)
