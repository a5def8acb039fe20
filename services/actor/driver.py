"""The fleet: N Ray actors kept alive until the run is complete."""

from __future__ import annotations

import faulthandler
import os
import secrets
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import ray
import structlog
from ray._private import ray_constants
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from liir_common import metrics
from liir_common.config import ActorsConfig, Config
from liir_common.errors import LiirError, RefusedError
from liir_common.rpc import carry
from liir_common.rpc.channel import backoffs
from liir_common.rpc.tokens import Role
from services.actor.process import ActorProcess

log = structlog.get_logger()

GONE = (ray.exceptions.RayActorError, ray.exceptions.OutOfMemoryError)
"""What Ray says of an actor that is dead or away; the second, of one that its memory monitor killed."""
_POLL_S, _POLL_WHILE_STARTING_S = 1.0, 0.1
_RAY_START_S = 180.0
"""Ray that has not started by then never will: a machine that slept meanwhile leaves it waiting."""
_QUICK_DEATH_S = 10.0
"""An actor that dies sooner is started again more and more slowly."""
_SHUNNED_S = 30.0
"""So long nobody is sent to a node on which an actor died; Ray needs less to see that a node is lost."""


@dataclass
class _Member:
    """One place in the fleet, whoever fills it."""

    name: str
    incarnation: int = -1
    started: float = 0.0
    phase: str = ""
    """What it was doing last, for all that is known: starting or playing."""
    phase_since: float = 0.0
    start_at: float = 0.0
    """When it is due to start, on the monotonic clock."""
    actor: Any = None
    """Its Ray actor; None while there is none."""
    node: str = ""
    """Ray's id of the actor's node."""
    ready: Any = None
    """Reference that resolves to the node when the actor is there; None once it did."""
    run: Any = None
    """Reference that resolves when the actor ends; None while there is none."""


class Fleet:
    """Starts the actors and replaces those that die."""

    def __init__(self, address: str, config: Config) -> None:
        """Play for the learner at `address`; Ray must be initialised.

        Raises:
            ConfigError: a file of `security` is to be sent and cannot be read.
        """
        self._address = address
        self._tree = config.tree()
        self._files = carry.pack(config.security, Role.ACTOR) if config.actors.send_security else {}
        # An actor waits more than it computes: it reserves so little that any number fits, and yet none goes
        # to a node without CPUs, which a cluster's head may be.
        self._actor_class: Any = ray.remote(num_cpus=0.001)(ActorProcess)
        self._members = [_Member(f"actor-{i:03d}") for i in range(config.actors.count)]
        self._stopping = False
        self._shunned: dict[str, float] = {}
        """Until when nobody is sent to a node, by Ray's id, on the monotonic clock."""
        self._waits = {member.name: backoffs() for member in self._members}
        metrics.ACTORS_WANTED.set(config.actors.count)
        # Starting is work for a core: one at a time on each, so that the first play while others start, and
        # one more, since a start also waits.
        self._starting_at_once = 1 + max(1, int(ray.cluster_resources().get("CPU", 1)))

    def stop(self) -> None:
        """Let `run` return soon; may be called by a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Return when an actor was told that the run is complete, or after `stop`.

        Raises:
            RefusedError: the learner will not have an actor.
            ray.exceptions.RayTaskError: an actor failed; its traceback is part of the message.
        """
        while not self._stopping:
            starting = self._start_due()
            # Asked each time: by this Ray notices that the head is not the one joined, and ends the process.
            crowds = self._crowds()
            if not starting:
                self._even_out(crowds)
            metrics.ACTORS_ALIVE.set(sum(member.run is not None for member in self._members))
            self._collect_ended(_POLL_WHILE_STARTING_S if starting else _POLL_S)

    def _start_due(self) -> bool:
        """Start those whose time has come, as many as may; true if some are on the way."""
        starting = [member for member in self._members if member.ready is not None]
        for member in starting:
            if ray.wait([member.ready], timeout=0)[0]:
                with suppress(*GONE):  # which `run` has, too
                    member.node = ray.get(member.ready)
                    member.phase, member.phase_since = "playing", time.monotonic()
                member.ready = None
        now = time.monotonic()
        due = [member for member in self._members if member.run is None and member.start_at <= now]
        room = self._starting_at_once - sum(member.ready is not None for member in starting)
        for member in due[: max(0, room)]:
            self._start(member)
        return bool(due) or any(member.ready is not None for member in starting)

    def _start(self, member: _Member) -> None:
        member.incarnation += 1
        member.started = member.phase_since = time.monotonic()
        member.phase = "starting"
        crowds = self._crowds()
        member.node = min(crowds, key=lambda node: crowds[node], default="")
        # Ray takes another node if that one is just being lost, and waits if there is none at all.
        where = NodeAffinitySchedulingStrategy(member.node, soft=True) if member.node else "DEFAULT"
        member.actor = self._actor_class.options(scheduling_strategy=where).remote(
            member.name, member.incarnation, self._address, self._tree, self._files
        )
        member.ready, member.run = member.actor.ready.remote(), member.actor.run.remote()

    def _even_out(self, crowds: Mapping[str, int]) -> None:
        """Move one actor from the fullest node to the emptiest, which may be new or back."""
        if not crowds or max(crowds.values()) - min(crowds.values()) < 2:
            return
        fullest = max(crowds, key=lambda node: crowds[node])
        member = next(m for m in self._members if m.node == fullest and m.actor is not None)
        log.info("an actor moves to an emptier node", actor=member.name)
        ray.kill(member.actor)
        member.actor = member.run = None

    def _crowds(self) -> dict[str, int]:
        """How many actors there are on each node that has CPUs and is not shunned, unless all are."""
        placed = Counter(member.node for member in self._members if member.actor is not None)
        nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
        now = time.monotonic()
        welcome = [node for node in nodes if self._shunned.get(node, now) <= now]
        return {node: placed[node] for node in welcome or nodes}

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
            except GONE as error:
                self._died(member, error)
            else:  # it was told that the run is complete; whoever connects just now would never be
                self.stop()

    def _died(self, member: _Member, error: Exception) -> None:
        # Ray also calls an actor dead that it cannot reach for a moment; left alone, it would play on.
        ray.kill(member.actor)
        now = time.monotonic()
        if now - member.started > _QUICK_DEATH_S:
            self._waits[member.name] = backoffs()
        wait = next(self._waits[member.name])
        log.error(
            "an actor died; it is started again",
            actor=member.name,
            phase=member.phase,
            phase_s=round(now - member.phase_since, 1),
            wait_s=round(wait, 2),
            error=str(error),
        )
        metrics.ACTOR_RESTARTS.inc()
        # The node may be lost as well: it looks empty then, and Ray would let actors wait for it.
        self._shunned[member.node] = now + _SHUNNED_S
        member.actor = member.ready = member.run = None
        member.start_at = now + wait


def start_ray(config: ActorsConfig) -> None:
    """Join the configured Ray cluster, or start one on this machine; ends the process if that hangs.

    Raises:
        LiirError: the cluster cannot be reached.
    """
    faulthandler.dump_traceback_later(_RAY_START_S, exit=True)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        if config.ray_address:
            # When this is unset, Ray decides by what it finds in the home folder.
            os.environ.setdefault("RAY_AUTH_MODE", "disabled")
            ray.init(address=config.ray_address, namespace="liir")
        else:
            # Whoever reaches Ray has it run code. By itself it would take a token from the home folder, and
            # listen on all addresses; only this constant, False on macOS, keeps it to loopback.
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex())
            ray_constants.ENABLE_RAY_CLUSTER = False
            # Trajectories go over gRPC, so the object store can be as small as Ray allows.
            ray.init(address="local", include_dashboard=False, object_store_memory=80 * 2**20)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise LiirError(
            f"cannot start or join Ray at {config.ray_address or 'this machine'}: {error}"
        ) from None
    finally:
        faulthandler.cancel_dump_traceback_later()
