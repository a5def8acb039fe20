"""Sweeps of real runs: interrupted and completed, with one that cannot work, and two on one Ray cluster."""

from __future__ import annotations

import secrets
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
import yaml

from liir_common.files import read_table
from tests.e2e.service import (
    TIMEOUT_S,
    descendants,
    digests,
    endpoints,
    finish,
    learner_step,
    start,
    wait_for,
)
from tests.faults.supervisor import Supervisor, add_ray

SWEEP = {
    "base": {
        "training": {
            "total_env_steps": 6000,
            "batch_episodes": 8,
            "checkpoint_interval": 20,
            "save_interval": 3,
        },
        "actors": {"count": 1},
        "evaluation": {"episodes": 2},
    },
    "maps": {"3m": {}, "nowhere": {}},
    "methods": {"liir": {}},
    "seeds": [1],
}
SEEDS = SWEEP | {"maps": {"3m": {}}, "seeds": [1, 2]}
BOTH = ("3m-liir-seed1", "3m-liir-seed2")


@dataclass(frozen=True)
class RayCluster:
    """A head that plays nothing and a node, each `ray start --block`."""

    address: str
    supervisor: Supervisor

    @property
    def started(self) -> bool:
        """Whether head and node are up."""
        return all("Ray runtime started" in ray.log.read_text() for ray in self.supervisor.services.values())

    @property
    def pids(self) -> list[int]:
        """Of head and node, which have others once they ended and were started again."""
        return [ray.process.pid for ray in self.supervisor.services.values()]

    @property
    def actors(self) -> list[psutil.Process]:
        """Every run's actors here."""
        return descendants(psutil.Process(self.supervisor.services["node-0"].process.pid), "ActorProcess")

    def plays_for(self, sweep: subprocess.Popen[str], folder: Path) -> bool:
        """Whether at this moment each run's learner has an actor here that is connected to it."""
        learners = {process.pid for process in descendants(sweep, "services.learner --")}
        serving = [endpoints(folder / run) for run in BOTH]
        ports = {int(found["address"].rpartition(":")[2]) for found in serving if found["pid"] in learners}
        ends = [connection.raddr for actor in self.actors for connection in actor.net_connections()]
        return len(ports) == len(BOTH) and ports <= {end.port for end in ends if end}


@pytest.fixture
def ray_cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RayCluster]:
    """A cluster of the test's own, which only its token opens."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex())
    supervisor = Supervisor()
    # not `tmp_path`, since the paths of Ray's sockets must be short
    with tempfile.TemporaryDirectory(prefix="liir-", dir="/tmp", ignore_cleanup_errors=True) as temporary:
        try:
            cluster = RayCluster(add_ray(supervisor, tmp_path, Path(temporary), nodes=1), supervisor)
            wait_for(lambda: cluster.started, "the Ray cluster's start", TIMEOUT_S)
            yield cluster
        finally:
            supervisor.end()


@contextmanager
def sweeping(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A sweep under way; ended if the test did not end it."""
    process = start("sweep", *arguments)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.communicate(timeout=60)


def wait_while_running(process: subprocess.Popen[str], condition: Callable[[], bool], what: str) -> None:
    def holds() -> bool:
        assert process.poll() is None, process.communicate()[0]
        return condition()

    wait_for(holds, what, TIMEOUT_S)


def statuses(folder: Path) -> dict[str, str]:
    return {row["run"]: row["status"] for row in read_table(folder / "runs.csv")}


def wins(folder: Path, run: str) -> list[tuple[int, ...]]:
    """Episode, environment steps and wins of each test of a run, as the results file has them."""
    columns = ("episode", "env_steps", "greedy_wins", "sampled_wins")
    rows = [row for row in read_table(folder / "results.csv") if row["run"] == run]
    return [tuple(int(row[column]) for column in columns) for row in rows]


def as_far(folder: Path, other: Path) -> bool:
    """Whether each run has at least as many tests as its like in another folder."""
    return all(
        len(read_table(folder / run / "evaluations.csv")) >= len(read_table(other / run / "evaluations.csv"))
        for run in BOTH
    )


def test_a_sweep_goes_on_where_it_was_and_one_failure_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(SWEEP))
    command = ["sweep", str(tmp_path / "sweep.yaml"), "--output", str(tmp_path / "out")]

    process = start(*command)
    wait_while_running(process, lambda: learner_step(tmp_path / "out" / "3m-liir-seed1") > 0, "a step")
    process.send_signal(signal.SIGINT)
    finish(process, code=128 + signal.SIGTERM)
    done = int(read_table(tmp_path / "out" / "3m-liir-seed1" / "metrics.csv")[-1]["env_steps"])
    assert 0 < done < 6000
    assert statuses(tmp_path / "out") == {"3m-liir-seed1": "stopped", "nowhere-liir-seed1": "waiting"}

    output = finish(start(*command, "--jobs", "2"), code=2)
    assert "3m-liir-seed1 goes on" in output
    assert "1 of 2 runs complete" in output
    log = tmp_path / "out" / "logs" / "nowhere-liir-seed1.log"
    assert str(log) in output
    assert "unknown map 'nowhere'" in log.read_text()
    assert statuses(tmp_path / "out") == {"3m-liir-seed1": "complete", "nowhere-liir-seed1": "failed"}
    rows = read_table(tmp_path / "out" / "results.csv")
    episodes = [int(row["episode"]) for row in rows]
    assert episodes == list(range(20, 20 * len(rows) + 1, 20))
    assert {row["method"] for row in rows} == {"liir"}

    output = finish(start(*command, "--maps", "3m"))
    assert "3m-liir-seed1 skipped" in output

    output = finish(start(*command, "--maps", "3m", "--set", "training.total_env_steps=7000"))
    assert "3m-liir-seed1 goes on" in output
    assert statuses(tmp_path / "out") == {"3m-liir-seed1": "complete", "nowhere-liir-seed1": "failed"}
    assert int(read_table(tmp_path / "out" / "runs.csv")[-1]["env_steps"]) >= 7000
    more = read_table(tmp_path / "out" / "results.csv")
    assert [row["greedy_wins"] for row in more[: len(rows)]] == [row["greedy_wins"] for row in rows]


def test_runs_at_once_on_one_ray_cluster_come_out_as_each_alone(
    tmp_path: Path, ray_cluster: RayCluster
) -> None:
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(SEEDS))
    shared, alone = tmp_path / "shared", tmp_path / "alone"
    finish(start("sweep", str(tmp_path / "sweep.yaml"), "--output", str(alone)))
    command = [str(tmp_path / "sweep.yaml"), "--output", str(shared), "--jobs", "2"]
    command += ["--set", f"actors.ray_address={ray_cluster.address}", "--set"]
    pids = ray_cluster.pids

    assert "2 of 2 runs complete" in finish(start("sweep", *command, "training.total_env_steps=3000"))
    assert statuses(shared) == dict.fromkeys(BOTH, "complete")
    wait_for(lambda: not ray_cluster.actors, "the end of the last actor", TIMEOUT_S)

    # Neither gets there, so the one that plays first is not done before the other plays.
    with sweeping(*command, "training.total_env_steps=100000000") as process:
        wait_while_running(process, lambda: ray_cluster.plays_for(process, shared), "both runs' play there")
        assert not descendants(process, "raylet/raylet"), "no run has a Ray of its own"
        wait_while_running(process, lambda: as_far(shared, alone), "as many tests as of the runs alone")
        process.send_signal(signal.SIGINT)
        output = finish(process, code=128 + signal.SIGTERM)
    assert all(f"{run} goes on" in output for run in BOTH)
    assert statuses(shared) == dict.fromkeys(BOTH, "stopped")
    wait_for(lambda: not ray_cluster.actors, "the end of the last actor", TIMEOUT_S)
    assert ray_cluster.pids == pids, "head and node outlive the runs"

    for run in BOTH:
        wanted, got = wins(alone, run), wins(shared, run)
        assert got[: len(wanted)] == wanted
        assert [episode for episode, *_ in got] == list(range(20, 20 * len(got) + 1, 20))
        weights = digests(shared / run)
        assert {episode: weights[episode] for episode, *_ in wanted} == digests(alone / run)
