"""`liir train`: learner, actors and evaluator as processes, started, watched, ended."""

from __future__ import annotations

import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import grpc
import structlog
from rich.console import Console

from liir_common import options
from liir_common.client import CheckpointClient, TrainingClient
from liir_common.config import Config, SecurityConfig, holds_run
from liir_common.display import Display, WinRates, make_display, phase_name
from liir_common.errors import (
    ConfigError,
    CorruptError,
    DivergedError,
    LiirError,
    RefusedError,
    StorageError,
    UnreachableError,
    meaning,
    storage_explained,
)
from liir_common.report import print_summary, write_report
from liir_common.rpc.tokens import Role

log = structlog.get_logger()

_POLL_S = 0.25
_START_S = 120.0
_STOP_S = 60.0
END_S = 10.0
_HOME_S = 10.0
"""For which actors and evaluator, sent home by a learner that ends, may be gone before it."""
_RESTARTS, _RESTARTS_WITHIN_S = 3, 300.0
_PR_SET_PDEATHSIG = 1
_LAST_LINES, _LAST_BYTES = 5, 65_536
_IN_VAIN = tuple(
    kind.exit_code for kind in (ConfigError, CorruptError, RefusedError, StorageError, DivergedError)
)
"""Codes of processes that would only end in the same way again."""
_EVENT = re.compile(r'"event": "([^"]*)"')
_EXCEPTION = re.compile(r"^(?:error: |[\w.]*(?:Error|Exception)\b).*$", re.MULTILINE)
"""The line of a log that has the type and the message, as `exit_on_error` or Python writes it."""


class Service(ABC):
    """One process of the run, wherever it is."""

    phase: str = ""
    """What it said last that it was doing; only the learner is asked."""
    silent_phase: str = "starting"
    """Its phase if its log names none."""

    def __init__(self, name: str, arguments: Sequence[str], run_dir: Path, log_name: str = "") -> None:
        """Prepare `python -m services.NAME ARGUMENTS`; its log is a file in the run directory."""
        self.name = name
        self.arguments = list(arguments)
        self.run_dir = run_dir
        self.log_path = run_dir / "logs" / f"{log_name or name}.log"
        self._restarts: deque[float] = deque(maxlen=_RESTARTS)

    @abstractmethod
    def start(self) -> None:
        """Start it, or start it again."""

    @property
    @abstractmethod
    def exit_code(self) -> int | None:
        """None while it runs."""

    @abstractmethod
    def address(self) -> str | None:
        """HOST:PORT that it serves at, once it does; only a learner ever does."""

    @abstractmethod
    def end(self) -> None:
        """Ask it to end, and insist after a while."""

    @abstractmethod
    def last_words(self) -> str:
        """The end of its log since it was started last."""

    def obituary(self) -> str:
        """How it ended, its last phase and exception, and the end of its log."""
        code, words = self.exit_code or 0, self.last_words()
        how = signal.Signals(-code).name if code < 0 else meaning(code)
        phase = self.phase or (_EVENT.findall(words) or [self.silent_phase])[-1]
        exception = (_EXCEPTION.findall(words) or ["none in its log"])[-1]
        lines = [line for line in words.splitlines() if line != exception][-_LAST_LINES:]
        rest = "\n".join(["ends with", *lines]) if lines else "has no more"
        return (
            f"the {self.name} ended with code {code} ({how}) in the phase {phase!r}; "
            f"last exception: {exception.removeprefix('error: ')}; {self.log_path} {rest}"
        )

    def may_restart(self) -> bool:
        """Whether another start makes sense: not after several deaths in a short time."""
        if self.exit_code == UnreachableError.exit_code:  # which is another's fault, and took a while
            return True
        now = time.monotonic()
        if len(self._restarts) == _RESTARTS and now - self._restarts[0] < _RESTARTS_WITHIN_S:
            return False
        self._restarts.append(now)
        return True


class LocalService(Service):
    """A child of this process."""

    _process: subprocess.Popen[bytes] | None = None
    _log_begin: int = 0
    """Where in the log the present incarnation begins."""

    @property
    def command(self) -> list[str]:
        """What starts it."""
        return [sys.executable, "-m", f"services.{self.name}", *self.arguments]

    def start(self) -> None:
        """Start it in a process group of its own, so that Ctrl-C reaches only the launcher."""
        with storage_explained(self.run_dir):
            self.log_path.parent.mkdir(parents=True, exist_ok=True)
            log_file = self.log_path.open("ab")
        with log_file as file:
            self._log_begin = file.tell()
            self._process = subprocess.Popen(
                self.command,
                stdout=file,
                stderr=file,
                stdin=subprocess.DEVNULL,
                process_group=0,
                preexec_fn=die_with_parent,
            )

    @property
    def exit_code(self) -> int | None:
        """None while it runs, and before."""
        return self._process.poll() if self._process else None

    def address(self) -> str | None:
        """HOST:PORT that it serves at, once it does; not what an earlier one has left."""
        path = self.run_dir / "endpoints.json"
        if self._process is None or not path.exists():
            return None
        endpoints = json.loads(path.read_text())
        return str(endpoints["address"]) if endpoints["pid"] == self._process.pid else None

    def end(self) -> None:
        """Ask it to end, and insist after a while."""
        if self._process is None or self._process.poll() is not None:
            return
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            log.warning("does not end when asked; killed", service=self.name)
            self._process.kill()
            self._process.wait()

    def last_words(self) -> str:
        """The end of its log since it was started last."""
        with self.log_path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(self._log_begin, size - _LAST_BYTES))
            return file.read().decode(errors="replace")


def as_settings(security: SecurityConfig) -> list[str]:
    """Arguments that give a process these files and no others; JSON strings are YAML."""
    files = security.model_dump().items()
    return [part for key, path in files for part in ("--set", f"security.{key}={json.dumps(path)}")]


def die_with_parent() -> None:
    """In a child on Linux: get SIGTERM when the launcher dies, however it dies."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Launcher:
    """The whole service, from start to end."""

    def __init__(
        self,
        run_dir: Path,
        learner: Service,
        actors: Service,
        evaluator: Service,
        security: SecurityConfig,
    ) -> None:
        """Prepare to run these processes; `security` is for clients of the learner."""
        self._run_dir = run_dir
        self._learner = learner
        self._actors = actors
        self._evaluator = evaluator
        self._security = security
        self._stop_signal = 0
        self._gone_since: dict[str, float] = {}

    def run(self, evaluate: bool) -> None:
        """Train until the run is complete or a signal asks to stop.

        Raises:
            LiirError: a process cannot be kept running; the message says how it ended.
        """
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, self._on_signal)
        with ExitStack() as last_first:  # where one fails, the others still end
            for service in (self._learner, self._actors, self._evaluator):
                last_first.callback(service.end)
            if address := self._start(evaluate):
                self._watch(address)

    @property
    def stop_signal(self) -> int:
        """The signal that ended training early, or 0."""
        return self._stop_signal

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self._stop_signal = signum

    def _start(self, evaluate: bool) -> str | None:
        """Start all; where the learner serves, or None if a signal asked to stop before it did."""
        self._learner.start()
        address = self._wait_for_learner()
        if address is None:
            return None
        # A learner that is started again must be found where it was.
        self._learner.arguments += ["--set", f"learner.port={address.rpartition(':')[2]}"]
        if "--resume" not in self._learner.arguments:
            self._learner.arguments.append("--resume")
        for service in (self._actors, self._evaluator) if evaluate else (self._actors,):
            service.arguments += ["--learner", address]
            service.start()
        return address

    def _wait_for_learner(self) -> str | None:
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline:
            if self._stop_signal:
                return None
            if address := self._learner.address():
                return address
            if self._learner.exit_code is not None:
                self._raise_death(self._learner)
            time.sleep(_POLL_S / 5)
        raise LiirError(
            f"the learner did not start within {_START_S:g} s; {self._learner.log_path} says what it does"
        )

    def _watch(self, address: str) -> None:
        console = Console(stderr=True)
        display = make_display(f"LIIR · {self._run_dir}", console)
        win_rates = WinRates()
        try:
            with (
                TrainingClient(address, security=self._security, role=Role.OPERATOR) as training,
                CheckpointClient(address, security=self._security, role=Role.OPERATOR) as checkpoints,
            ):
                while not self._stop_signal and self._learner.exit_code != 0:
                    self._revive()
                    self._show(display, training, checkpoints, win_rates)
                    time.sleep(_POLL_S)
                if self._stop_signal:
                    self._stop(training)
        except UnreachableError:
            # The learner of a run that was complete already may be gone before anybody can connect.
            if self._learner.exit_code != 0:
                raise
        finally:
            display.close()

    def _show(
        self,
        display: Display,
        training: TrainingClient,
        checkpoints: CheckpointClient,
        win_rates: WinRates,
    ) -> None:
        try:
            seen = win_rates.newest[-1].episode if win_rates.newest else 0
            for evaluation in checkpoints.evaluations(seen):
                win_rates.add(evaluation)
            status = training.status()
            self._learner.phase = phase_name(status)
            display.show(status, win_rates)
        except grpc.RpcError as error:
            log.info("the learner does not answer", reason=error.details())

    def _revive(self) -> None:
        """Start again what died; the run goes on as if nothing had happened."""
        for service in (self._learner, self._actors, self._evaluator):
            code = service.exit_code
            if code is None or (code == 0 and not self._left_early(service)):
                continue
            if code in _IN_VAIN or not service.may_restart():
                self._raise_death(service)
            log.error("a process died; it is started again", reason=service.obituary())
            service.phase = ""
            service.start()
            self._gone_since.pop(service.name, None)

    def _left_early(self, service: Service) -> bool:
        """Whether one that ended in peace is missed: the learner, which sends the others home, goes on."""
        gone = time.monotonic() - self._gone_since.setdefault(service.name, time.monotonic())
        return service is not self._learner and self._learner.exit_code is None and gone > _HOME_S

    def _stop(self, training: TrainingClient) -> None:
        try:
            training.stop(f"signal {signal.Signals(self._stop_signal).name}")
        except grpc.RpcError as error:
            log.info("the learner does not answer; told by signal to end", reason=error.details())
            self._learner.end()
        deadline = time.monotonic() + _STOP_S
        while self._learner.exit_code is None:
            if time.monotonic() > deadline:
                log.warning("the learner did not end in time", timeout_s=_STOP_S)
                return
            time.sleep(_POLL_S)
        if self._learner.exit_code:
            self._raise_death(self._learner)

    def _raise_death(self, service: Service) -> None:
        error = LiirError(service.obituary())
        error.exit_code = service.exit_code or 1
        raise error


@dataclass(frozen=True)
class Request:
    """What `liir train` was asked for."""

    run_dir: Path
    config: Config
    file: Path | None
    settings: Sequence[str]
    resume: bool


def train(
    command: str,
    make_launcher: Callable[[Request], Launcher],
    file: Path | None,
    settings: Sequence[str],
    run_dir: Path | None,
    resume: bool,
) -> None:
    """Train with the launcher that is made for the request, and write and print the report.

    `command` is what a person writes to train in this way.

    Raises:
        LiirError: the run cannot begin, or not go on.
    """
    run_dir = run_dir or (_newest_run() if resume else None)
    config = options.load_run_config(file, list(settings), run_dir, resume)
    run_dir = run_dir or Path("runs") / _run_name(config)
    launcher = make_launcher(Request(run_dir, config, file, settings, resume))
    launcher.run(config.evaluation.enabled)
    if launcher.stop_signal and not holds_run(run_dir):  # before there was anything to go on with
        raise SystemExit(128 + launcher.stop_signal)
    with storage_explained(run_dir):
        summary = write_report(run_dir)
    print_summary(run_dir, summary)
    complete = summary.env_steps >= config.training.total_env_steps
    if not complete or (launcher.stop_signal and not config.learner.stay):
        print(f"stopped early; go on with: {command} --resume --run-dir {run_dir}", file=sys.stderr)
    if launcher.stop_signal:
        raise SystemExit(128 + launcher.stop_signal)


def _run_name(config: Config) -> str:
    now = time.strftime("%Y%m%d-%H%M%S")
    return f"{config.env.label}-{config.algorithm.name}-seed{config.seed}-{now}"


def _newest_run() -> Path:
    # What has no step has nothing to go on with: its start may have failed, at a port that was taken.
    runs = sorted(Path("runs").glob("*/metrics.csv"), key=lambda path: path.stat().st_mtime)
    if not runs:
        raise ConfigError("there is no run under runs/ with a step to go on from; name one with --run-dir")
    return runs[-1].parent


def local(request: Request) -> Launcher:
    """A launcher of processes of this machine, which share the run's files of `security`."""
    source = ["--config", str(request.file)] if request.file and not request.resume else []
    arguments = ["--run-dir", str(request.run_dir), *source, *(["--resume"] if request.resume else [])]
    arguments += [part for setting in request.settings for part in ("--set", setting)]
    client = as_settings(request.config.security)
    return Launcher(
        request.run_dir,
        LocalService("learner", arguments, request.run_dir),
        LocalService("actor", client, request.run_dir, "actors"),
        LocalService("evaluator", client, request.run_dir),
        request.config.security,
    )
