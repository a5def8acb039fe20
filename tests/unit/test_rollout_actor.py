"""What an actor makes of refusals, from a server that only refuses."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from concurrent import futures
from itertools import repeat

import grpc
import pytest
import structlog

from liir_common.config import Config
from liir_common.errors import RefusedError
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from services.actor.rollout_actor import RolloutActor


class Refusing(rollout_pb2_grpc.RolloutServiceServicer):
    """Each stream ends as the next letter says: r refused, a refused after an ack, u unavailable,
    w unavailable after a policy, c complete.
    """

    def __init__(self, ends: str) -> None:
        self.ends = iter(ends)

    def Play(
        self, requests: Iterator[rollout_pb2.PlayRequest], context: grpc.ServicerContext
    ) -> Iterator[rollout_pb2.PlayResponse]:
        end = next(self.ends)
        if end == "a":
            yield rollout_pb2.PlayResponse(acks=[rollout_pb2.Ack(episode_id=1)])
        if end == "w":
            yield rollout_pb2.PlayResponse(policy=rollout_pb2.Policy())
        if end in "uw":
            context.abort(grpc.StatusCode.UNAVAILABLE, "ends")
        if end != "c":
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, "reward: wanted finite")
        yield rollout_pb2.PlayResponse(drain=rollout_pb2.Drain(run_complete=True))


def play(ends: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Let an actor play until it ends; returns the letters that are left."""
    monkeypatch.setattr("services.actor.rollout_actor.channel.backoffs", lambda: repeat(0.0))
    server, learner = grpc.server(futures.ThreadPoolExecutor(2)), Refusing(ends)
    rollout_pb2_grpc.add_RolloutServiceServicer_to_server(learner, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        RolloutActor("a", 1, f"127.0.0.1:{port}", Config().tree(), {}).run()
    finally:
        server.stop(0).wait()
    return "".join(learner.ends)


def test_a_stop_iteration_of_a_game_is_an_error_and_drops_no_tickets(monkeypatch: pytest.MonkeyPatch) -> None:
    actor = RolloutActor("a", 1, "127.0.0.1:1", Config().tree(), {})
    monkeypatch.setattr(actor, "_play", lambda ticket: next(iter(())))
    message = rollout_pb2.PlayResponse(tickets=[rollout_pb2.Ticket(exploration=1)])
    with pytest.raises(RuntimeError, match="StopIteration"):
        actor._answer([message], queue.SimpleQueue())


def test_a_refusal_is_an_accident_and_three_in_a_row_are_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    assert play("rrc", monkeypatch) == ""
    assert play("rrarc", monkeypatch) == "", "an ack begins the count anew"
    with pytest.raises(RefusedError, match="INVALID_ARGUMENT: reward: wanted finite"):
        play("rrrc", monkeypatch)


def test_what_was_waited_for_when_the_learner_went_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.actor.rollout_actor.codec.decode_policy", lambda *_: {})
    monkeypatch.setattr("liir_common.rollout.fused.FusedPlayer.load", lambda *_: None)
    monkeypatch.setattr("services.actor.rollout_actor.logs.configure", lambda _: None)
    with structlog.testing.capture_logs() as lines:
        assert play("uwc", monkeypatch) == ""
    away = [line for line in lines if line["event"] == "the learner is away"]
    assert [line["phase"] for line in away] == ["connecting", "waiting for tickets"]
    assert [line["unacknowledged"] for line in away] == [0, 0]
