"""`make soak MINUTES=5`: trains for that long and says whether anything grows that should not.

Each process's memory, file descriptors and threads are sampled, and the streams at the learner. The first
third of the time is warm-up; the growth over the rest is that of the straight line that fits best.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import suppress
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
    "learner": "services.learner",
    "driver": "services.actor",
    "evaluator": "services.evaluator",
    "actor": "ray::RolloutActor",
}
EVERY_S = 2.0
MOST_GROWTH = {"memory, MiB": 8.0, "descriptors": 2.0, "threads": 2.0, "streams": 0.5}
"""Over the whole time after warm-up."""

Samples = dict[tuple[str, str], list[tuple[float, float]]]
"""(process, figure) → (seconds, value), in order"""


def sample(process: psutil.Process, name: str, now: float, samples: Samples) -> None:
    """What one process holds now; nothing if it is gone."""
    with suppress(psutil.NoSuchProcess), process.oneshot():
        samples[name, "memory, MiB"].append((now, process.memory_info().rss / 2**20))
        samples[name, "descriptors"].append((now, process.num_fds()))
        samples[name, "threads"].append((now, process.num_threads()))


def measure(run_dir: Path, minutes: float) -> tuple[Samples, int]:
    """Samples of a training of so many minutes, and its learner steps."""
    samples: Samples = defaultdict(list)
    with service.training(run_dir, *SETTINGS) as training:
        service.wait_for(lambda: service.learner_step(run_dir) > 0, "the first learner step")
        with service.client(run_dir) as client:
            service.wait_for(lambda: client.status().actors == ACTORS, "the last actor")
            found = {
                f"{name} {number}" if name == "actor" else name: process
                for name, command in PROCESSES.items()
                for number, process in enumerate(service.descendants(training, command))
            }
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
    """Mean, growth over the time after warm-up and slope per hour, of the line that fits best."""
    seconds, values = np.array(points).T
    after = seconds >= seconds[-1] / 3
    slope = np.polyfit(seconds[after], values[after], 1)[0]
    return values[after].mean(), slope * np.ptp(seconds[after]), slope * 3600


def main() -> int:
    """Print a row for every figure; 1 if one of them grew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    minutes = parser.parse_args().minutes
    with tempfile.TemporaryDirectory() as folder:
        samples, steps = measure(Path(folder) / "run", minutes)
    print(f"{minutes:g} minutes, {steps} learner steps; after a third of the time as warm-up:\n")
    print(f"{'process':12} {'figure':12} {'mean':>9} {'growth':>9} {'per hour':>9}")
    grew = []
    for (name, figure), points in sorted(samples.items()):
        mean, grown, per_hour = growth(points)
        print(f"{name:12} {figure:12} {mean:9.1f} {grown:9.2f} {per_hour:9.1f}")
        if grown > MOST_GROWTH[figure]:
            grew.append(f"{name}: {figure} grew by {grown:.2f}")
    print("\n" + ("\n".join(grew) or "nothing grew"))
    return bool(grew)


if __name__ == "__main__":
    sys.exit(main())
