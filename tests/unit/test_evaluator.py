"""What an evaluator makes of calls that fail, from a learner that has nothing to test."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent import futures
from itertools import repeat
from typing import Any
from unittest.mock import Mock

import grpc
import pytest
import structlog

from liir_common.build import build
from liir_common.config import Config, load
from liir_common.errors import RefusedError
from liir_common.rollout.play import make_player
from liir_common.rpc.gen.liir.v1 import (
    checkpoint_pb2,
    checkpoint_pb2_grpc,
    training_pb2,
    training_pb2_grpc,
)
from services.evaluator.evaluator import Evaluator

PLAYER = make_player(Config().env)
NO_TESTS = load(settings=["evaluation.enabled=false"])


class Failing(checkpoint_pb2_grpc.CheckpointServiceServicer, training_pb2_grpc.TrainingServiceServicer):
    """Each call of one method fails with the next code, until there are no more."""

    def __init__(self, method: str, codes: tuple[grpc.StatusCode, ...]) -> None:
        self.method, self.codes = method, list(codes)
        self.checkpoints: tuple[int, ...] = ()
        self.config = self.resumed_with = Config()

    def _answer(self, method: str, context: grpc.ServicerContext) -> None:
        if method == self.method and self.codes:
            self.config = self.resumed_with
            context.abort(self.codes.pop(0), "as the test wants it")

    def GetRun(self, request: Any, context: grpc.ServicerContext) -> training_pb2.GetRunResponse:
        self._answer("GetRun", context)
        return training_pb2.GetRunResponse(
            env_spec_hash=PLAYER.spec.hash, build=build(), config_json=json.dumps(self.config.shared_tree())
        )

    def ListEvaluations(
        self, request: Any, context: grpc.ServicerContext
    ) -> checkpoint_pb2.ListEvaluationsResponse:
        self._answer("ListEvaluations", context)
        return checkpoint_pb2.ListEvaluationsResponse()

    def WatchCheckpoints(self, request: Any, context: grpc.ServicerContext) -> Iterator[Any]:
        self._answer("WatchCheckpoints", context)
        for episode in self.checkpoints:
            yield checkpoint_pb2.WatchCheckpointsResponse(
                checkpoint=checkpoint_pb2.Checkpoint(episode=episode)
            )

    def ReportEvaluation(
        self, request: Any, context: grpc.ServicerContext
    ) -> checkpoint_pb2.ReportEvaluationResponse:
        self._answer("ReportEvaluation", context)
        return checkpoint_pb2.ReportEvaluationResponse()


def evaluate(
    method: str,
    *codes: grpc.StatusCode,
    checkpoints: tuple[int, ...] = (),
    config: Config | None = None,
    resumed_with: Config | None = None,
) -> int:
    """Let an evaluator work until it ends; returns how many of the codes are left.

    The learner has `config`, and from its first failure on `resumed_with`.
    """
    server, learner = grpc.server(futures.ThreadPoolExecutor(2)), Failing(method, codes)
    learner.checkpoints = checkpoints
    learner.config = config or Config()
    learner.resumed_with = resumed_with or learner.config
    checkpoint_pb2_grpc.add_CheckpointServiceServicer_to_server(learner, server)
    training_pb2_grpc.add_TrainingServiceServicer_to_server(learner, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        Evaluator(f"127.0.0.1:{port}", learner.config, PLAYER).run()
    finally:
        server.stop(0).wait()
    return len(learner.codes)


@pytest.mark.parametrize("method", ["GetRun", "ListEvaluations", "WatchCheckpoints"])
def test_a_learner_that_is_away_is_waited_for(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """CANCELLED is what a call comes to that a learner did not get to within half a minute."""
    monkeypatch.setattr("services.evaluator.evaluator.backoffs", lambda: repeat(0.0))
    codes = (grpc.StatusCode.CANCELLED, grpc.StatusCode.DEADLINE_EXCEEDED, grpc.StatusCode.CANCELLED)
    assert evaluate(method, *codes) == 0


@pytest.mark.parametrize(
    ("method", "phase"),
    [
        ("GetRun", "connecting"),
        ("ListEvaluations", "asking what is tested"),
        ("WatchCheckpoints", "waiting for checkpoints"),
        ("ReportEvaluation", "reporting checkpoint 100"),
    ],
)
def test_what_was_being_done_when_the_learner_went_is_logged(
    method: str, phase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.evaluator.evaluator.backoffs", lambda: repeat(0.0))
    monkeypatch.setattr(
        Evaluator, "_test", lambda _, client, frozen: checkpoint_pb2.Evaluation(episode=frozen.episode)
    )
    with structlog.testing.capture_logs() as lines:
        assert evaluate(method, grpc.StatusCode.CANCELLED, checkpoints=(100,)) == 0
    assert [line["phase"] for line in lines if line["event"] == "the learner is away"] == [phase]


def test_a_refusal_is_final() -> None:
    with pytest.raises(RefusedError, match="PERMISSION_DENIED"):
        evaluate("GetRun", grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.CANCELLED)


def test_of_a_run_that_wants_no_tests_nothing_is_fetched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Evaluator, "_test", Mock(side_effect=AssertionError))
    evaluate("", checkpoints=(100,), config=NO_TESTS)
    with pytest.raises(AssertionError):
        evaluate("", checkpoints=(100,))


@pytest.mark.parametrize("tests", [("evaluation.enabled=true", "evaluation.episodes=7"), None])
def test_how_a_resumed_learner_wants_its_tests_counts(
    tests: tuple[str, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.evaluator.evaluator.backoffs", lambda: repeat(0.0))
    before, after = (NO_TESTS, load(settings=tests)) if tests else (Config(), NO_TESTS)
    tested = []

    def test(evaluator: Evaluator, client: object, frozen: checkpoint_pb2.Checkpoint) -> Any:
        tested.append(evaluator._config.evaluation.episodes)
        return checkpoint_pb2.Evaluation(episode=frozen.episode)

    monkeypatch.setattr(Evaluator, "_test", test)
    code = grpc.StatusCode.CANCELLED
    assert evaluate("WatchCheckpoints", code, checkpoints=(100,), config=before, resumed_with=after) == 0
    assert tested == ([7] if tests else [])
