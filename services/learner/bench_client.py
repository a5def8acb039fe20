"""One stream of `bench_wire`, in a process of its own: answers every ticket with the same episode.

stdin brings the episode, then a byte for each message with tickets that may be answered; once it is closed,
all may. When it got the newest policy it writes into a file that it shares with the others.
"""

from __future__ import annotations

import mmap
import os
import queue
import sys
import time
from collections.abc import Iterable, Iterator

import grpc

from liir_common.build import build
from liir_common.rpc.channel import CHANNEL_OPTIONS
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.requests import Outgoing, gather, put_together
from services.learner.memory import keep_memory


def main(address: str, spec_hash: str, tickets: int, size: int, arrivals_fd: int, index: int) -> None:
    """Hold `tickets` until told to end.

    The episode has `size` bytes; number `index` of the float64 in the file is this client's.
    """
    keep_memory()
    arrivals = memoryview(mmap.mmap(arrivals_fd, 0)).cast("d")
    allowed = sys.stdin.buffer
    trajectory = rollout_pb2.Trajectory.FromString(allowed.read(size))
    outgoing: Outgoing = queue.SimpleQueue()
    hello = rollout_pb2.Hello(actor_id=f"bench-{os.getpid()}", env_spec_hash=spec_hash, build=build())
    outgoing.put(rollout_pb2.PlayRequest(hello=hello, ready=rollout_pb2.Ready(tickets=tickets)))
    with grpc.insecure_channel(address, options=CHANNEL_OPTIONS) as channel:
        for message in rollout_pb2_grpc.RolloutServiceStub(channel).Play(put_together(outgoing)):
            if message.HasField("drain"):
                break
            if message.HasField("policy"):
                arrivals[index] = time.monotonic()
            if message.tickets:
                allowed.read(1)
            for request in gather(_answers(trajectory, message.tickets)):
                outgoing.put(request)
    outgoing.put(None)  # ends the thread in which gRPC reads the queue


def _answers(
    trajectory: rollout_pb2.Trajectory, tickets: Iterable[rollout_pb2.Ticket]
) -> Iterator[rollout_pb2.Trajectory]:
    for ticket in tickets:
        trajectory.episode_id = ticket.episode_id
        trajectory.policy_version = ticket.policy_version
        yield trajectory


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
