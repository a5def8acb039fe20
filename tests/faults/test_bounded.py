"""Tickets are the credits: a learner that cannot keep up slows its actors, and nothing piles up in it."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from liir_common.client import TrainingClient
from tests.e2e import service
from tests.e2e.test_run import scrape

ACTORS = 32
LAG = 1
BATCH = 8
SECONDS = 15.0
MOST_GROWTH = 16 * 2**20
"""Bytes. A learner that only takes in gets 2 480 episodes of 36 KB a second (docs/performance.md), so without
credits 15 seconds would bring many times as much."""

pytestmark = pytest.mark.faults


def program(name: str, *arguments: str, log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as file:
        return subprocess.Popen(
            [sys.executable, "-m", f"tests.faults.{name}", *arguments], stdout=file, stderr=file
        )


def test_a_learner_a_hundred_times_slower_than_its_actors_does_not_grow(tmp_path: Path) -> None:
    run_dir, log = tmp_path / "run", tmp_path / "learner.log"
    settings = service.arguments(
        [f"training.lag={LAG}", "training.total_env_steps=1000000", "learner.threads=1"]
    )
    learner = program("slow_learner", "--run-dir", str(run_dir), *settings, log=log)
    actors = None
    try:
        service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
        address = service.endpoints(run_dir)["address"]
        actors = program("many_actors", address, str(ACTORS), log=tmp_path / "actors.log")
        with TrainingClient(address) as training:
            service.wait_for(lambda: training.status().actors == ACTORS, "the last actor")
            step = service.learner_step(run_dir)
            service.wait_for(lambda: service.learner_step(run_dir) >= step + 2, "two steps with all actors")
            begin, memory = service.learner_step(run_dir), []
            processes = [psutil.Process(learner.pid), *psutil.Process(learner.pid).children()]
            assert len(processes) == 2
            deadline = time.monotonic() + SECONDS
            while time.monotonic() < deadline:
                memory.append(sum(process.memory_info().rss for process in processes))
                assert training.status().tickets_outstanding <= (LAG + 1) * BATCH
                # An update opens a batch as soon as it has moved the policy.
                assert scrape(log)["liir_batches_waiting"] <= LAG + 1
                time.sleep(0.25)
            status = training.status()
        assert status.learner_step > begin
        assert status.actors == ACTORS
        assert max(memory) - memory[0] < MOST_GROWTH
    finally:
        for process in (actors, learner):
            if process is not None:
                process.kill()
                process.wait()
