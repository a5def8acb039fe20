"""One actor: asks for tickets, plays them, hands in the trajectories."""

from __future__ import annotations

import queue
import resource
import sys
import time
from collections.abc import Iterable, Mapping

import grpc
import ray
import structlog

from liir_common import logs, types
from liir_common.build import build
from liir_common.config import Config, from_tree
from liir_common.errors import RefusedError
from liir_common.rollout.play import make_player
from liir_common.rollout.player import Player
from liir_common.rpc import carry, channel, codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.requests import Outgoing, gather, put_together
from liir_common.rpc.tokens import Role

log = structlog.get_logger()

_MOST_REFUSALS = 3
"""Of what was sent, with nothing taken in between: a damaged message is an accident, three are a fault."""


class RolloutActor:
    """Plays for a learner until the run is complete; made a Ray actor by the driver."""

    def __init__(
        self,
        name: str,
        incarnation: int,
        address: str,
        config_tree: dict[str, object],
        files: Mapping[str, bytes],
    ) -> None:
        """Get ready to play; nothing is asked for yet.

        `files` are those of `security` if the driver sends them; if not, this node's own are used.
        """
        logs.configure(name)
        self._hello = (name, incarnation)
        self._address = address
        config: Config = from_tree(config_tree)
        self._security = carry.unpack(files) if files else config.security
        self._compress = config.actors.compress
        self._player: Player = make_player(config.env, config.algorithm.policy_hidden)
        self._shapes = types.policy_shapes(self._player.spec, config.algorithm.policy_hidden)
        self._version = -1
        """Of the policy that this stream brought last."""
        self._refusals = 0
        self._phase = ""
        """What this actor waits for from the learner."""
        self._unacknowledged = 0
        """Trajectories handed in over this stream."""
        self._idle_since = 0.0

    def ready(self) -> str:
        """Ray's id of the node that the actor is on, once it is there."""
        return str(ray.get_runtime_context().get_node_id())

    def run(self) -> None:
        """Play until the learner says that the run is complete.

        Raises:
            ConfigError: a file of `security` cannot be used.
            RefusedError: the learner will not have this actor.
        """
        waits = channel.backoffs()
        with channel.open_channel(self._address, self._security, Role.ACTOR) as connection:
            learner = rollout_pb2_grpc.RolloutServiceStub(connection)
            while True:
                try:
                    if self._serve(learner):
                        return
                    waits = channel.backoffs()
                except grpc.RpcError as error:
                    self._judge(error)
                # Nothing to keep: whoever gets the tickets next plays the same episodes.
                time.sleep(next(waits))

    def _judge(self, error: grpc.RpcError) -> None:
        """Return if another stream may do better.

        Raises:
            RefusedError: it will not.
        """
        refused = error.code() == grpc.StatusCode.INVALID_ARGUMENT
        self._refusals += refused
        if error.code() not in channel.AWAY and not (refused and self._refusals < _MOST_REFUSALS):
            raise RefusedError(f"{error.code().name}: {error.details()}") from None
        if refused:
            log.error("the learner refused what this actor sent", reason=error.details())
        else:
            log.warning(
                "the learner is away",
                address=self._address,
                phase=self._phase,
                unacknowledged=self._unacknowledged,
                reason=error.details(),
            )

    def _serve(self, learner: rollout_pb2_grpc.RolloutServiceStub) -> bool:
        """Play over one stream until it ends; true if the run is complete."""
        outgoing: Outgoing = queue.SimpleQueue()
        name, incarnation = self._hello
        hello = rollout_pb2.Hello(
            actor_id=name, incarnation=incarnation, env_spec_hash=self._player.spec.hash, build=build()
        )
        ready = rollout_pb2.Ready(tickets=self._player.tickets_held)
        outgoing.put(rollout_pb2.PlayRequest(hello=hello, ready=ready))
        try:
            return self._answer(learner.Play(put_together(outgoing), wait_for_ready=True), outgoing)
        finally:
            outgoing.put(None)  # ends our side, and the thread in which gRPC reads the queue

    def _answer(self, messages: Iterable[rollout_pb2.PlayResponse], outgoing: Outgoing) -> bool:
        self._version = -1
        self._phase, self._unacknowledged = "connecting", 0
        self._idle_since = time.perf_counter()
        for message in messages:
            self._phase = "waiting for tickets"  # whenever it notices that the stream broke
            if message.acks:
                self._refusals = 0
                self._unacknowledged -= len(message.acks)
            if message.HasField("policy"):
                self._player.load(codec.decode_policy(message.policy, self._shapes))
                self._version = message.policy.version
            # Not `map`, which takes a StopIteration of a game for its own end and drops the tickets left.
            for request in gather(self._play(codec.decode_ticket(ticket)) for ticket in message.tickets):
                outgoing.put(request)
                self._unacknowledged += len(request.trajectories)
            if message.HasField("drain"):
                log.info("drained", reason=message.drain.reason)
                return bool(message.drain.run_complete)
        return False

    def _play(self, ticket: types.Ticket) -> rollout_pb2.Trajectory:
        if ticket.policy_version != self._version:
            raise RuntimeError(f"got a ticket for policy {ticket.policy_version}, have {self._version}")
        begin = time.perf_counter()
        trajectory = self._player.play(ticket)
        end = time.perf_counter()
        stats = rollout_pb2.ActorStats(
            play_seconds=end - begin,
            wait_seconds=begin - self._idle_since,
            peak_memory_bytes=_peak_memory(),
        )
        self._idle_since = end
        return codec.encode_trajectory(trajectory, stats, self._compress)


def _peak_memory() -> int:
    """Most memory that this process has had resident, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
