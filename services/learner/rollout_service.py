"""The actors' end of the learner: one stream each, tickets out, trajectories in."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import grpc
import structlog

from liir_common import metrics
from liir_common.build import build
from liir_common.config import Config
from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.refused import Refused
from liir_common.types import EnvSpec, Weights
from services.learner.intake import Intake, Opening
from services.learner.trainer import Batches

log = structlog.get_logger()

_MAX_READY = 1024
_MAX_ACTOR_ID = 100
_EXPIRY_CHECK_S = 1.0


@dataclass(eq=False)
class ActorStream:
    """One connected actor."""

    actor_id: str
    outgoing: asyncio.Queue[rollout_pb2.PlayResponse | Exception | None] = field(
        default_factory=asyncio.Queue
    )
    """Messages to send; None ends the stream, an exception ends it with an error."""
    policy_version: int = -1
    """The version sent last."""
    peak_memory: int = 0
    """Bytes, as the actor says."""


class RolloutService(rollout_pb2_grpc.RolloutServiceServicer):
    """Lives on the event loop; only `publish` may be called from elsewhere, through the loop."""

    def __init__(self, config: Config, spec: EnvSpec, first_batch: int, batches: Batches) -> None:
        """Deliver complete batches, from `first_batch` on, to `batches`."""
        self._config = config
        self._spec = spec
        self._intake = Intake(
            config.seed, config.algorithm.behaviour, config.training.batch_episodes, first_batch, batches.put
        )
        self._policies: dict[int, rollout_pb2.PlayResponse] = {}
        self._streams: set[ActorStream] = set()
        self._drain: rollout_pb2.Drain | None = None
        self._empty = asyncio.Event()
        self._empty.set()

    @property
    def actors(self) -> int:
        """Streams open."""
        return len(self._streams)

    @property
    def outstanding(self) -> int:
        """Tickets given out and not yet played."""
        return self._intake.outstanding

    def publish(self, opening: Opening, weights: Weights) -> None:
        """Let the actors play a batch."""
        policy = codec.encode_policy(opening.policy_version, weights)
        self._policies[opening.policy_version] = rollout_pb2.PlayResponse(policy=policy)
        oldest_needed = opening.policy_version - self._config.training.lag
        for version in [v for v in self._policies if v < oldest_needed]:
            del self._policies[version]
        self._intake.open(opening)
        self._assign()

    async def drain(self, reason: str, run_complete: bool, grace_s: float) -> None:
        """Send the actors home and wait until they are gone, or the grace is over."""
        self._drain = rollout_pb2.Drain(reason=reason, run_complete=run_complete)
        for stream in self._streams:
            stream.outgoing.put_nowait(rollout_pb2.PlayResponse(drain=self._drain))
        try:
            await asyncio.wait_for(self._empty.wait(), grace_s)
        except TimeoutError:
            log.warning("actors did not leave in time", actors=self.actors, grace_s=grace_s)

    async def expire_tickets(self) -> None:
        """Give tickets that are too long with one actor to another as well, for ever."""
        timeout = self._config.actors.ticket_timeout_s
        while True:
            await asyncio.sleep(min(_EXPIRY_CHECK_S, timeout))
            metrics.TICKETS.set(self.outstanding)
            metrics.ACTOR_MEMORY.set(sum(stream.peak_memory for stream in self._streams))
            self._reissued(self._intake.expire(time.monotonic() - timeout), "timeout")

    async def Play(
        self, requests: AsyncIterator[rollout_pb2.PlayRequest], context: grpc.aio.ServicerContext
    ) -> AsyncIterator[rollout_pb2.PlayResponse]:
        """Serve one actor until it leaves."""
        stream = await self._greet(requests)
        reader = asyncio.create_task(self._read(requests, stream))
        try:
            while (message := await stream.outgoing.get()) is not None:
                if isinstance(message, Exception):
                    raise message
                yield message
        finally:
            reader.cancel()
            self._leave(stream)

    async def _greet(self, requests: AsyncIterator[rollout_pb2.PlayRequest]) -> ActorStream:
        first = await anext(requests, None)
        if first is None or first.WhichOneof("body") != "hello":
            raise Refused(grpc.StatusCode.INVALID_ARGUMENT, "the first message of a stream must be hello")
        hello = first.hello
        if len(hello.actor_id) > _MAX_ACTOR_ID:
            raise ValueError(
                f"actor_id: wanted at most {_MAX_ACTOR_ID} characters, got {len(hello.actor_id)}"
            )
        wanted = {"environment": self._spec.hash, "build": build()}
        got = {"environment": hello.env_spec_hash, "build": hello.build}
        if wanted != got:
            raise Refused(
                grpc.StatusCode.FAILED_PRECONDITION,
                f"actor {hello.actor_id} would play other episodes: wanted {wanted}, got {got}; "
                "start the actors from the learner's build",
            )
        stream = ActorStream(hello.actor_id)
        self._streams.add(stream)
        self._empty.clear()
        self._intake.join(stream)
        metrics.ACTORS.set(self.actors)
        log.info("actor joined", actor=hello.actor_id, incarnation=hello.incarnation, actors=self.actors)
        if self._drain is not None:
            stream.outgoing.put_nowait(rollout_pb2.PlayResponse(drain=self._drain))
        return stream

    def _leave(self, stream: ActorStream) -> None:
        self._streams.discard(stream)
        if not self._streams:
            self._empty.set()
        metrics.ACTORS.set(self.actors)
        reissued = self._intake.leave(stream)
        log.info("actor left", actor=stream.actor_id, tickets_to_others=reissued, actors=self.actors)
        self._reissued(reissued, "left")

    async def _read(self, requests: AsyncIterator[rollout_pb2.PlayRequest], stream: ActorStream) -> None:
        """Handle what the actor sends until it half-closes; whatever ends this ends the stream."""
        try:
            async for request in requests:
                self._handle(request, stream)
        except (Refused, ValueError) as error:
            stream.outgoing.put_nowait(error)
        finally:
            stream.outgoing.put_nowait(None)

    def _handle(self, request: rollout_pb2.PlayRequest, stream: ActorStream) -> None:
        match request.WhichOneof("body"):
            case "ready":
                tickets = request.ready.tickets
                if not 1 <= tickets <= _MAX_READY:
                    raise ValueError(f"ready: wanted 1..{_MAX_READY} tickets, got {tickets}")
                self._intake.ask(stream, tickets)
                self._assign()
            case "trajectory":
                self._take(request.trajectory, stream)
            case body:
                raise ValueError(f"wanted ready or trajectory, got {body or 'an empty message'}")

    def _take(self, message: rollout_pb2.Trajectory, stream: ActorStream) -> None:
        metrics.RECEIVED_BYTES.inc(message.ByteSize())
        metrics.ACTOR_PLAY_SECONDS.inc(max(0.0, message.stats.play_seconds))
        stream.peak_memory = message.stats.peak_memory_bytes
        metrics.ACTOR_WAIT_SECONDS.inc(max(0.0, message.stats.wait_seconds))
        if not self._intake.accept(stream, codec.decode_trajectory(message, self._spec)):
            metrics.DUPLICATES.inc()
        ack = rollout_pb2.Ack(episode_id=message.episode_id)
        stream.outgoing.put_nowait(rollout_pb2.PlayResponse(ack=ack))
        self._assign()

    def _assign(self) -> None:
        for stream, ticket in self._intake.assign(time.monotonic()):
            assert isinstance(stream, ActorStream)
            if stream.policy_version != ticket.policy_version:
                stream.outgoing.put_nowait(self._policies[ticket.policy_version])
                stream.policy_version = ticket.policy_version
            stream.outgoing.put_nowait(rollout_pb2.PlayResponse(ticket=codec.encode_ticket(ticket)))

    def _reissued(self, tickets: int, reason: str) -> None:
        if tickets:
            metrics.TICKETS_REISSUED.labels(reason).inc(tickets)
            self._assign()
