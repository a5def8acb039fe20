"""How many episodes a second the learner takes in, and what each costs its process."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import queue
import time
from statistics import median
from typing import Any

import grpc

from liir_common import config
from liir_common.build import build
from liir_common.rollout.play import env_spec, make_player
from liir_common.rollout.policy import random_weights
from liir_common.rpc import codec
from liir_common.rpc.channel import CHANNEL_OPTIONS
from liir_common.rpc.gen.liir.v1 import rollout_pb2, rollout_pb2_grpc
from liir_common.rpc.requests import Outgoing, put_together
from liir_common.rpc.server import Server
from liir_common.types import Exploration, Ticket, Trajectory
from services.learner.intake import Opening
from services.learner.rollout_service import RolloutService

_AHEAD = 8
"""Batches open at a time, so that no stream ever waits for the learner step that this leaves out."""


def bench_wire(map_name: str, streams: int = 4, batches: int = 40, repeats: int = 5) -> dict[str, Any]:
    """Medians over `repeats` of the rate and of this process's CPU time per episode.

    The clients are processes of their own, each with one stream, that answer every ticket with the same
    real episode: all that is left out is playing and learning.
    """
    settings = config.load(None, [f"env.map={map_name}", f"training.lag={1}"])
    return asyncio.run(_measure(settings, streams, batches, repeats))


async def _measure(settings: config.Config, streams: int, batches: int, repeats: int) -> dict[str, Any]:
    spec = env_spec(settings.env)
    delivered: queue.SimpleQueue[list[Trajectory] | None] = queue.SimpleQueue()
    service = RolloutService(settings, spec, 0, delivered)
    server = Server("127.0.0.1", 0, settings.security)
    rollout_pb2_grpc.add_RolloutServiceServicer_to_server(service, server.grpc)
    await server.start()
    weights = random_weights(spec, settings.algorithm.policy_hidden, seed=0)
    for batch in range(_AHEAD):
        service.publish(Opening(batch, 0, 0.1), weights)
    spawn = multiprocessing.get_context("spawn")
    clients = [
        spawn.Process(target=_client, args=(f"127.0.0.1:{server.port}", settings.tree()), daemon=True)
        for _ in range(streams)
    ]
    for client in clients:
        client.start()
    opened, rates, costs = _AHEAD, [], []
    per_batch = settings.training.batch_episodes
    for repeat in range(repeats + 1):
        begin, cpu = time.perf_counter(), time.process_time()
        for _ in range(batches):
            await asyncio.to_thread(delivered.get)
            service.publish(Opening(opened, 0, 0.1), weights)
            opened += 1
        if repeat:  # the first is the warm-up
            episodes = batches * per_batch
            rates.append(episodes / (time.perf_counter() - begin))
            costs.append((time.process_time() - cpu) / episodes)
    for client in clients:
        client.terminate()
    await server.stop(0)
    size = _episode(settings).ByteSize()
    return {
        "map": settings.env.map,
        "streams": streams,
        "bytes_per_episode": size,
        "episodes_per_s": median(rates),
        "megabytes_per_s": median(rates) * size / 1e6,
        "learner_cpu_us_per_episode": 1e6 * median(costs),
        "episodes": batches * per_batch,
        "repeats": repeats,
    }


def _episode(settings: config.Config) -> rollout_pb2.Trajectory:
    player = make_player(settings.env, settings.algorithm.policy_hidden)
    player.load(random_weights(player.spec, settings.algorithm.policy_hidden, seed=0))
    trajectory = player.play(Ticket.for_training(0, 0, 0, Exploration.SOFTMAX_FLOOR, 0.1))
    return codec.encode_trajectory(trajectory, rollout_pb2.ActorStats())


def _client(address: str, tree: dict[str, Any]) -> None:
    settings = config.from_tree(tree)
    trajectory = _episode(settings)
    tickets = make_player(settings.env, settings.algorithm.policy_hidden).tickets_held
    outgoing: Outgoing = queue.SimpleQueue()
    hello = rollout_pb2.Hello(
        actor_id=f"bench-{os.getpid()}", env_spec_hash=env_spec(settings.env).hash, build=build()
    )
    outgoing.put(rollout_pb2.PlayRequest(hello=hello, ready=rollout_pb2.Ready(tickets=tickets)))
    with grpc.insecure_channel(address, options=CHANNEL_OPTIONS) as channel:
        for message in rollout_pb2_grpc.RolloutServiceStub(channel).Play(put_together(outgoing)):
            for ticket in message.tickets:
                trajectory.episode_id = ticket.episode_id
                trajectory.policy_version = ticket.policy_version
                outgoing.put(rollout_pb2.PlayRequest(trajectories=[trajectory]))
