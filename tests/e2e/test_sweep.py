"""A sweep of real runs: interrupted and completed, with one that cannot work."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import yaml

from liir_common.files import read_table
from tests.e2e.service import TIMEOUT_S, finish, start

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


def wait_for_steps(run_dir: Path, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not read_table(run_dir / "metrics.csv"):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)


def statuses(folder: Path) -> dict[str, str]:
    return {row["run"]: row["status"] for row in read_table(folder / "runs.csv")}


def test_a_sweep_goes_on_where_it_was_and_one_failure_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(SWEEP))
    command = ["sweep", str(tmp_path / "sweep.yaml"), "--output", str(tmp_path / "out")]

    process = start(*command)
    wait_for_steps(tmp_path / "out" / "3m-liir-seed1", process)
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
