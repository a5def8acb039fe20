"""The actors' end of the learner: one stream each, tickets out, trajectories in."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator

import grpc
import structlog

from liir_common import metrics
from liir_common.build import build
from liir_common.config import Config
from liir_common.errors import ConfigError
from liir_common.rpc import codec
from liir_common.rpc.channel import MAX_MESSAGE_BYTES
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.refused import Refused
from liir_common.rpc.requests import TOGETHER_BYTES
from liir_common.types import EnvSpec, Weights
from services.learner.intake import Intake, Opening
from services.learner.trainer import Batches

log = structlog.get_logger()

_MAX_READY = 1024
_MAX_ACTOR_ID = 100
_EXPIRY_CHECK_S = 1.0


class ActorStream:
    """One connected actor, and what is to be sent to it: what waits goes together, in few messages."""

    def __init__(self, actor_id: str) -> None:
        self.actor_id = actor_id
        self.policy_version = -1
        """The version sent last."""
        self.peak_memory = 0
        """Bytes, as the actor says."""
        self.heard = time.monotonic()
        """When the actor sent something last."""
        self.error: Exception | None = None
        """What the stream ends with, unless in peace."""
        self._waiting: deque[rollout_pb2.PlayResponse] = deque()
        self._woken = asyncio.Event()
        self._ended = False

    def policy(self, policy: rollout_pb2.Policy) -> None:
        """Send a policy, in front of the tickets that name it."""
        message = self._last()
        if message.HasField("policy") or message.tickets:
            message = self._new()
        message.policy.CopyFrom(policy)
        self.policy_version = policy.version

    def ticket(self, ticket: rollout_pb2.Ticket) -> None:
        """Send a ticket."""
        self._last().tickets.append(ticket)

    def ack(self, episode_id: int) -> None:
        """Confirm a trajectory."""
        self._last().acks.add(episode_id=episode_id)

    def drain(self, drain: rollout_pb2.Drain) -> None:
        """Send the actor home."""
        self._last().drain.CopyFrom(drain)

    def end(self, error: Exception | None = None) -> None:
        """Close the stream once all is sent, with an error if one is given."""
        self._ended, self.error = True, self.error or error
        self._woken.set()

    async def responses(self) -> AsyncIterator[rollout_pb2.PlayResponse]:
        """All that is to be sent, until `end`.

        Raises:
            Exception: the error that the stream ends with.
        """
        while True:
            while self._waiting:
                yield self._waiting.popleft()
            if self._ended:
                break
            self._woken.clear()
            await self._woken.wait()
        if self.error:
            raise self.error

    def _last(self) -> rollout_pb2.PlayResponse:
        return self._waiting[-1] if self._waiting else self._new()

    def _new(self) -> rollout_pb2.PlayResponse:
        self._waiting.append(rollout_pb2.PlayResponse())
        self._woken.set()
        return self._waiting[-1]


class RolloutService(rollout_pb2_grpc.RolloutServiceServicer):
    """Lives on the event loop; only `publish` may be called from elsewhere, through the loop."""

    def __init__(self, config: Config, spec: EnvSpec, first_batch: int, batches: Batches) -> None:
        """Deliver complete batches, from `first_batch` on, to `batches`.

        Raises:
            ConfigError: an episode could be larger than a message may be.
        """
        _check_size(spec)
        self._config = config
        self._spec = spec
        self._intake = Intake(
            config.seed, config.algorithm.behaviour, config.training.batch_episodes, first_batch, batches.put
        )
        self._policies: dict[int, rollout_pb2.Policy] = {}
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
        self._policies[opening.policy_version] = codec.encode_policy(opening.policy_version, weights)
        oldest_needed = opening.policy_version - self._config.training.lag
        for version in [v for v in self._policies if v < oldest_needed]:
            del self._policies[version]
        self._intake.open(opening)
        self._assign()

    async def drain(self, reason: str, run_complete: bool, grace_s: float) -> None:
        """Send the actors home and wait until they are gone, or the grace is over."""
        self._drain = rollout_pb2.Drain(reason=reason, run_complete=run_complete)
        for stream in self._streams:
            stream.drain(self._drain)
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
        first = await anext(requests, None)
        if first is None or not first.HasField("hello"):
            raise Refused(grpc.StatusCode.INVALID_ARGUMENT, "the first message of a stream must be hello")
        stream = self._greet(first.hello)
        reader = asyncio.create_task(self._read(first, requests, stream))
        try:
            async for response in stream.responses():
                yield response
        finally:
            reader.cancel()
            self._leave(stream)

    def _greet(self, hello: rollout_pb2.Hello) -> ActorStream:
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
        if self._drain is not None and not self._drain.run_complete:
            # Not let in and sent home again, round and round: a refusal makes it wait longer each time.
            raise Refused(grpc.StatusCode.UNAVAILABLE, f"{self._drain.reason}; come back when it is resumed")
        stream = ActorStream(hello.actor_id)
        self._streams.add(stream)
        self._empty.clear()
        self._intake.join(stream)
        metrics.ACTORS.set(self.actors)
        log.info("actor joined", actor=hello.actor_id, incarnation=hello.incarnation, actors=self.actors)
        if self._drain is not None:
            stream.drain(self._drain)
        return stream

    def _leave(self, stream: ActorStream) -> None:
        self._streams.discard(stream)
        if not self._streams:
            self._empty.set()
        metrics.ACTORS.set(self.actors)
        held, reissued = self._intake.held(stream), self._intake.leave(stream)
        # To gRPC here, an actor that goes and one that is lost are the same: the end of what it sends.
        reason = str(stream.error) if stream.error else "sent home" if self._drain else "gone or lost"
        log.info(
            "actor left",
            actor=stream.actor_id,
            reason=reason,
            phase="playing" if held else "waiting for tickets",
            tickets_held=held,
            silent_s=round(time.monotonic() - stream.heard, 1),
            tickets_to_others=reissued,
            actors=self.actors,
        )
        self._reissued(reissued, "left")

    async def _read(
        self,
        first: rollout_pb2.PlayRequest,
        requests: AsyncIterator[rollout_pb2.PlayRequest],
        stream: ActorStream,
    ) -> None:
        """Handle what the actor sends until it half-closes; whatever ends this ends the stream."""
        try:
            self._handle(first, stream)
            async for request in requests:
                if request.HasField("hello"):
                    raise ValueError("hello: wanted in the first message alone, got another")
                self._handle(request, stream)
        except Exception as error:
            stream.end(error)
        finally:
            stream.end()

    def _handle(self, request: rollout_pb2.PlayRequest, stream: ActorStream) -> None:
        stream.heard = time.monotonic()
        if request.HasField("ready"):
            tickets = request.ready.tickets
            if not 1 <= tickets <= _MAX_READY:
                raise ValueError(f"ready: wanted 1..{_MAX_READY} tickets, got {tickets}")
            self._intake.ask(stream, tickets)
        for trajectory in request.trajectories:
            self._take(trajectory, stream)
        self._assign()

    def _take(self, message: rollout_pb2.Trajectory, stream: ActorStream) -> None:
        metrics.ACTOR_PLAY_SECONDS.inc(max(0.0, message.stats.play_seconds))
        stream.peak_memory = message.stats.peak_memory_bytes
        metrics.ACTOR_WAIT_SECONDS.inc(max(0.0, message.stats.wait_seconds))
        trajectory = codec.decode_trajectory(message, self._spec)
        metrics.RECEIVED_BYTES.inc(trajectory.nbytes)
        if not self._intake.accept(stream, trajectory):
            metrics.DUPLICATES.inc()
        stream.ack(message.episode_id)

    def _assign(self) -> None:
        if self._drain is not None:
            return
        for stream, ticket in self._intake.assign(time.monotonic()):
            assert isinstance(stream, ActorStream)
            if stream.policy_version != ticket.policy_version:
                stream.policy(self._policies[ticket.policy_version])
            stream.ticket(codec.encode_ticket(ticket))

    def _reissued(self, tickets: int, reason: str) -> None:
        if tickets:
            metrics.TICKETS_REISSUED.labels(reason).inc(tickets)
            self._assign()


def _check_size(spec: EnvSpec) -> None:
    largest, most = codec.largest_episode(spec), MAX_MESSAGE_BYTES - TOGETHER_BYTES
    if largest > most:
        raise ConfigError(
            f"{spec.name}: wanted episodes of at most {most / 2**20:.0f} MiB, one of {spec.episode_limit} "
            f"steps would have {largest / 2**20:.0f}; lower its limit of steps, or what it observes"
        )
