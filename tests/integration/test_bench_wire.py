"""The benchmarks of the wire run and count what they say; how fast is not a test's business."""

from __future__ import annotations

import json
import subprocess
import sys

from services.learner.bench_wire import bench_beside, bench_policy, bench_wire


def test_every_stream_gets_every_policy() -> None:
    result = bench_policy("3m", streams=3, repeats=4)
    assert 0 < result["policy_ms"] <= result["slowest_ms"]
    assert 0 < result["answering_policy_ms"] <= result["answering_slowest_ms"]
    assert result["bytes_per_policy"] > 100_000


def test_episodes_are_taken_in() -> None:
    result = bench_wire("3m", streams=2, batches=2, repeats=2)
    assert result["episodes"] == 64
    assert result["episodes_per_s"] > 0
    assert result["learner_cpu_us_per_episode"] > 0


def test_a_learner_learns_beside() -> None:
    result = bench_beside("3m", rate=100.0, streams=1, seconds=0.5)
    assert result["update_alone_ms"] > 0
    assert result["update_beside_ms"] > 0


def test_nothing_but_the_result_is_on_stdout() -> None:
    command = [sys.executable, "-m", "liir_common.cli", "bench", "policy", "--streams", "2", "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(result.stdout)["streams"] == 2
    assert "actor joined" in result.stderr
    assert "Traceback" not in result.stderr
