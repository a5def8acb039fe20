"""The learner's end of the actors' streams: what an episode costs its process, when a policy is with all."""

from __future__ import annotations

import asyncio
import mmap
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass
from statistics import median
from typing import Any

from liir_common import config
from liir_common.rollout.play import env_spec, make_player
from liir_common.rollout.policy import random_weights
from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.server import Server
from liir_common.types import Exploration, Ticket, Trajectory, Weights
from services.learner import bench_client
from services.learner.bench import synthetic_batch
from services.learner.compute import Compute
from services.learner.intake import Opening
from services.learner.memory import keep_memory
from services.learner.rollout_service import RolloutService

_AHEAD = 8
"""Batches open at a time, so that no stream ever waits for the learner step that is left out."""
_POLL_S = 0.005


@dataclass
class _Intake:
    """A learner that neither learns nor plays: batches are opened and come back."""

    service: RolloutService
    delivered: queue.SimpleQueue[list[Trajectory] | None]
    weights: Weights
    clients: Sequence[subprocess.Popen[bytes]]
    arrivals: Sequence[float]
    """Per stream, when it got the newest policy, on the monotonic clock of all processes"""
    episode_bytes: int
    """Of the episode that answers every ticket"""
    opened: int = 0

    def open(self, policy_version: int = 0) -> None:
        """Let the streams answer one more batch."""
        self.service.publish(Opening(self.opened, policy_version, 0.1), self.weights)
        self.opened += 1

    async def next_batch(self) -> None:
        """Wait until the oldest open batch has come in."""
        await asyncio.to_thread(self.delivered.get)

    async def policy_arrived(self, begin: float) -> None:
        """Wait until every stream has got a policy since `begin`."""
        while min(self.arrivals) < begin:
            _check(self.clients)
            await asyncio.sleep(_POLL_S)

    def allow(self) -> None:
        """Let every client answer the tickets that it was sent in one message."""
        _write(self.clients, b".")

    def allow_all(self) -> None:
        """Let them answer whatever they are sent from now on."""
        for client in self.clients:
            assert client.stdin is not None
            client.stdin.close()


@asynccontextmanager
async def _intake(settings: config.Config, streams: int, tickets: int) -> AsyncIterator[_Intake]:
    """Clients are processes of their own, each with one stream that holds `tickets`, and answer a ticket with
    the same real episode once they are allowed to."""
    spec = env_spec(settings.env)
    delivered: queue.SimpleQueue[list[Trajectory] | None] = queue.SimpleQueue()
    service = RolloutService(settings, spec, 0, delivered)
    server = Server("127.0.0.1", 0, settings.security)
    rollout_pb2_grpc.add_RolloutServiceServicer_to_server(service, server.grpc)
    await server.start()
    # Played here: every client would load the compiled code, or compile it.
    episode = _episode(settings).SerializeToString()
    try:
        # The clients end first, who else would speak of a server that has gone.
        with ExitStack() as stack:
            file = stack.enter_context(tempfile.TemporaryFile())
            file.truncate(8 * streams)
            clients = []
            for index in range(streams):
                arguments = [
                    f"127.0.0.1:{server.port}",
                    spec.hash,
                    tickets,
                    len(episode),
                    file.fileno(),
                    index,
                ]
                client = stack.enter_context(_client(arguments, file.fileno()))
                stack.callback(client.terminate)
                clients.append(client)
            # In a thread, as they read it once they have started: gRPC cancels calls that wait half a minute
            # for a loop that stands still.
            await asyncio.to_thread(_write, clients, episode)
            while service.actors < streams:
                _check(clients)
                await asyncio.sleep(0.1)
            weights = random_weights(spec, settings.algorithm.policy_hidden, seed=0)
            arrivals = memoryview(mmap.mmap(file.fileno(), 0)).cast("d")
            yield _Intake(service, delivered, weights, clients, arrivals, len(episode))
            await service.drain("measured", run_complete=True, grace_s=5.0)
    finally:
        await server.stop(0)


def _client(arguments: Sequence[object], arrivals_fd: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", bench_client.__name__, *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0, pass_fds=[arrivals_fd])


def _check(clients: Sequence[subprocess.Popen[bytes]]) -> None:
    """See that all live.

    Raises:
        RuntimeError: one does not.
    """
    if any(client.poll() is not None for client in clients):
        raise RuntimeError("a client died; its error is above")


def _write(clients: Sequence[subprocess.Popen[bytes]], data: bytes) -> None:
    for client in clients:
        assert client.stdin is not None
        client.stdin.write(data)


def bench_wire(map_name: str, streams: int = 4, batches: int = 40, repeats: int = 5) -> dict[str, Any]:
    """Medians over `repeats` of the rate and of this process's CPU time per episode, as fast as they come."""
    settings = config.load(None, [f"env.map={map_name}", "training.lag=1"])
    per_repeat = batches * settings.training.batch_episodes
    keep_memory()

    async def measure() -> tuple[list[float], list[float], int]:
        rates, costs = [], []
        async with _intake(settings, streams, _tickets(settings)) as intake:
            intake.allow_all()
            for _ in range(_AHEAD):
                intake.open()
            for repeat in range(repeats + 1):
                begin, cpu = time.perf_counter(), time.process_time()
                for _ in range(batches):
                    await intake.next_batch()
                    intake.open()
                if repeat:  # the first is the warm-up
                    rates.append(per_repeat / (time.perf_counter() - begin))
                    costs.append((time.process_time() - cpu) / per_repeat)
            return rates, costs, intake.episode_bytes

    rates, costs, size = asyncio.run(measure())
    return {
        "map": map_name,
        "streams": streams,
        "bytes_per_episode": size,
        "episodes_per_s": median(rates),
        "megabytes_per_s": median(rates) * size / 1e6,
        "learner_cpu_us_per_episode": 1e6 * median(costs),
        "episodes": per_repeat,
        "repeats": repeats,
    }


def bench_policy(map_name: str, streams: int = 32, repeats: int = 100) -> dict[str, Any]:
    """Median time from publishing a policy until the last of `streams` actors has it: all wait for it, and
    answer when all have it, or each answers at once, which takes cores from those that still wait."""
    settings = config.load(None, [f"env.map={map_name}", f"training.batch_episodes={streams}"])

    async def latencies(intake: _Intake, together: bool) -> list[float]:
        if not together:
            intake.allow_all()
        found = []
        for _ in range(repeats + 1):
            begin = time.monotonic()
            intake.open(intake.opened)
            if together:
                await intake.policy_arrived(begin)
                intake.allow()
            await intake.next_batch()
            assert min(intake.arrivals) >= begin  # a ticket for each
            found.append(max(intake.arrivals) - begin)
        return found[1:]  # the first is the warm-up

    async def measure() -> tuple[list[float], list[float], int]:
        async with _intake(settings, streams, tickets=1) as intake:
            size = codec.encode_policy(0, intake.weights).ByteSize()
            return await latencies(intake, together=True), await latencies(intake, together=False), size

    waiting, answering, size = asyncio.run(measure())
    return {
        "map": map_name,
        "streams": streams,
        "bytes_per_policy": size,
        "policy_ms": 1e3 * median(waiting),
        "slowest_ms": 1e3 * max(waiting),
        "answering_policy_ms": 1e3 * median(answering),
        "answering_slowest_ms": 1e3 * max(answering),
        "repeats": repeats,
    }


def bench_beside(
    map_name: str, rate: float = 300.0, streams: int = 4, seconds: float = 20.0
) -> dict[str, Any]:
    """What learner steps of one thread lose while the learner takes in `rate` episodes per second."""
    settings = config.load(
        None, [f"env.map={map_name}", "training.lag=1", "learner.device=cpu", "learner.threads=1"]
    )
    keep_memory()
    spec = env_spec(settings.env)
    batch = synthetic_batch(spec, settings.training.batch_episodes, 25, seed=0)
    period = settings.training.batch_episodes / rate

    def learn(learner: Compute, stop: threading.Event, steps: list[float]) -> None:
        while not stop.is_set() or len(steps) < 2:  # the first is the warm-up
            begin = time.perf_counter()
            learner.update(batch)
            steps.append(time.perf_counter() - begin)

    async def measure(learner: Compute, intake: _Intake, busy: bool) -> float:
        stop, steps = threading.Event(), list[float]()
        thread = threading.Thread(target=learn, args=(learner, stop, steps))
        thread.start()
        begin = time.perf_counter()
        while time.perf_counter() - begin < seconds:
            next_open = time.perf_counter() + period
            if busy:
                intake.open()
                await intake.next_batch()
            await asyncio.sleep(max(0.0, next_open - time.perf_counter()))
        stop.set()
        await asyncio.to_thread(thread.join)
        return median(steps[1:])

    async def compare() -> tuple[list[float], list[float]]:
        alone, beside = [], []
        with Compute(spec, settings) as learner:
            async with _intake(settings, streams, _tickets(settings)) as intake:
                intake.allow_all()
                for _ in range(3):  # in turns, for a machine that others use
                    alone.append(await measure(learner, intake, busy=False))
                    beside.append(await measure(learner, intake, busy=True))
        return alone, beside

    alone, beside = asyncio.run(compare())
    return {
        "map": map_name,
        "episodes_per_s": rate,
        "update_alone_ms": 1e3 * median(alone),
        "update_beside_ms": 1e3 * median(beside),
        "loss": median(b / a for a, b in zip(alone, beside, strict=True)) - 1,
    }


def _tickets(settings: config.Config) -> int:
    return make_player(settings.env, settings.algorithm.policy_hidden).tickets_held


def _episode(settings: config.Config) -> rollout_pb2.Trajectory:
    player = make_player(settings.env, settings.algorithm.policy_hidden)
    player.load(random_weights(player.spec, settings.algorithm.policy_hidden, seed=0))
    trajectory = player.play(Ticket.for_training(0, 0, 0, Exploration.SOFTMAX_FLOOR, 0.1))
    return codec.encode_trajectory(trajectory, rollout_pb2.ActorStats())
