"""`liir train` in a process of its own, seen from outside: by what it writes and which processes it has."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import psutil

from liir_common.config import holds_run
from liir_common.errors import LiirError
from liir_common.files import last_row, read_table

_POLL_S = 0.1
_FREE_PORTS = tuple(
    f"{key}=0"
    for key in ("learner.port", "learner.metrics_port", "actors.metrics_port", "evaluation.metrics_port")
)
_ENDED_AS_ASKED = 128 + signal.SIGTERM

Found = TypeVar("Found")


class Training:
    """A training under way."""

    def __init__(self, run_dir: Path, options: list[str]) -> None:
        """Start it; `options` are those of `liir train`."""
        self.run_dir = run_dir
        self._errors = run_dir.with_name(f"{run_dir.name}-errors.txt")
        command = [sys.executable, "-m", "liir_common.cli", "train", "--run-dir", str(run_dir), *options]
        self.begin = time.time()
        """When the command was given, as all times here in seconds since 1970."""
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)

    @property
    def ended(self) -> bool:
        """Whether it is over, well or not."""
        return self._process.poll() is not None

    @property
    def address(self) -> str:
        """HOST:PORT of the learner, once it serves."""
        return str(json.loads((self.run_dir / "endpoints.json").read_text())["address"])

    def processes(self, command: str) -> list[psutil.Process]:
        """Those with `command` in their command line, the oldest first."""
        children = [] if self.ended else psutil.Process(self._process.pid).children(recursive=True)
        return sorted((p for p in children if command in _command_line(p)), key=psutil.Process.create_time)

    def rows(self) -> list[dict[str, str]]:
        """One for each learner step so far."""
        return read_table(self.run_dir / "metrics.csv")

    def newest(self, column: str) -> float:
        """A figure of the newest learner step, 0 before the first."""
        row = last_row(self.run_dir / "metrics.csv")
        return float(row[column]) if row else 0.0

    def step_after(self, moment: float) -> dict[str, str]:
        """The row of the first learner step that ends after that time; waits for it."""
        self.wait(lambda: self.newest("time") > moment)
        return next(row for row in self.rows() if float(row["time"]) > moment)

    def event(self, name: str, after: float = 0.0, **fields: object) -> dict[str, Any]:
        """The learner's first log line of that event, with these fields, and its `time`; waits for it."""
        wanted = {"event": name, **fields}.items()
        after = max(after, self.begin)
        return self.wait(
            lambda: next(
                (line for line in self._log() if line["time"] > after and wanted <= line.items()), None
            )
        )

    def _log(self) -> Iterator[dict[str, Any]]:
        path = self.run_dir / "logs" / "learner.log"
        text = path.read_text(errors="replace") if path.exists() else ""
        for line in text[: text.rfind("\n") + 1].splitlines():
            if line.startswith("{"):  # else another library wrote it
                fields = json.loads(line)
                yield fields | {"time": datetime.fromisoformat(fields["timestamp"]).timestamp()}

    def wait(self, find: Callable[[], Found | None]) -> Found:
        """What `find` finds, as soon as that is true.

        Raises:
            LiirError: the training ended before.
        """
        while not (found := find()):
            if self.ended:
                raise self._failure()
            time.sleep(_POLL_S)
        return found

    def finish(self) -> None:
        """Let it train to its end.

        Raises:
            LiirError: it failed.
        """
        if self._process.wait():
            raise self._failure()

    def stop(self) -> None:
        """Ask it to end unless it has, and wait until then."""
        if not self.ended:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()

    def check(self) -> None:
        """See that it ended well, or as it was asked to.

        Raises:
            LiirError: it failed.
        """
        if self._process.returncode not in (0, _ENDED_AS_ASKED):
            raise self._failure()

    def _failure(self) -> LiirError:
        said = self._errors.read_text(errors="replace")
        return LiirError(f"the training ended with code {self._process.returncode}:\n{said}")


@contextmanager
def run_directory() -> Iterator[Path]:
    """Where a run can be, for as long as the block lasts."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / "run"


@contextmanager
def training(run_dir: Path, *settings: str) -> Iterator[Training]:
    """A training on free ports, asked to end with the block; a run that is there is resumed.

    Raises:
        LiirError: it failed.
    """
    options = ["--resume"] if holds_run(run_dir) else []
    options += [part for setting in (*_FREE_PORTS, *settings) for part in ("--set", setting)]
    watched = Training(run_dir, options)
    try:
        yield watched
    finally:
        watched.stop()
    watched.check()


def _command_line(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return ""
