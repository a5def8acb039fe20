"""`liir train` on games that are not ours to compile: StarCraft II's package, and a factory from the docs."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest

from tests.e2e import service

ROOT = Path(__file__).parents[2]
SHORT = ("training.total_env_steps=1500", "algorithm.policy_hidden=16")


def assert_trained(run_dir: Path, name: str) -> None:
    """Checkpoints came out of it, and each was tested in battles that were won or not."""
    assert json.loads((run_dir / "run.json").read_text())["env_spec"]["name"] == name
    steps = list(csv.DictReader((run_dir / "metrics.csv").open()))
    assert int(steps[-1]["env_steps"]) >= 1500
    assert {float(row["return_mean"]) for row in steps} != {0.0}
    tested = list(csv.DictReader((run_dir / "evaluations.csv").open()))
    assert sorted(int(row["episode"]) for row in tested) == list(service.digests(run_dir)) != []


def test_smac(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{ROOT / 'tests' / 'stand_in'}:{ROOT}")
    # As where StarCraft II's old messages are loaded beside ours.
    monkeypatch.setenv("PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION", "python")
    service.train(tmp_path / "run", "env=smac", *SHORT)
    assert_trained(tmp_path / "run", "smac/3m")


def test_a_factory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs" / "environments.md").read_text()
    (code,) = re.findall(r"^```python\n(# games.py.*?)^```$", text, re.DOTALL | re.MULTILINE)
    (tmp_path / "games.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    env = ("env=pettingzoo", "env.factory=games:stacked_battle", "env.options.map_name=3m")
    service.train(tmp_path / "run", *env, *SHORT)
    assert_trained(tmp_path / "run", "games:stacked_battle")
