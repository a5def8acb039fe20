"""How fast the whole service trains on this machine, and what memory its processes take."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from liir_common.errors import LiirError
from liir_common.files import read_table

_WARM_UP_STEPS = 50_000
_POLL_S = 0.1


def bench_train(map_name: str, env_steps: int, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Run `liir train` from its start for `env_steps` steps beyond the warm-up, and measure from outside.

    The rate is the median over ten stretches of equal length after the first 50 000 environment steps.
    Memory is proportional set size (PSS), so that shared pages count once.

    Raises:
        LiirError: the training ended too early.
    """
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        total = _WARM_UP_STEPS + env_steps
        free_ports = [f"{key}=0" for key in ("learner.port", "learner.metrics_port", "actors.metrics_port")]
        chosen = [
            f"env.map={map_name}",
            f"training.total_env_steps={total}",
            *free_ports,
            "evaluation.metrics_port=0",
            *settings,
        ]
        command = [sys.executable, "-m", "liir_common.cli", "train", "--run-dir", str(run_dir)]
        command += [part for setting in chosen for part in ("--set", setting)]
        begin = time.time()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            memory = _watch(process, run_dir, total)
            _, errors = process.communicate()
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                process.wait()
        if process.returncode:
            raise LiirError(f"the training ended with code {process.returncode}:\n{errors.decode()}")
        rows = read_table(run_dir / "metrics.csv")
        return {
            "map": map_name,
            "env_steps_per_s": _rate(rows),
            "first_learner_step_s": float(rows[0]["time"]) - begin,
            "collect_ms": 1e3 * median(float(row["collect_s"]) for row in rows),
            "update_ms": 1e3 * median(float(row["update_s"]) for row in rows),
            "whole_run_s": time.time() - begin,
            "env_steps": total,
            **memory,
        }


def _watch(process: subprocess.Popen[bytes], run_dir: Path, total: int) -> dict[str, float]:
    """PSS of the learner's two processes and of the largest actor, MiB, read once past half of the run."""
    while process.poll() is None:
        rows = read_table(run_dir / "metrics.csv")
        if rows and int(rows[-1]["env_steps"]) > total / 2:
            break
        time.sleep(_POLL_S * 10)
    found = {"learner_pss_mib": 0.0, "actor_pss_mib": 0.0, "actors": 0.0}
    children = [] if process.returncode else psutil.Process(process.pid).children(recursive=True)
    for child in children:
        try:
            command, pss = " ".join(child.cmdline()), child.memory_full_info().pss / 2**20
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        if "services.learner" in command:
            found["learner_pss_mib"] += pss
        if "ray::ActorProcess" in command:
            found["actor_pss_mib"] = max(found["actor_pss_mib"], pss)
            found["actors"] += 1
    return found


def _rate(rows: list[dict[str, str]]) -> float:
    points = [(float(row["time"]), int(row["env_steps"])) for row in rows]
    points = [point for point in points if point[1] > _WARM_UP_STEPS]
    stretch = max(1, len(points) // 10)
    ends = list(zip(points[::stretch], points[stretch::stretch], strict=False))
    return median((n1 - n0) / (t1 - t0) for (t0, n0), (t1, n1) in ends)
