"""Runs the real service for tests: `liir` commands in processes of their own, on free ports."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil

from liir_common.checkpoint import CheckpointStore
from liir_common.client import TrainingClient
from liir_common.config import Config, load

LIIR = str(Path(sys.executable).with_name("liir"))
TIMEOUT_S = 180.0
SMALL = (
    "seed=7",
    "actors.count=2",
    "training.batch_episodes=8",
    "training.total_env_steps=6000",
    "training.checkpoint_interval=20",
    "training.save_interval=3",
    "evaluation.episodes=2",
    "learner.port=0",
    "learner.metrics_port=0",
    "actors.metrics_port=0",
    "evaluation.metrics_port=0",
)
"""A run of some thirty learner steps, about ten seconds with the start.

Its seed is not the default, so that a process which takes another one is noticed.
"""


def arguments(settings: Sequence[str]) -> list[str]:
    """`--set` for each setting of the small run and those given, which are stronger."""
    return [part for setting in (*SMALL, *settings) for part in ("--set", setting)]


def start(command: str, *rest: str) -> subprocess.Popen[str]:
    """Start `liir COMMAND …`; its output can be read when it has ended."""
    return subprocess.Popen(
        [LIIR, command, *rest],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str], code: int = 0, timeout_s: float = TIMEOUT_S) -> str:
    """Wait for the end with the wanted exit code; returns the output."""
    try:
        output, _ = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=30)
        raise AssertionError(f"did not end within {timeout_s:g} s:\n{output}") from None
    assert process.returncode == code, f"ended with {process.returncode}, wanted {code}:\n{output}"
    return output


def train(run_dir: Path, *settings: str, options: Sequence[str] = ()) -> str:
    """Train to the end; returns the output."""
    return finish(start("train", "--run-dir", str(run_dir), *options, *arguments(settings)))


@contextmanager
def training(run_dir: Path, *settings: str, options: Sequence[str] = ()) -> Iterator[subprocess.Popen[str]]:
    """A training under way; ended if the test did not end it."""
    process = start("train", "--run-dir", str(run_dir), *options, *arguments(settings))
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=60)


def wait_for(condition: Callable[[], bool], what: str, timeout_s: float = 120.0) -> None:
    """Poll until `condition` holds."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen within {timeout_s:g} s"
        time.sleep(0.02)


def free_port() -> int:
    """A port that nobody listens on, for programs that cannot say which one they took."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def learner_step(run_dir: Path) -> int:
    """The newest learner step of a run."""
    path = run_dir / "metrics.csv"
    return max(0, len(path.read_text().splitlines()) - 1) if path.exists() else 0


def endpoints(run_dir: Path) -> dict[str, str]:
    """Where the learner of a run listens."""
    return json.loads((run_dir / "endpoints.json").read_text())  # type: ignore[no-any-return]


def page(url: str) -> str:
    """What is at an address."""
    return urllib.request.urlopen(url, timeout=30).read().decode()  # type: ignore[no-any-return]


def samples(url: str) -> dict[str, float]:
    """Samples of a /metrics page, by name with labels."""
    lines = [line.rpartition(" ") for line in page(url).splitlines() if not line.startswith("#")]
    return {name: float(value) for name, _, value in lines}


def descendants(process: subprocess.Popen[str] | psutil.Process, command: str) -> list[psutil.Process]:
    """Processes under `process` whose command line contains `command`."""
    found = []
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            if command in " ".join(child.cmdline()):
                found.append(child)
        except (psutil.NoSuchProcess, psutil.ZombieProcess):
            continue
    return found


def kill(victim: psutil.Process) -> None:
    """SIGKILL: no goodbye."""
    os.kill(victim.pid, signal.SIGKILL)


def digests(run_dir: Path) -> dict[int, str]:
    """SHA-256 of every checkpoint's weights, by episode."""
    store = CheckpointStore(str(run_dir / "checkpoints"))
    return {manifest.episode: manifest.sha256 for manifest in store.manifests}


def config(*settings: str) -> Config:
    """The configuration of a small run."""
    return load(None, (*SMALL, *settings))


def client(run_dir: Path) -> TrainingClient:
    """A client of the learner of a run."""
    return TrainingClient(endpoints(run_dir)["address"])
