"""Every method through the real learner and its wire: trained, stopped, resumed, and tested."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path

import pytest

from liir_common import checkpoint
from liir_common.client import TrainingClient
from liir_common.rollout.play import make_player
from liir_common.rpc import codec
from liir_common.types import Exploration, Ticket, Trajectory, policy_shapes
from services.evaluator.evaluator import evaluate
from services.learner.run_directory import RunDirectory
from services.learner.service import serve
from tests.e2e import service
from tests.integration.test_learner import Actor

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
    assert all(states[0][1][name].equal(tensor) for name, tensor in states[1][1].items())
    assert "episodes_per_update: 2" in (tmp_path / "parts" / "config.yaml").read_text()
    record = json.loads((tmp_path / "parts" / "run.json").read_text())
    assert record["parameters"]["theta"] == 28297


class Recorder:
    """A real player that remembers its tickets."""

    def __init__(self) -> None:
        self.player = make_player(service.config().env)
        self.tickets: list[Ticket] = []

    def load(self, weights: dict[str, object]) -> None:
        self.player.load(weights)

    def play(self, ticket: Ticket) -> Trajectory:
        self.tickets.append(ticket)
        return self.player.play(codec.decode_ticket(codec.encode_ticket(ticket)))


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
    half = len(recorder.tickets) // 2
    assert {(t.exploration, t.epsilon) for t in recorder.tickets[:half]} == {(Exploration.GREEDY, 0.0)}
    assert {(t.exploration, t.epsilon) for t in recorder.tickets[half:]} == {(exploration, epsilon)}
    assert policy_shapes(run.spec, 64).keys() == weights.keys()
