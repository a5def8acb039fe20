"""A Ray cluster of several nodes on this machine."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import ray
from ray.cluster_utils import Cluster

_STORE = {"object_store_memory": 80 * 2**20}
NODE = {"num_cpus": 2} | _STORE


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """A head that plays nothing; nodes come later."""
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0} | _STORE)
    ray.init(address=cluster.address, namespace="liir")
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()
