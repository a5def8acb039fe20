"""The exported graph decides as the policy does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from typer.testing import CliRunner

from liir_common import checkpoint
from liir_common.battle.env import battle_spec
from liir_common.cli import app
from liir_common.config import EnvConfig
from liir_common.errors import ConfigError, CorruptError
from liir_common.replay.load import load_checkpoint
from liir_common.replay.record import policy_outputs
from liir_common.rollout.play import make_player
from liir_common.types import Exploration, Ticket
from tests.replays import HIDDEN, publish


def export(path: Path) -> onnxruntime.InferenceSession:
    output = path.with_suffix(".onnx")
    result = CliRunner().invoke(app, ["export", str(path), "-o", str(output)], catch_exceptions=False)
    assert result.stdout.split() == [str(output)]
    return onnxruntime.InferenceSession(output, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(("method", "name"), [("liir", "logits"), ("vdn", "q_values")])
def test_it_decides_as_the_policy_over_whole_battles(tmp_path: Path, method: str, name: str) -> None:
    path = publish(tmp_path, method=method)
    manifest, tensors = load_checkpoint(path)
    weights = checkpoint.section(tensors, "policy")
    player = make_player(EnvConfig.model_validate(manifest.config["env"]), HIDDEN)
    player.load(weights)
    session = export(path)
    for seed in (5, 6):
        # Drawn at random, so that the last action is not always the graph's own.
        played = player.play(Ticket(0, 3, seed, Exploration.EPSILON_GREEDY, 0.5))
        outputs = policy_outputs(weights, player.spec, played)
        last, hidden = np.full((1, 5), -1), np.zeros((1, 5, HIDDEN), np.float32)
        for t in range(played.length):
            mask = played.mask[t]
            feed = {"observations": played.obs[t][None], "last_actions": last, "action_mask": mask[None]}
            actions, values, hidden = session.run(["actions", name, "next_hidden"], feed | {"hidden": hidden})
            np.testing.assert_allclose(values[0][mask], outputs[t][mask], atol=2e-6)
            assert (values[0][~mask] == -np.inf).all()
            assert np.array_equal(actions[0], np.where(mask, outputs[t], -np.inf).argmax(-1))
            last = played.actions[t][None].astype(np.int64)


def test_a_batch_of_teams_is_decided_at_once(tmp_path: Path) -> None:
    session, random = export(publish(tmp_path)), np.random.default_rng(1)
    spec = battle_spec("2s3z")
    teams: dict[str, Any] = {
        "observations": random.standard_normal((7, 5, spec.obs_dim)).astype(np.float32),
        "last_actions": random.integers(-1, spec.n_actions, (7, 5)),
        "action_mask": random.random((7, 5, spec.n_actions)) < 0.5,
        "hidden": random.standard_normal((7, 5, HIDDEN)).astype(np.float32),
    }
    teams["action_mask"][..., 1] = True
    together = session.run(None, teams)
    for i in range(7):
        alone = session.run(None, {key: value[i : i + 1] for key, value in teams.items()})
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[i], b[0], atol=1e-6)


def test_the_file_says_where_it_comes_from(tmp_path: Path) -> None:
    path = publish(tmp_path)
    manifest, _ = load_checkpoint(path)
    about = export(path).get_modelmeta().custom_metadata_map
    assert json.loads(about["env_spec"])["name"] == "battle/2s3z"
    assert (about["method"], about["episode"], about["sha256"]) == ("liir", "100", manifest.sha256)
    assert onnx.load(path.with_suffix(".onnx")).ir_version == 8


def test_what_cannot_be_exported_writes_nothing(tmp_path: Path) -> None:
    path, output = publish(tmp_path), tmp_path / "policy.onnx"
    with pytest.raises(ConfigError, match="no is no folder"):
        CliRunner().invoke(app, ["export", str(path), "-o", "no/policy.onnx"], catch_exceptions=False)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CorruptError, match="wanted SHA-256"):
        CliRunner().invoke(app, ["export", str(path), "-o", str(output)], catch_exceptions=False)
    assert not output.exists()
