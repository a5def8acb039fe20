"""What the learner keeps for its actors."""

from __future__ import annotations

import math
import queue
from collections.abc import MutableMapping
from typing import Any

import numpy as np
import pytest
import structlog

from liir_common import config
from liir_common.build import build
from liir_common.rpc.gen.liir.v1 import rollout_pb2
from services.learner.intake import Opening
from services.learner.rollout_service import ActorStream, RolloutService
from tests.samples import SPEC


@pytest.mark.parametrize("lag", [0, 1])
def test_policies_that_no_open_batch_is_played_by_are_forgotten(lag: int) -> None:
    """All others, lag + 1 at most, stay: an actor that comes late may get a ticket of any open batch."""
    service = RolloutService(config.load(None, [f"training.lag={lag}"]), SPEC, 0, queue.SimpleQueue())
    for batch in range(5):
        version = max(0, batch - lag)
        service.publish(Opening(batch, version, 0.0), {"fc1.bias": np.zeros(2, np.float32)})
        assert sorted(service._policies) == list(range(max(0, version - lag), version + 1))


def greeted(service: RolloutService) -> ActorStream:
    """The stream of an actor that has come."""
    return service._greet(rollout_pb2.Hello(actor_id="a", env_spec_hash=SPEC.hash, build=build()))


def left(service: RolloutService, stream: ActorStream) -> MutableMapping[str, Any]:
    """What the log says of an actor that leaves."""
    with structlog.testing.capture_logs() as lines:
        service._leave(stream)
    (line,) = lines
    return line


@pytest.mark.parametrize(
    ("error", "drain", "reason"),
    [
        (None, None, "gone or lost"),
        (None, rollout_pb2.Drain(), "sent home"),
        (ValueError("obs: damaged"), rollout_pb2.Drain(), "obs: damaged"),
    ],
)
def test_the_log_says_what_is_known_of_an_actor_that_left(
    error: Exception | None, drain: rollout_pb2.Drain | None, reason: str
) -> None:
    service = RolloutService(config.load(), SPEC, 0, queue.SimpleQueue())
    service.publish(Opening(0, 0, 0.0), {"fc1.bias": np.zeros(2, np.float32)})
    stream = greeted(service)
    service._handle(rollout_pb2.PlayRequest(ready=rollout_pb2.Ready(tickets=3)), stream)
    stream.heard -= 12
    stream.end(error)
    service._drain = drain
    line = left(service, stream)
    wanted = {"actor": "a", "reason": reason, "tickets_to_others": 3, "actors": 0}
    assert line.items() >= wanted.items()
    assert 12 <= line["silent_s"] < 24


def test_the_log_says_whether_an_actor_that_left_was_playing() -> None:
    """A ticket that it is late with counts as well, though another has it already."""
    service = RolloutService(config.load(), SPEC, 0, queue.SimpleQueue())
    stream = greeted(service)
    assert left(service, stream).items() >= {"phase": "waiting for tickets", "tickets_held": 0}.items()
    service.publish(Opening(0, 0, 0.0), {"fc1.bias": np.zeros(2, np.float32)})
    stream = greeted(service)
    service._handle(rollout_pb2.PlayRequest(ready=rollout_pb2.Ready(tickets=3)), stream)
    assert service._intake.expire(math.inf) == 3
    wanted = {"phase": "playing", "tickets_held": 3, "tickets_to_others": 0}
    assert left(service, stream).items() >= wanted.items()
