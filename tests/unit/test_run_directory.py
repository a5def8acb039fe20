"""The run directory: what a resumed learner finds, also after damage."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from liir_common import config
from liir_common.errors import ConfigError, CorruptError
from services.learner.run_directory import Counters, RunDirectory
from tests.samples import SPEC

NOTES = {"openings": [{"batch": 3, "policy_version": 3, "epsilon": 0.5}]}


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    return RunDirectory(tmp_path / "run", config.load(), SPEC)


def save(run: RunDirectory, step: int) -> None:
    run.save_state(Counters(step, 10 * step, 2 * step), {"x": np.full(2, float(step))}, NOTES)


def test_state_round_trip_and_two_are_kept(run: RunDirectory) -> None:
    assert run.load_state() is None
    for step in (1, 2, 3):
        save(run, step)
    assert len(list((run.path / "state").iterdir())) == 2
    loaded = run.load_state()
    assert loaded is not None
    counters, arrays, notes = loaded
    assert counters == Counters(3, 30, 6)
    assert arrays["x"].tolist() == [3.0, 3.0]
    assert notes == NOTES


def states(run: RunDirectory) -> list[Path]:
    return sorted((run.path / "state").iterdir())


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:40])


def flip_a_bit(path: Path) -> None:
    """In the last weight, which stays a number."""
    data = bytearray(path.read_bytes())
    data[-2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [truncate, flip_a_bit])
def test_a_damaged_state_falls_back_to_the_one_before(
    run: RunDirectory, damage: Callable[[Path], None]
) -> None:
    save(run, 1)
    save(run, 2)
    damage(states(run)[-1])
    loaded = run.load_state()
    assert loaded is not None
    assert loaded[0].learner_step == 1
    damage(states(run)[0])
    with pytest.raises(CorruptError, match="restore one from a backup"):
        run.load_state()


def test_a_save_replaces_the_damaged_ones_that_it_makes_again(run: RunDirectory) -> None:
    for step in (1, 3, 5):
        save(run, step)
    flip_a_bit(states(run)[-1])
    save(run, 4)
    assert [path.stem[:15] for path in states(run)] == ["state-000000003", "state-000000004"]


def test_a_state_that_was_saved_before_there_were_digests_is_loaded(run: RunDirectory) -> None:
    save(run, 1)
    (path,) = states(run)
    path.rename(path.with_name("state-000000001.safetensors"))
    loaded = run.load_state()
    assert loaded is not None
    assert loaded[0].learner_step == run.oldest_state_step == 1


def test_a_run_keeps_its_id_and_its_environment(run: RunDirectory) -> None:
    again = RunDirectory(run.path, config.load(), SPEC)
    assert again.run_id == run.run_id
    with pytest.raises(ConfigError, match="resume with the simulator and env section that began it"):
        RunDirectory(run.path, config.load(), replace(SPEC, version="2"))


@pytest.mark.parametrize("record", ['{"run_id": "a', "[]", "{}"])
def test_a_damaged_record_is_explained(run: RunDirectory, record: str) -> None:
    (run.path / "run.json").write_text(record)
    with pytest.raises(CorruptError, match=r"run\.json is damaged .*; restore it from a backup"):
        RunDirectory(run.path, config.load(), SPEC)


def test_config_is_kept_resolved(run: RunDirectory) -> None:
    assert config.load(run.path / "config.yaml", ["preset=none"]).algorithm == config.load().algorithm
