"""The actors of a fleet on a real Ray: spread over its nodes, started again, and gone with its head."""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import ray
import structlog
from ray.cluster_utils import Cluster

from services.actor.driver import Fleet
from tests.e2e import service
from tests.faults.supervisor import Supervisor, add_ray
from tests.integration.conftest import NODE

ACTORS = 4
DRIVER = """
import sys
from liir_common import config
from services.actor.driver import Fleet, start_ray
resolved = config.load(settings=[f"actors.ray_address={sys.argv[1]}"])
start_ray(resolved.actors)
fleet = Fleet("127.0.0.1:1", resolved)
assert fleet._start_due()
print("waits", flush=True)
fleet.run()
"""


def crowds(fleet: Fleet) -> list[int]:
    """Numbers of actors on the nodes that have any, smallest first, once all have said where they are."""
    members = fleet._members
    if any(member.ready is not None or member.actor is None for member in members):
        return []
    return sorted(Counter(member.node for member in members).values())


def incarnations(fleet: Fleet) -> int:
    """How often any actor was started again."""
    return sum(member.incarnation for member in fleet._members)


def alive(node: str) -> bool:
    return any(known["NodeID"] == node and known["Alive"] for known in ray.nodes())


def wait_for(condition: Callable[[], bool], what: str) -> None:
    service.wait_for(condition, what, timeout_s=120)


@contextmanager
def running(actors: int) -> Iterator[Fleet]:
    # Nobody listens there: the actors are there and wait.
    fleet = Fleet("127.0.0.1:1", service.config(f"actors.count={actors}"))
    thread = threading.Thread(target=fleet.run)
    thread.start()
    try:
        yield fleet
    finally:
        fleet.stop()
        thread.join(30)
    assert not thread.is_alive()


def kill(title: str) -> bool:
    """Kill the actors whose process has this title; false if none has."""
    found = service.descendants(psutil.Process(), title)
    for process in found:
        service.kill(process)
    return bool(found)


def test_actors_spread_over_nodes_that_come_and_go(cluster: Cluster) -> None:
    cluster.add_node(**NODE)
    with running(ACTORS) as fleet:
        wait_for(lambda: crowds(fleet) == [ACTORS], "all actors on the only node")
        second = cluster.add_node(**NODE)
        wait_for(lambda: crowds(fleet) == [ACTORS // 2] * 2, "half of the actors on the new node")
        assert incarnations(fleet) == ACTORS // 2, "each of them is moved once"
        lost = second.node_id
        cluster.remove_node(second, allow_graceful=False)
        wait_for(lambda: crowds(fleet) == [ACTORS], "all actors on the node that is left")
        # For some seconds Ray still lists the node, as an empty one.
        wait_for(lambda: not alive(lost), "Ray to see that the node is lost")
        assert incarnations(fleet) == ACTORS // 2 + ACTORS // 2, "each of the lost ones is started once"


def test_a_death_is_told_with_the_phase_that_it_ended(cluster: Cluster) -> None:
    cluster.add_node(**NODE)
    begin = time.monotonic()
    with structlog.testing.capture_logs() as lines, running(1) as fleet:
        (member,) = fleet._members
        wait_for(lambda: kill("ActorProcess.__init__"), "an actor that starts")
        wait_for(lambda: member.phase == "playing", "the actor's second start")
        wait_for(lambda: kill("ActorProcess.run"), "an actor that plays")
        wait_for(lambda: len(lines) == 2, "the second death")
    assert [line["phase"] for line in lines] == ["starting", "playing"]
    assert 0.0 <= sum(line["phase_s"] for line in lines) <= time.monotonic() - begin


def test_an_actor_that_rays_memory_monitor_kills_is_started_again(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_memory_usage_threshold", "0.01")  # which any machine is above
    cluster.add_node(**NODE)
    with structlog.testing.capture_logs() as lines, running(1) as fleet:
        wait_for(lambda: incarnations(fleet) > 0, "an actor that is started again")
    assert "low on memory" in lines[0]["error"]


class Actor:
    """One that is told that the run is complete, or, if it is not the first, just misses it."""

    def __init__(self, name: str, *_: object) -> None:
        self._name = name

    def ready(self) -> str:
        return str(ray.get_runtime_context().get_node_id())

    def run(self) -> None:
        while self._name != "actor-000":
            time.sleep(1)


def test_a_run_is_complete_for_all_when_one_actor_is_told(cluster: Cluster) -> None:
    cluster.add_node(**NODE)
    fleet = Fleet("127.0.0.1:1", service.config("actors.count=3"))
    fleet._actor_class = ray.remote(num_cpus=0.001)(Actor)
    thread = threading.Thread(target=fleet.run, daemon=True)
    thread.start()
    thread.join(60)
    assert not thread.is_alive()


def test_a_driver_whose_actors_wait_for_nodes_notices_that_the_head_died(tmp_path: Path) -> None:
    supervisor = Supervisor()
    # not `tmp_path`, since the paths of Ray's sockets must be short
    with tempfile.TemporaryDirectory(prefix="liir-", ignore_cleanup_errors=True) as temporary:
        try:
            address = add_ray(supervisor, tmp_path, Path(temporary), nodes=0)
            supervisor.add("driver", sys.executable, "-c", DRIVER, address, folder=tmp_path)
            said = supervisor.services["driver"].log.read_text
            wait_for(lambda: said().count("waits") == 1, "a driver in a cluster")
            supervisor.services["head"].kill()
            wait_for(lambda: said().count("waits") == 2, "the next driver in the next cluster")
        finally:
            supervisor.end()
