"""Figures 2, 4, 5 and the cosine, from real games played by networks that nobody trained."""

import json
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from liir_common.battle.tables import FIRST_ATTACK
from liir_common.cli import app
from liir_common.errors import ConfigError
from liir_common.figures import cosine, intrinsic, pursuit
from liir_common.figures.run import Battle, battles, load, play, taken
from liir_common.files import Table
from liir_common.sweep import plan
from tests.trained import make_run

PURSUIT = ("preset=none", "env.kind=pettingzoo", "env.factory=liir_common.pursuit:parallel_env")


@pytest.fixture(scope="module", params=["3m", "2s3z"])
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Battle]:
    run = make_run(tmp_path_factory.mktemp(request.param) / "run", f"env.map={request.param}")
    return list(battles(load(run), range(10), "sampled"))


@pytest.fixture
def battle(played: list[Battle]) -> Battle:
    return played[0]


def test_the_units_are_those_of_the_trajectory(battle: Battle) -> None:
    allies = [[u for u in units if u["team"] == "ally"] for units in battle.units]
    assert np.array_equal([[u["alive"] for u in units] for units in allies], battle.trajectory.alive)
    health = [units[0]["health"] / units[0]["health_max"] for units in allies]
    assert np.allclose(battle.trajectory.state[:, 0], health)  # the state begins with the first ally's


def test_r_in_taken_is_that_of_the_action(battle: Battle) -> None:
    r_in, trajectory = taken(battle.r_in, battle.trajectory), battle.trajectory
    assert np.array_equal(np.isnan(r_in), ~trajectory.alive[:-1])
    assert r_in[2, 1] == battle.r_in[2, 1, trajectory.actions[2, 1]]


def test_marks_are_the_first_death_and_the_largest_reward(battle: Battle) -> None:
    r_in = taken(battle.r_in, battle.trajectory)
    marks = {
        reason: step
        for step, text in intrinsic.marked_steps(battle, r_in).items()
        for reason in text.split(", ")
    }
    step = marks["first ally dies"]
    assert battle.trajectory.alive[: step + 1].all()
    assert not battle.trajectory.alive[step + 1].all()
    (largest,) = (reason for reason in marks if reason.startswith("largest"))
    agent = int(largest.rsplit(" ", 1)[1])
    assert abs(r_in[marks[largest], agent]) == np.nanmax(np.abs(r_in))


def test_the_battle_figure_is_written(tmp_path: Path) -> None:
    frozen = load(make_run(tmp_path / "run", episodes=(100, 200)), 100)
    figures = intrinsic.write_figure(
        frozen, "figure4", tmp_path / "out", index=3, mode="sampled", marks=(2, 5)
    )
    assert (tmp_path / "out" / "figure4.png").read_bytes().startswith(b"\x89PNG")
    kept = json.loads((tmp_path / "out" / "figure4.json").read_text())
    assert (kept["checkpoint"], kept["test_episode"], list(kept["marks"])) == (100, 3, ["2", "5"])
    assert len(kept["r_in"]) == len(kept["health"]) == len(figures["action"])
    with pytest.raises(ConfigError, match=r"marks want steps from 0 to \d+ of this battle, got \[999\]"):
        intrinsic.write_figure(frozen, "figure4", tmp_path / "out", marks=(999,))


def health_of(battle: Battle) -> np.ndarray:
    return np.array(
        [[u["health"] / u["health_max"] for u in units if u["team"] == "ally"] for units in battle.units[:-1]]
    )


@pytest.mark.parametrize(
    ("reward", "wanted"), [(lambda h: 3 * h, 1.0), (lambda h: -h, -1.0), (lambda h: 0 * h + 2, None)]
)
def test_the_cosine_follows_health(
    played: list[Battle], reward: Callable[[Any], Any], wanted: float | None
) -> None:
    found = []
    for battle in played:
        r_in = np.repeat(reward(health_of(battle))[..., None], battle.r_in.shape[-1], -1)
        found += cosine.lives(replace(battle, r_in=r_in))
    readings = cosine.measure(found)
    assert readings["attacks possible, per life"]["vectors"] >= 2
    for name, reading in readings.items():
        if wanted is not None:
            assert reading["cosine"] == pytest.approx(wanted), name
        elif "centred" not in name:
            assert 0.5 < reading["cosine"] < 1, name  # a constant is not health, though never far from it


def test_the_cosine_sees_weak_attackers_only(battle: Battle) -> None:
    """Whatever r_in is elsewhere does not count."""
    health, trajectory = health_of(battle), battle.trajectory
    counts = (health < 0.5)[..., None] & trajectory.mask[:-1]
    counts[..., :FIRST_ATTACK] = False
    garbage = np.where(counts, battle.r_in, np.float32(1e6))
    assert cosine.measure(cosine.lives(replace(battle, r_in=garbage))) == cosine.measure(cosine.lives(battle))
    attacks = counts & (np.arange(counts.shape[-1]) == trajectory.actions[..., None])
    readings = cosine.measure(cosine.lives(battle))
    assert readings["attacks made, all in one vector"]["values"] == attacks.sum()


def test_the_cosine_is_written(tmp_path: Path) -> None:
    cosine.write_figure(load(make_run(tmp_path / "run")), tmp_path, episodes=5, mode="sampled")
    figures = json.loads((tmp_path / "cosine.json").read_text())
    assert (figures["episodes"], figures["paper"], len(figures["readings"])) == (5, 0.67, 5)
    assert "The paper states 0.67 for 3m." in (tmp_path / "cosine.txt").read_text()


def towards_target(obs: np.ndarray) -> np.ndarray:
    """What an intrinsic reward that knew everything would give for staying, +1 and -1."""
    side = np.sign(obs[..., 0])
    return np.stack([0 * side, -side, side], -1)


def test_good_and_bad_actions_are_told_apart(tmp_path: Path) -> None:
    frozen = replace(load(make_run(tmp_path / "run", *PURSUIT)), r_in=towards_target)
    found = pursuit.split(frozen, 1.0, episodes=100)
    figures = found.figures()
    assert (figures["mean_good"], figures["mean_bad"], figures["auc"], figures["overlap"]) == (1, -1, 1, 0)
    # Uniform actions: a third each way, the target being where an episode ends.
    actions = np.concatenate([t.actions.ravel() for t in play(frozen, range(100), "sampled", 1.0)])
    assert np.bincount(actions) / len(actions) == pytest.approx([1 / 3] * 3, abs=0.03)
    assert len(found.good) + len(found.bad) == np.count_nonzero(actions)
    blind = pursuit.split(replace(frozen, r_in=lambda obs: np.ones((*obs.shape[:-1], 3))), 1.0, episodes=20)
    assert blind.figures()["auc"] == 0.5


def make_sweep(folder: Path) -> Path:
    """File of a sweep of two seeds of 1D Pursuit that have all their steps already, under `folder`."""
    env = {"kind": "pettingzoo", "factory": "liir_common.pursuit:parallel_env"}
    base = {
        "preset": "none",
        "env": env,
        "training": {"total_env_steps": 10},
        "evaluation": {"enabled": False},
    }
    sweep = {"base": base, "maps": {"pursuit": {}}, "methods": {"liir": {}}, "seeds": [1, 2]}
    (folder / "sweep.yaml").write_text(yaml.safe_dump(sweep))
    for run in plan(folder / "sweep.yaml"):
        make_run(folder / run.name, *PURSUIT, f"seed={run.seed}", episodes=(100 * run.seed,))
        (folder / run.name / "config.yaml").write_text(yaml.safe_dump(run.config.tree()))
        Table(folder / run.name / "metrics.csv").append({"env_steps": 10, "episodes": 1})
    return folder / "sweep.yaml"


def test_figure_2_measures_what_random_and_learned_actions_earn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pursuit, "write_figure", partial(pursuit.write_figure, episodes=10))
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the sweep's handlers would stay
    command = ["figure", "2", str(make_sweep(tmp_path)), "-o", str(tmp_path)]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    kept = json.loads((tmp_path / "figure2.json").read_text())
    method = kept["methods"]["liir"]
    for seed in ("1", "2"):
        frozen = load(tmp_path / f"pursuit-liir-seed{seed}")
        random, learned = (pursuit.split(frozen, share, 10).figures() for share in (1.0, 0.0))
        assert random != learned
        assert method["seeds"][seed] == frozen.about() | {"random": random, "learned": learned}
    for policy, spread in method["auc"].items():
        first, second = (method["seeds"][seed][policy]["auc"] for seed in ("1", "2"))
        assert spread == {"mean": (first + second) / 2, "min": min(first, second), "max": max(first, second)}
        assert f"AUC on actions of the {policy:8} policy: mean {spread['mean']:.3f}" in done.stdout
    assert (tmp_path / "figure2.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_of_the_wrong_run_is_refused(tmp_path: Path) -> None:
    battle_run, pursuit_run = make_run(tmp_path / "b"), make_run(tmp_path / "p", *PURSUIT)
    with pytest.raises(ConfigError, match="wants runs on 1D Pursuit"):
        pursuit.split(load(battle_run), 1.0, 1)
    with pytest.raises(ConfigError, match="wants a run on a battle map"):
        next(battles(load(pursuit_run), range(1), "greedy"))
    with pytest.raises(ConfigError, match="holds no run"):
        load(tmp_path)
    with pytest.raises(ConfigError, match=r"no checkpoint 7 \(there: 100 to 100\)"):
        load(battle_run, 7)
    other = load(battle_run)
    with pytest.raises(ConfigError, match="this build plays"):
        next(play(replace(other, spec=replace(other.spec, version="0")), range(1), "greedy"))
