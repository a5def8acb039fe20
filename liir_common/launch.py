"""`liir train`: learner, actors and evaluator as processes of this machine, started, watched, ended."""

from __future__ import annotations

import ctypes
import json
import re
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import grpc
import structlog
from rich.console import Console

from liir_common.client import CheckpointClient, TrainingClient
from liir_common.config import SecurityConfig
from liir_common.display import Display, make_display, phase_name
from liir_common.errors import (
    ConfigError,
    LiirError,
    RefusedError,
    StorageError,
    UnreachableError,
    meaning,
    storage_explained,
)
from liir_common.report import Summary, write_report
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
from liir_common.rpc.tokens import Role

log = structlog.get_logger()

_POLL_S = 0.25
_START_S = 120.0
_STOP_S = 60.0
_RESTARTS, _RESTARTS_WITHIN_S = 3, 300.0
_PR_SET_PDEATHSIG = 1
_LAST_LINES = 5
_IN_VAIN = (ConfigError.exit_code, RefusedError.exit_code, StorageError.exit_code)
"""Codes of processes that would only end in the same way again."""
_EVENT = re.compile(r'"event": "([^"]*)"')
_EXCEPTION = re.compile(r"^(?:error: |[\w.]*(?:Error|Exception)\b).*$", re.MULTILINE)
"""The line of a log that has the type and the message, as `exit_on_error` or Python writes it."""


@dataclass
class Service:
    """One process of the run; its log is a file in the run directory."""

    name: str
    arguments: list[str]
    log_path: Path
    process: subprocess.Popen[bytes] | None = None
    restarts: deque[float] = field(default_factory=lambda: deque(maxlen=_RESTARTS))
    phase: str = ""
    """What it said last that it was doing; only the learner is asked."""
    _log_begin: int = 0
    """Where in the log the present incarnation begins."""

    @property
    def command(self) -> list[str]:
        """What starts it."""
        return [sys.executable, "-m", f"services.{self.name}", *self.arguments]

    def start(self) -> None:
        """Start it in a process group of its own, so that Ctrl-C reaches only the launcher."""
        self.phase = ""
        with self.log_path.open("ab") as file:
            self._log_begin = file.tell()
            self.process = subprocess.Popen(
                self.command,
                stdout=file,
                stderr=file,
                stdin=subprocess.DEVNULL,
                process_group=0,
                preexec_fn=die_with_parent,
            )

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self.process.poll() if self.process else None

    def end(self, timeout_s: float = 10.0) -> None:
        """Ask it to end, and insist after a while."""
        if self.process is None or self.process.poll() is not None:
            return
        self.process.terminate()
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            log.warning("does not end when asked; killed", service=self.name)
            self.process.kill()
            self.process.wait()

    def obituary(self) -> str:
        """How it ended, its last phase and exception, and the end of its log."""
        code = self.exit_code or 0
        how = signal.Signals(-code).name if code < 0 else meaning(code)
        log_text = self.log_path.read_bytes()[self._log_begin :].decode(errors="replace")
        phase = self.phase or (_EVENT.findall(log_text) or ["starting"])[-1]
        exceptions = _EXCEPTION.findall(log_text) or ["none in its log"]
        lines = "\n".join(log_text.splitlines()[-_LAST_LINES:])
        return (
            f"the {self.name} ended with code {code} ({how}) in the phase {phase!r}; "
            f"last exception: {exceptions[-1]}; {self.log_path} ends with\n{lines}"
        )

    def may_restart(self) -> bool:
        """Whether another start makes sense: not after several deaths in a short time."""
        now = time.monotonic()
        if len(self.restarts) == _RESTARTS and now - self.restarts[0] < _RESTARTS_WITHIN_S:
            return False
        self.restarts.append(now)
        return True


def _as_settings(security: SecurityConfig) -> list[str]:
    """Arguments that give a process the same files; JSON strings are YAML."""
    files = security.model_dump(exclude_defaults=True)
    return [part for key, path in files.items() for part in ("--set", f"security.{key}={json.dumps(path)}")]


def die_with_parent() -> None:
    """In a child on Linux: get SIGTERM when the launcher dies, however it dies."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Launcher:
    """The whole service on one machine, from start to summary."""

    def __init__(
        self, run_dir: Path, learner_arguments: Sequence[str], resume: bool, security: SecurityConfig
    ) -> None:
        """Prepare to run in `run_dir`; the arguments are those of `liir learner`."""
        self._run_dir = run_dir
        self._security = security
        logs = run_dir / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        arguments = ["--run-dir", str(run_dir), *learner_arguments]
        self._learner = Service(
            "learner", [*arguments, *(["--resume"] if resume else [])], logs / "learner.log"
        )
        self._actors = Service("actor", [], logs / "actors.log")
        self._evaluator = Service("evaluator", [], logs / "evaluator.log")
        self._stop_signal = 0

    def run(self, evaluate: bool) -> Summary:
        """Train until the run is complete or a signal asks to stop; the summary is of what there is then.

        Raises:
            LiirError: a process cannot be kept running; the message says how it ended.
        """
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, self._on_signal)
        try:
            address = self._start(evaluate)
            self._watch(address)
        finally:
            for service in (self._evaluator, self._actors, self._learner):
                service.end()
        with storage_explained(self._run_dir):
            return write_report(self._run_dir)

    @property
    def stop_signal(self) -> int:
        """The signal that ended training early, or 0."""
        return self._stop_signal

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self._stop_signal = signum

    def _start(self, evaluate: bool) -> str:
        (self._run_dir / "endpoints.json").unlink(missing_ok=True)
        self._learner.start()
        address = self._wait_for_endpoints()
        # A learner that is started again must be found where it was.
        self._learner.arguments += ["--set", f"learner.port={address.rpartition(':')[2]}"]
        if "--resume" not in self._learner.arguments:
            self._learner.arguments.append("--resume")
        for service in (self._actors, self._evaluator) if evaluate else (self._actors,):
            service.arguments += ["--learner", address, *_as_settings(self._security)]
            service.start()
        return address

    def _wait_for_endpoints(self) -> str:
        path = self._run_dir / "endpoints.json"
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline:
            if path.exists():
                return str(json.loads(path.read_text())["address"])
            if self._learner.exit_code is not None:
                self._raise_death(self._learner)
            time.sleep(_POLL_S / 5)
        raise LiirError(
            f"the learner did not start within {_START_S:g} s; {self._learner.log_path} says what it does"
        )

    def _watch(self, address: str) -> None:
        console = Console(stderr=True)
        display = make_display(f"LIIR · {self._run_dir}", console)
        shown: list[checkpoint_pb2.Evaluation] = []
        try:
            with (
                TrainingClient(address, security=self._security, role=Role.OPERATOR) as training,
                CheckpointClient(address, security=self._security, role=Role.OPERATOR) as checkpoints,
            ):
                while not self._stop_signal and self._learner.exit_code != 0:
                    self._revive()
                    self._show(display, training, checkpoints, shown)
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
        shown: list[checkpoint_pb2.Evaluation],
    ) -> None:
        try:
            shown.extend(checkpoints.evaluations(shown[-1].episode if shown else 0))
            status = training.status()
            self._learner.phase = phase_name(status)
            display.show(status, shown)
        except grpc.RpcError as error:
            log.info("the learner does not answer", reason=error.details())

    def _revive(self) -> None:
        """Start again what died; the run goes on as if nothing had happened."""
        for service in (self._learner, self._actors, self._evaluator):
            code = service.exit_code
            if code in (None, 0):
                continue
            if code in _IN_VAIN or not service.may_restart():
                self._raise_death(service)
            log.error("a process died; it is started again", reason=service.obituary())
            service.start()

    def _stop(self, training: TrainingClient) -> None:
        assert self._learner.process is not None
        try:
            training.stop(f"signal {signal.Signals(self._stop_signal).name}")
        except grpc.RpcError as error:
            log.info("the learner does not answer; told by signal to end", reason=error.details())
            self._learner.process.terminate()
        try:
            self._learner.process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            log.warning("the learner did not end in time", timeout_s=_STOP_S)
        if self._learner.exit_code:
            self._raise_death(self._learner)

    def _raise_death(self, service: Service) -> None:
        error = LiirError(service.obituary())
        error.exit_code = service.exit_code or 1
        raise error
