"""The fleet: N Ray actors kept alive until the run is complete."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any

import ray
import structlog

from liir_common import metrics
from liir_common.config import ActorsConfig, Config
from liir_common.errors import LiirError, RefusedError
from liir_common.rpc.channel import backoffs
from services.actor.rollout_actor import RolloutActor

log = structlog.get_logger()

_POLL_S, _POLL_WHILE_STARTING_S = 1.0, 0.1
_QUICK_DEATH_S = 10.0
"""An actor that dies sooner is started again more and more slowly."""


@dataclass
class _Member:
    """One place in the fleet, whoever fills it."""

    name: str
    incarnation: int = -1
    started: float = 0.0
    start_at: float = 0.0
    """When it is due to start, on the monotonic clock."""
    actor: Any = None
    """The Ray actor that fills it, or filled it last."""
    ready: Any = None
    """Reference that resolves when the actor is there; None once it did."""
    run: Any = None
    """Reference that resolves when the actor ends; None while there is none."""


class Fleet:
    """Starts the actors and replaces those that die."""

    def __init__(self, address: str, config: Config) -> None:
        """Play for the learner at `address`; Ray must be initialised."""
        self._address = address
        self._tree = config.tree()
        # An actor waits more than it computes: it reserves so little that any number fits, spread evenly
        # over the nodes, and yet none goes to a node without CPUs, which a cluster's head should be.
        self._actor_class: Any = ray.remote(num_cpus=0.001, scheduling_strategy="SPREAD")(RolloutActor)
        self._members = [_Member(f"actor-{i:03d}") for i in range(config.actors.count)]
        self._stopping = False
        self._waits = {member.name: backoffs() for member in self._members}
        # Starting is work for a core: one at a time on each, so that the first play while others start.
        metrics.ACTORS_WANTED.set(config.actors.count)
        self._starting_at_once = max(1, int(ray.cluster_resources().get("CPU", 1)))

    def stop(self) -> None:
        """Let `run` return soon; may be called by a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Return when every actor was told that the run is complete, or after `stop`.

        Raises:
            RefusedError: the learner will not have an actor.
            ray.exceptions.RayTaskError: an actor failed; its traceback is part of the message.
        """
        while self._members and not self._stopping:
            starting = self._start_due()
            metrics.ACTORS_ALIVE.set(sum(member.run is not None for member in self._members))
            self._collect_ended(_POLL_WHILE_STARTING_S if starting else _POLL_S)

    def _start_due(self) -> bool:
        """Start those whose time has come, as many as may; true if some are on the way."""
        starting = [member for member in self._members if member.ready is not None]
        for member in starting:
            if ray.wait([member.ready], timeout=0)[0]:
                member.ready = None
        now = time.monotonic()
        due = [member for member in self._members if member.run is None and member.start_at <= now]
        room = self._starting_at_once - sum(member.ready is not None for member in starting)
        for member in due[: max(0, room)]:
            self._start(member)
        return bool(due) or any(member.ready is not None for member in starting)

    def _start(self, member: _Member) -> None:
        member.incarnation += 1
        member.started = time.monotonic()
        member.actor = self._actor_class.remote(member.name, member.incarnation, self._address, self._tree)
        member.ready, member.run = member.actor.ready.remote(), member.actor.run.remote()

    def _collect_ended(self, timeout_s: float) -> None:
        running = {member.run: member for member in self._members if member.run is not None}
        if not running:
            time.sleep(timeout_s)
            return
        ended, _ = ray.wait(list(running), timeout=timeout_s)
        for reference in ended:
            member = running[reference]
            try:
                ray.get(reference)
            except RefusedError as error:
                raise RefusedError(f"{member.name}: {error}") from None
            except ray.exceptions.RayActorError as error:
                self._died(member, error)
            else:
                self._members.remove(member)

    def _died(self, member: _Member, error: Exception) -> None:
        # Ray also calls an actor dead that it cannot reach for a moment; left alone, it would play on.
        ray.kill(member.actor)
        now = time.monotonic()
        if now - member.started > _QUICK_DEATH_S:
            self._waits[member.name] = backoffs()
        wait = next(self._waits[member.name])
        log.error(
            "an actor died; it is started again", actor=member.name, wait_s=round(wait, 2), error=str(error)
        )
        metrics.ACTOR_RESTARTS.inc()
        member.ready = member.run = None
        member.start_at = now + wait


def start_ray(config: ActorsConfig) -> None:
    """Join the configured Ray cluster, or start one on this machine.

    Raises:
        LiirError: the cluster cannot be reached.
    """
    # Ray decides by itself when this is unset, and writes a token into the home folder.
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        if config.ray_address:
            ray.init(address=config.ray_address, namespace="liir")
        else:
            # Trajectories go over gRPC, so the object store can be as small as Ray allows.
            ray.init(address="local", include_dashboard=False, object_store_memory=80 * 2**20)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise LiirError(
            f"cannot start or join Ray at {config.ray_address or 'this machine'}: {error}"
        ) from None
