"""`make soak MINUTES=5`: trains for that long and says whether anything grows that should not.

Of every process of the training, memory, file descriptors and threads are sampled; so are the number of
processes and the streams at the learner. The first third of the time is warm-up; for the rest, growth is the
slope of the straight line that fits best.
"""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

import grpc
import numpy as np
import psutil

from liir_common.client import TrainingClient
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
OURS = {
    "launcher": "liir train ",
    "learner": "services.learner --",
    "compute": "services.learner.compute",
    "driver": "services.actor",
    "evaluator": "services.evaluator",
    "actor": "ray::ActorProcess",
}
RAYS = {
    "gcs_server": "/gcs/gcs_server",
    "raylet": "/raylet/raylet",
    "monitor": "/monitor.py",
    "log monitor": "/log_monitor.py",
    "dashboard": "/dashboard.py",
    "dashboard agent": "ray::DashboardAgent",
    "environment agent": "ray::RuntimeEnvAgent",
}
"""What is in a process's command line, and in no other's."""
EVERY_S = 2.0
NAMES_EVERY = 30
"""So many rounds apart, the threads' names are noted."""
START_S = 600.0
CERTAIN = 3.0
"""So many standard errors beyond it, a slope is growth and no chance."""
BLOCKS = 10
"""Samples that follow each other are alike; the means of so many stretches of time are nearly independent."""

T = TypeVar("T")


class Growth(NamedTuple):
    """Of one figure after warm-up: mean, slope per hour with its standard error, and for how long."""

    mean: float
    per_hour: float
    error: float
    hours: float


class EndedError(Exception):
    """What was to be measured to the end is gone."""


class Most(NamedTuple):
    """What a figure may grow by: so much however long it takes, and so much with every hour."""

    once: float
    per_hour: float = 0.0

    def is_exceeded(self, growth: Growth) -> bool:
        """Whether it has certainly grown by more."""
        certain = growth.per_hour - CERTAIN * growth.error
        return certain * growth.hours > self.once + self.per_hour * growth.hours


MOST_OURS = {
    "memory, MiB": Most(4.0, 0.5),
    "descriptors": Most(2.0),
    "threads": Most(2.0),
    "streams": Most(0.5),
    "processes": Most(1.0),
}
"""Also of what is of no known kind.

Once: an allocator that fills up, one or two threads and descriptors that are made when first needed. With
every hour only memory, since the learner keeps 24 bytes of each checkpoint, 0.2 MiB of the thousands here.
"""
MOST_RAYS = {"memory, MiB": Most(4.0, 2.0), "descriptors": Most(4.0), "threads": Most(10.0)}
"""gRPC inside Ray adds a thread when none is free for a callback, and keeps it long: docs/operations.md."""


class Samples:
    """What was measured of a training."""

    def __init__(self) -> None:
        """Begin with none."""
        self.points: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
        """(process, figure) → (seconds, value), in order"""
        self.threads: dict[str, list[tuple[float, Counter[str]]]] = defaultdict(list)
        """process → (seconds, how many threads have which name), in order"""

    def add(self, process: psutil.Process, name: str, now: float, *, thread_names: bool) -> None:
        """What one process holds now.

        Raises:
            psutil.NoSuchProcess: it is gone.
        """
        with process.oneshot():
            if process.status() == psutil.STATUS_ZOMBIE:  # of which there are figures, too, all of them 0
                raise psutil.ZombieProcess(process.pid, name)
            figures = {
                "memory, MiB": process.memory_info().rss / 2**20,
                "descriptors": process.num_fds(),
                "threads": process.num_threads(),
            }
        for figure, value in figures.items():
            self.points[name, figure].append((now, value))
        if thread_names:
            self.threads[name].append((now, names_of_threads(process.pid)))


def names_of_threads(pid: int) -> Counter[str]:
    """How many threads of a process have which name."""
    names: Counter[str] = Counter()
    for path in Path(f"/proc/{pid}/task").glob("*/comm"):
        with suppress(OSError):
            names[path.read_text().strip()] += 1
    return names


def kind_of(command: str) -> str:
    """A kind, or of a process that is of none the command itself, without folders and cut."""
    for kind, part in (OURS | RAYS).items():
        if part in command:
            return kind
    return re.sub(r"\S*/", "", command)[:24].strip() or "no command"


class Family:
    """The processes of a training, as they are found; each keeps its name."""

    def __init__(self, launcher: psutil.Process) -> None:
        """Look for the first time; those of a known kind that are found now are to last.

        Raises:
            AssertionError: one of ours is missing, or there are too many.
        """
        self._launcher = launcher
        self._kinds: Counter[str] = Counter()
        self._names: dict[psutil.Process, str] = {}
        self._lasting = {one for one in self._look() if base(self._names.get(one, "")) in OURS | RAYS}
        found = {kind: self._kinds[kind] for kind in OURS}
        assert found == {kind: ACTORS if kind == "actor" else 1 for kind in OURS}, found

    def _look(self) -> list[psutil.Process]:
        """All there are now; the new ones get names."""
        found = [self._launcher]
        with suppress(psutil.NoSuchProcess):
            found += self._launcher.children(recursive=True)
        for process in found:
            if process not in self._names:
                with suppress(psutil.NoSuchProcess):  # or a zombie, which is counted all the same
                    self._name(process, kind_of(" ".join(process.cmdline())))
        return found

    def _name(self, process: psutil.Process, kind: str) -> None:
        self._kinds[kind] += 1
        number = self._kinds[kind]
        self._names[process] = kind if number == 1 else f"{kind} #{number}"

    def sample(self, samples: Samples, now: float, *, thread_names: bool) -> None:
        """What all of them hold now.

        Raises:
            EndedError: one that was to last has ended, whether another took its place or not.
        """
        found, ended = self._look(), []
        samples.points["training", "processes"].append((now, len(found)))
        for process in self._lasting.union(filter(self._names.get, found)):
            try:
                samples.add(process, self._names[process], now, thread_names=thread_names)
            except psutil.NoSuchProcess:
                if process in self._lasting:
                    ended.append(self._names[process])
        if ended:
            raise EndedError(f"after {now:.0f} s gone: {', '.join(sorted(ended))}")


def base(name: str) -> str:
    """The kind of which a process is one."""
    return name.partition(" #")[0]


def measure(samples: Samples, run_dir: Path, minutes: float) -> None:
    """Add samples of a training of so many minutes.

    Raises:
        EndedError: a process of a known kind has ended, or the learner does not answer.
        AssertionError: it did not start, or did not end as it was asked to.
        subprocess.TimeoutExpired: it did not end at all.
    """
    with service.training(run_dir, *SETTINGS) as training:
        service.wait_for(lambda: service.learner_step(run_dir) > 0, "the first learner step", START_S)
        with service.client(run_dir) as client:
            service.wait_for(lambda: client.status().actors == ACTORS, "the last actor", START_S)
            sample(samples, Family(psutil.Process(training.pid)), client, minutes)
        training.send_signal(signal.SIGTERM)
        service.finish(training, code=128 + signal.SIGTERM)


def sample(samples: Samples, family: Family, client: TrainingClient, minutes: float) -> None:
    """Add samples for so many minutes; raises what `measure` raises."""
    begin, rounds = time.monotonic(), 0
    while (now := time.monotonic() - begin) < 60 * minutes:
        family.sample(samples, now, thread_names=rounds % NAMES_EVERY == 0)
        try:
            streams = client.status().actors
        except grpc.RpcError as error:
            raise EndedError(f"after {now:.0f} s the learner does not answer: {error.code().name}") from None
        samples.points["learner", "streams"].append((now, streams))
        rounds += 1
        time.sleep(EVERY_S)


def after_warm_up(points: list[tuple[float, T]]) -> list[tuple[float, T]]:
    """Without the first third of the time that there are samples of."""
    begin, end = points[0][0], points[-1][0]
    return [point for point in points if point[0] >= begin + (end - begin) / 3]


def growth(points: list[tuple[float, float]]) -> Growth | None:
    """After warm-up; nothing of a process that was there too briefly."""
    after = after_warm_up(points)
    if len(after) < 2 * BLOCKS:
        return None
    seconds, values = np.array([np.mean(block, 0) for block in np.array_split(after, BLOCKS)]).T
    (slope, _), covariance = np.polyfit(seconds, values, 1, cov=True)
    error = np.sqrt(covariance[0, 0])
    return Growth(values.mean(), slope * 3600, error * 3600, (after[-1][0] - after[0][0]) / 3600)


def most(name: str) -> dict[str, Most]:
    """What a process may grow by."""
    return MOST_RAYS if base(name) in RAYS else MOST_OURS


def new_threads(noted: list[tuple[float, Counter[str]]]) -> str:
    """Names of the threads that came after warm-up."""
    after = after_warm_up(noted)
    return ", ".join(f"{number} {name}" for name, number in (after[-1][1] - after[0][1]).items())


def report(samples: Samples) -> list[str]:
    """Print a row for every figure; returns what grows."""
    print(f"{'process':24} {'figure':12} {'mean':>9} {'per hour':>9} {'± error':>9}")
    grew = []
    for (name, figure), points in sorted(samples.points.items()):
        row, grown = f"{name:24} {figure:12}", growth(points)
        if grown is None:
            (begin, _), (end, value) = points[0], points[-1]
            print(f"{row} {value:9.1f} and was there only from {begin:.0f} s to {end:.0f} s")
            continue
        print(f"{row} {grown.mean:9.1f} {grown.per_hour:9.1f} {grown.error:9.1f}")
        if most(name)[figure].is_exceeded(grown):
            grew.append(f"{name}: {figure} grows by {grown.per_hour:.1f} ± {grown.error:.1f} an hour")
    return grew


def main() -> int:
    """Print what was measured; 1 if something grows, or if it could not be measured to the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    minutes = parser.parse_args().minutes
    samples, ended = Samples(), []
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        try:
            measure(samples, run_dir, minutes)
        # What hours have brought is reported all the same.
        except (EndedError, AssertionError, subprocess.TimeoutExpired) as error:
            ended = [f"not measured to the end: {error}"]
        steps = service.learner_step(run_dir)
    print(f"{minutes:g} minutes, {steps} learner steps; after a third of the time as warm-up:\n")
    troubles = report(samples) + ended
    for name, noted in samples.threads.items():
        if came := new_threads(noted):
            print(f"{name}: threads that came: {came}")
    unknown = {name for name, _ in samples.points if base(name) not in {*OURS, *RAYS, "training"}}
    print("\nof no known kind: " + (", ".join(sorted(unknown)) or "none"))
    print("\n".join(troubles) or "nothing grows")
    return bool(troubles)


if __name__ == "__main__":
    sys.exit(main())
