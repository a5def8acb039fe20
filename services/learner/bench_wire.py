"""The learner's end of the actors' streams: what an episode costs its process, when a policy is with all."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import queue
import threading
import time
from collections.abc import AsyncIterator, Iterable, Iterator, MutableSequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from multiprocessing.context import SpawnProcess
from statistics import median
from typing import Any, NamedTuple

import grpc

from liir_common import config
from liir_common.build import build
from liir_common.rollout.play import env_spec, make_player
from liir_common.rollout.policy import random_weights
from liir_common.rpc import codec
from liir_common.rpc.channel import CHANNEL_OPTIONS
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.requests import Outgoing, gather, put_together
from liir_common.rpc.server import Server
from liir_common.types import Exploration, Ticket, Trajectory, Weights
from services.learner.bench import synthetic_batch
from services.learner.compute import Compute
from services.learner.intake import Opening
from services.learner.memory import keep_memory
from services.learner.rollout_service import RolloutService

_AHEAD = 8
"""Batches open at a time, so that no stream ever waits for the learner step that is left out."""


class _Shared(NamedTuple):
    """What the clients' processes have in common with this one."""

    arrivals: MutableSequence[float]
    """Per stream, when it got the newest policy, on the monotonic clock of all processes"""
    together: Any
    """Whether all wait with their answers for the last who gets a ticket: a shared boolean"""
    barrier: threading.Barrier


@dataclass
class _Intake:
    """A learner that neither learns nor plays: batches are opened and come back."""

    service: RolloutService
    delivered: queue.SimpleQueue[list[Trajectory] | None]
    weights: Weights
    shared: _Shared
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


@asynccontextmanager
async def _intake(settings: config.Config, streams: int, tickets: int) -> AsyncIterator[_Intake]:
    """Clients are processes of their own, each with one stream that holds `tickets`, and answer every ticket
    with the same real episode."""
    spec = env_spec(settings.env)
    delivered: queue.SimpleQueue[list[Trajectory] | None] = queue.SimpleQueue()
    service = RolloutService(settings, spec, 0, delivered)
    server = Server("127.0.0.1", 0, settings.security)
    rollout_pb2_grpc.add_RolloutServiceServicer_to_server(service, server.grpc)
    await server.start()
    spawn = multiprocessing.get_context("spawn")
    arrivals: Any = spawn.Array("d", streams, lock=False)
    shared = _Shared(arrivals, spawn.Value("b", False, lock=False), spawn.Barrier(streams))
    address = f"127.0.0.1:{server.port}"
    # Played here: every client would load the compiled code, or compile it.
    episode = _episode(settings).SerializeToString()
    clients = [
        spawn.Process(target=_client, args=(address, spec.hash, tickets, episode, shared, i), daemon=True)
        for i in range(streams)
    ]
    try:
        # In a thread: gRPC cancels calls that wait half a minute for a loop that stands still.
        await asyncio.to_thread(_start, clients)
        while service.actors < streams:
            if any(client.exitcode for client in clients):
                raise RuntimeError("a client died before all had joined; its error is above")
            await asyncio.sleep(0.1)
        weights = random_weights(spec, settings.algorithm.policy_hidden, seed=0)
        yield _Intake(service, delivered, weights, shared, len(episode))
        await service.drain("measured", run_complete=True, grace_s=5.0)
    finally:
        for client in clients:
            if client.pid is not None:
                client.terminate()
        await server.stop(0)


def _start(clients: Iterable[SpawnProcess]) -> None:
    for client in clients:
        client.start()


def bench_wire(map_name: str, streams: int = 4, batches: int = 40, repeats: int = 5) -> dict[str, Any]:
    """Medians over `repeats` of the rate and of this process's CPU time per episode, as fast as they come."""
    settings = config.load(None, [f"env.map={map_name}", "training.lag=1"])
    per_repeat = batches * settings.training.batch_episodes
    keep_memory()

    async def measure() -> tuple[list[float], list[float], int]:
        rates, costs = [], []
        async with _intake(settings, streams, _tickets(settings)) as intake:
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
        intake.shared.together.value = together
        found = []
        for _ in range(repeats + 1):
            begin = time.monotonic()
            intake.open(intake.opened)
            await intake.next_batch()
            assert min(intake.shared.arrivals) >= begin  # a ticket for each
            found.append(max(intake.shared.arrivals) - begin)
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


def _client(address: str, spec_hash: str, tickets: int, episode: bytes, shared: _Shared, index: int) -> None:
    trajectory = rollout_pb2.Trajectory.FromString(episode)
    outgoing: Outgoing = queue.SimpleQueue()
    hello = rollout_pb2.Hello(actor_id=f"bench-{os.getpid()}", env_spec_hash=spec_hash, build=build())
    outgoing.put(rollout_pb2.PlayRequest(hello=hello, ready=rollout_pb2.Ready(tickets=tickets)))
    with grpc.insecure_channel(address, options=CHANNEL_OPTIONS) as channel:
        for message in rollout_pb2_grpc.RolloutServiceStub(channel).Play(put_together(outgoing)):
            if message.HasField("drain"):
                break
            if message.HasField("policy"):
                shared.arrivals[index] = time.monotonic()
            if shared.together.value and message.tickets:
                shared.barrier.wait()
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
