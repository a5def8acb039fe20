"""A process of the run whose Ray node is lost, on a real Ray with two nodes for it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import ray
import structlog
from ray.cluster_utils import Cluster

from liir_common.config import PLAINTEXT
from liir_common.files import read_table
from liir_common.launch import Launcher
from services.cluster.__main__ import _ANYWHERE
from services.cluster.host import RemoteService
from tests.e2e import service
from tests.integration.conftest import NODE
from tests.unit.test_launch import Mortal


@contextmanager
def trained(run_dir: Path) -> Iterator[str]:
    """A training without evaluator, its actors without Ray; yields the learner's address, then must end."""
    slow_tests = service.arguments(["evaluation.episodes=100"])
    learner = service.start("learner", "--run-dir", str(run_dir), *slow_tests)
    actors = None
    try:
        service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
        address = service.endpoints(run_dir)["address"]
        actors = subprocess.Popen([sys.executable, "-m", "tests.faults.many_actors", address, "2"])
        yield address
        service.finish(learner)
        assert actors.wait(60) == 0
    finally:
        for process in (learner, actors):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()


def episodes_tested(run_dir: Path) -> list[int]:
    """Episodes of the checkpoints that the learner has a test of."""
    return [int(row["episode"]) for row in read_table(run_dir / "evaluations.csv")]


def deaths(lines: list[MutableMapping[str, Any]]) -> list[str]:
    """The obituaries among them."""
    return [line["reason"] for line in lines if line["event"].startswith("a process died")]


def node(process: RemoteService) -> str:
    """Ray's id of the node that it is on."""
    return str(ray.get(process._host.node.remote())[1])


def test_an_evaluator_whose_node_is_lost_starts_on_another_and_catches_up(
    cluster: Cluster, tmp_path: Path
) -> None:
    nodes = {node.node_id: node for node in (cluster.add_node(**NODE), cluster.add_node(**NODE))}
    run_dir = tmp_path / "run"
    with trained(run_dir) as address, structlog.testing.capture_logs() as lines:
        evaluator = RemoteService("evaluator", ["--learner", address], tmp_path / "evaluator", _ANYWHERE)
        others = (Mortal(name, [], run_dir) for name in ("learner", "actor"))
        launcher = Launcher(run_dir, *others, evaluator, PLAINTEXT)

        def watched(sign: Callable[[], bool]) -> bool:
            launcher._revive()
            return sign()

        evaluator.start()
        service.wait_for(
            lambda: watched(lambda: "tested" in evaluator._words and bool(episodes_tested(run_dir))),
            "the first test",
        )
        lost = node(evaluator)
        (process,) = service.descendants(psutil.Process(), "services.evaluator")
        process.suspend()  # so that it leaves something to catch up with, and does not die before its node
        try:
            cluster.remove_node(nodes[lost], allow_graceful=False)
            before = len(episodes_tested(run_dir))
            service.wait_for(lambda: watched(lambda: bool(deaths(lines))), "its second start")
        finally:
            with suppress(psutil.NoSuchProcess):  # its node's end may have reached it, stopped or not
                process.kill()
    assert node(evaluator) != lost
    (death,) = deaths(lines)
    assert "in the phase 'tested'; last exception: its node is lost: " in death
    assert episodes_tested(run_dir) == list(service.digests(run_dir))
    assert before < len(episodes_tested(run_dir))
