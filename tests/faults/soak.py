"""`make soak MINUTES=5`: trains for that long and says whether anything grows that should not.

Each process's memory, file descriptors and threads are sampled, and the streams at the learner. The first
third of the time is warm-up; for the rest, growth is the slope of the straight line that fits best.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import psutil

from tests.e2e import service

ACTORS = 8
SETTINGS = (
    f"actors.count={ACTORS}",
    "training.total_env_steps=1000000000",
    "training.batch_episodes=32",
    "training.checkpoint_interval=100",
    "training.save_interval=50",
    "checkpoints.keep_newest=10",
    "learner.threads=1",
    "evaluation.episodes=20",
)
PROCESSES = {
    "learner": "services.learner --",
    "compute": "services.learner.compute",
    "driver": "services.actor",
    "evaluator": "services.evaluator",
    "actor": "ray::ActorProcess",
    "gcs_server": "/gcs/gcs_server",
    "raylet": "/raylet/raylet",
}
"""What is in a process's command line, and in no other's."""
EVERY_S = 2.0
START_S = 600.0
MOST_PER_HOUR = {"memory, MiB": 10.0, "descriptors": 20.0, "threads": 20.0, "streams": 20.0}
"""The learner may grow by 24 bytes of each checkpoint, which is 0.2 MiB of the thousands an hour here."""
CERTAIN = 3.0
"""So many standard errors beyond it, a slope is growth and no chance."""
BLOCKS = 10
"""Samples that follow each other are alike; the means of so many stretches of time are nearly independent."""

Samples = dict[tuple[str, str], list[tuple[float, float]]]
"""(process, figure) → (seconds, value), in order"""


def sample(process: psutil.Process, name: str, now: float, samples: Samples) -> None:
    """What one process holds now.

    Raises:
        psutil.NoSuchProcess: it is gone.
    """
    with process.oneshot():
        samples[name, "memory, MiB"].append((now, process.memory_info().rss / 2**20))
        samples[name, "descriptors"].append((now, process.num_fds()))
        samples[name, "threads"].append((now, process.num_threads()))


def processes(training: subprocess.Popen[str]) -> dict[str, psutil.Process]:
    """All that are sampled, by name."""
    found = {"launcher": psutil.Process(training.pid)}
    for name, command in PROCESSES.items():
        alike = service.descendants(training, command)
        assert len(alike) == (ACTORS if name == "actor" else 1), f"{name}: {alike}"
        found |= {f"{name} {number}" if name == "actor" else name: each for number, each in enumerate(alike)}
    return found


def measure(run_dir: Path, minutes: float) -> tuple[Samples, int]:
    """Samples of a training of so many minutes, and its learner steps.

    Raises:
        psutil.NoSuchProcess: a process that was sampled has ended, whether another took its place or not.
    """
    samples: Samples = defaultdict(list)
    with service.training(run_dir, *SETTINGS) as training:
        service.wait_for(lambda: service.learner_step(run_dir) > 0, "the first learner step", START_S)
        with service.client(run_dir) as client:
            service.wait_for(lambda: client.status().actors == ACTORS, "the last actor", START_S)
            found = processes(training)
            begin = time.monotonic()
            while (now := time.monotonic() - begin) < 60 * minutes:
                for name, process in found.items():
                    sample(process, name, now, samples)
                samples["learner", "streams"].append((now, client.status().actors))
                time.sleep(EVERY_S)
            steps = client.status().learner_step
        training.send_signal(signal.SIGTERM)
        service.finish(training, code=128 + signal.SIGTERM)
    return samples, steps


def growth(points: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Mean, slope per hour and the slope's standard error, after warm-up."""
    after = [point for point in points if point[0] >= points[-1][0] / 3]
    seconds, values = np.array([np.mean(block, 0) for block in np.array_split(after, BLOCKS)]).T
    (slope, _), covariance = np.polyfit(seconds, values, 1, cov=True)
    return values.mean(), slope * 3600, np.sqrt(covariance[0, 0]) * 3600


def main() -> int:
    """Print a row for every figure; 1 if one of them grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    minutes = parser.parse_args().minutes
    with tempfile.TemporaryDirectory() as folder:
        samples, steps = measure(Path(folder) / "run", minutes)
    print(f"{minutes:g} minutes, {steps} learner steps; after a third of the time as warm-up:\n")
    print(f"{'process':12} {'figure':12} {'mean':>9} {'per hour':>9} {'± error':>9}")
    grew = []
    for (name, figure), points in sorted(samples.items()):
        mean, per_hour, error = growth(points)
        print(f"{name:12} {figure:12} {mean:9.1f} {per_hour:9.1f} {error:9.1f}")
        if per_hour - CERTAIN * error > MOST_PER_HOUR[figure]:
            grew.append(f"{name}: {figure} grows by {per_hour:.0f} ± {error:.0f} an hour")
    print("\n" + ("\n".join(grew) or "nothing grows"))
    return bool(grew)


if __name__ == "__main__":
    sys.exit(main())
