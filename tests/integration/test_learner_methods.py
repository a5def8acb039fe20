"""Every method through the real learner and its wire: trained, stopped, resumed, and tested."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path

import numpy as np
import pytest

from liir_common import checkpoint, seeds
from liir_common.battle.engine import EAST, WEST
from liir_common.battle.tables import FIRST_ATTACK
from liir_common.client import TrainingClient
from liir_common.rollout.play import make_player
from liir_common.types import EnvSpec, Exploration, Weights, policy_shapes
from services.evaluator.evaluator import evaluate
from services.learner.run_directory import RunDirectory
from services.learner.service import serve
from tests.e2e import service
from tests.integration.test_learner import Actor, Recorder

STEPS, BATCH = 6, 4
SETTINGS = (
    f"training.batch_episodes={BATCH}",
    "training.checkpoint_interval=4",
    "training.save_interval=2",
    "evaluation.enabled=false",
    "algorithm.replay.episodes=12",
    "algorithm.replay.batch_episodes=8",
    "algorithm.replay.episodes_per_update=2",
    "algorithm.exploration.end=0.5",
)
METHODS = ["liir", "central_v", "iac", "coma", "iql", "vdn", "qmix"]


def learn(path: Path, method: str, until: int) -> RunDirectory:
    """Serve as `liir learner` does, with an actor beside it, until that many learner steps are made."""
    config = service.config(*SETTINGS, f"algorithm={method}", "training.total_env_steps=1000000")
    run = RunDirectory(path, config, make_player(config.env).spec)
    (path / "endpoints.json").unlink(missing_ok=True)
    actor = threading.Thread(target=act, args=(path, until, config.algorithm.behaviour))
    actor.start()
    asyncio.run(serve(config, run, run.spec))
    actor.join(timeout=30)
    assert not actor.is_alive()
    return run


def act(path: Path, until: int, behaviour: Exploration) -> None:
    service.wait_for((path / "endpoints.json").exists, "the learner's start")
    address = service.endpoints(path)["address"]
    with Actor(address) as actor, TrainingClient(address) as training:
        try:
            actor.ask()
            ticket = actor.order()
            while ticket.episode_id < until * BATCH:
                assert ticket.exploration == behaviour
                actor.send(actor.play(ticket))
                actor.ack()
                ticket = actor.order()
        finally:
            training.stop("test")


@pytest.mark.parametrize("method", METHODS)
def test_stopped_and_resumed_is_never_stopped(tmp_path: Path, method: str) -> None:
    whole = learn(tmp_path / "whole", method, STEPS)
    learn(tmp_path / "parts", method, STEPS // 2)
    parts = learn(tmp_path / "parts", method, STEPS)
    digests = [[m.sha256 for m in run.checkpoints.manifests] for run in (whole, parts)]
    assert digests[0] == digests[1]
    assert len(set(digests[0])) == STEPS
    states = [run.load_state() for run in (whole, parts)]
    assert states[0] is not None
    assert states[1] is not None
    assert all(np.array_equal(states[0][1][name], array) for name, array in states[1][1].items())
    assert "episodes_per_update: 2" in (tmp_path / "parts" / "config.yaml").read_text()
    record = json.loads((tmp_path / "parts" / "run.json").read_text())
    assert record["parameters"]["theta"] == 28297


@pytest.mark.parametrize(
    ("method", "exploration", "epsilon"),
    [("coma", Exploration.SOFTMAX_FLOOR, 0.0), ("qmix", Exploration.EPSILON_GREEDY, 0.05)],
)
def test_checkpoints_are_tested_as_their_method_plays(
    tmp_path: Path, method: str, exploration: Exploration, epsilon: float
) -> None:
    run = learn(tmp_path, method, 1)
    manifest = run.checkpoints.find(4)
    tensors = checkpoint.unpack(run.checkpoints.read(manifest), manifest.sha256)
    weights = checkpoint.section(tensors, "policy")
    recorder = Recorder()
    config = service.config(f"algorithm={method}")
    for mode in ("greedy", "sampled"):
        assert evaluate(recorder, weights, config, 4, mode).episodes == config.evaluation.episodes
    chosen = [(ticket.exploration, ticket.epsilon) for ticket, _ in recorder.played]
    half = len(chosen) // 2
    assert set(chosen[:half]) == {(Exploration.GREEDY, 0.0)}
    assert set(chosen[half:]) == {(exploration, epsilon)}
    assert policy_shapes(run.spec, 64).keys() == weights.keys()


def shooting(spec: EnvSpec, otherwise: int) -> Weights:
    """A policy that shoots at what is in range, and else walks in one direction."""
    weights = {name: np.zeros(shape, np.float32) for name, shape in policy_shapes(spec, 64).items()}
    weights["fc2.bias"][FIRST_ATTACK:] = 6.0
    weights["fc2.bias"][otherwise] = 3.0
    return weights


@pytest.mark.parametrize(("mode", "otherwise"), [("greedy", EAST), ("sampled", WEST)])
def test_an_evaluation_says_what_was_played(mode: str, otherwise: int) -> None:
    """Both policies win some of their battles and lose others."""
    recorder, config = Recorder(), service.config("evaluation.episodes=50")
    stats = evaluate(recorder, shooting(recorder.spec, otherwise), config, 4, mode)
    played = [trajectory for _, trajectory in recorder.played]
    assert stats.episodes == len(played) == 50
    assert stats.wins == [trajectory.info["won"] for trajectory in played].count(1.0)
    assert 0 < stats.wins < 50
    assert stats.return_mean == pytest.approx(sum(float(t.reward.sum()) for t in played) / 50)
    assert stats.length_mean == sum(t.length for t in played) / 50
    for key, mean in stats.info_means.items():
        assert mean == pytest.approx(sum(t.info[key] for t in played) / 50)
    assert stats.info_means.keys() == set(recorder.spec.info_keys)


def test_no_two_test_episodes_of_any_run_have_the_same_seed() -> None:
    recorder = Recorder()
    for seed in (7, 8):
        config = service.config(f"seed={seed}", "evaluation.episodes=20")
        for episode in (100, 200):
            evaluate(recorder, shooting(recorder.spec, EAST), config, episode, "greedy")
    tested = {ticket.seed for ticket, _ in recorder.played}
    assert len(tested) == len(recorder.played) == 2 * 2 * 20
    assert tested.isdisjoint(seeds.episode_seed(7, seeds.TRAINING, episode) for episode in range(1000))
