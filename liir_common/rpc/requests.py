"""An actor's side of its stream to the learner."""

from __future__ import annotations

import queue
from collections.abc import Iterable, Iterator

from liir_common.rpc.gen.liir.v1 import rollout_pb2

Outgoing = queue.SimpleQueue[rollout_pb2.PlayRequest | None]
"""What an actor has to say; None ends its side of the stream."""

TOGETHER_BYTES = 1 << 20
"""A message that is larger than this already takes no more with it."""


def gather(trajectories: Iterable[rollout_pb2.Trajectory]) -> Iterator[rollout_pb2.PlayRequest]:
    """What is played without waiting in between, in few messages."""
    request = rollout_pb2.PlayRequest()
    for trajectory in trajectories:
        request.trajectories.append(trajectory)
        if request.ByteSize() >= TOGETHER_BYTES:
            yield request
            request = rollout_pb2.PlayRequest()
    if request.trajectories:
        yield request


def put_together(outgoing: Outgoing) -> Iterator[rollout_pb2.PlayRequest]:
    """The messages of `outgoing`, those that wait together in one."""
    while (request := outgoing.get()) is not None:
        while not outgoing.empty() and request.ByteSize() < TOGETHER_BYTES:
            more = outgoing.get()
            if more is None:
                yield request
                return
            request.MergeFrom(more)
        yield request
