"""The actors of a fleet on two nodes of a real Ray: spread, and spread again when a node comes or goes."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator

import pytest
import ray
from ray.cluster_utils import Cluster

from services.actor.driver import Fleet
from tests.e2e import service

ACTORS = 4


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """A head that plays nothing; nodes come later."""
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": 80 * 2**20})
    ray.init(address=cluster.address, namespace="liir")
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


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


def test_actors_spread_over_nodes_that_come_and_go(cluster: Cluster) -> None:
    node = {"num_cpus": 2, "object_store_memory": 80 * 2**20}
    cluster.add_node(**node)
    # Nobody listens there: the actors are there and wait.
    fleet = Fleet("127.0.0.1:1", service.config(f"actors.count={ACTORS}"))
    thread = threading.Thread(target=fleet.run)
    thread.start()
    try:
        wait_for(lambda: crowds(fleet) == [ACTORS], "all actors on the only node")
        second = cluster.add_node(**node)
        wait_for(lambda: crowds(fleet) == [ACTORS // 2] * 2, "half of the actors on the new node")
        assert incarnations(fleet) == ACTORS // 2, "each of them is moved once"
        lost = second.node_id
        cluster.remove_node(second, allow_graceful=False)
        wait_for(lambda: crowds(fleet) == [ACTORS], "all actors on the node that is left")
        # For some seconds Ray still lists the node, as an empty one.
        wait_for(lambda: not alive(lost), "Ray to see that the node is lost")
        assert incarnations(fleet) == ACTORS // 2 + ACTORS // 2, "each of the lost ones is started once"
    finally:
        fleet.stop()
        thread.join(30)
    assert not thread.is_alive()
