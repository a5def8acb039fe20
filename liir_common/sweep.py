"""`liir sweep`: methods × maps × seeds from one YAML file, each run a `liir train` process with a directory
of its own.

What is finished is skipped, what was interrupted goes on, so the same command again completes a sweep; with
more environment steps it continues the runs that are there.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from types import FrameType
from typing import Any

import yaml
from pydantic import Field, ValidationError

from liir_common import results
from liir_common.checkpoint import given_up
from liir_common.config import Config, Section, differences, from_tree, holds_run, merge, parse_settings
from liir_common.errors import ConfigError
from liir_common.files import csv_text, last_row, read_table, write_atomic
from liir_common.launch import die_with_parent
from liir_common.rpc.tokens import VARIABLE

_POLL_S = 0.5
# Several runs share a machine, so every server takes a free port; and one run makes room for the next.
_TOGETHER = {
    "learner": {"port": 0, "metrics_port": 0, "stay": False},
    "actors": {"metrics_port": 0},
    "evaluation": {"metrics_port": 0},
}
_WHERE_IT_RUNS = ("actors", "checkpoints", "learner", "metrics", "security")
"""Sections that a run takes anew when it goes on, maybe on another machine or with less room."""


class SweepConfig(Section):
    """The YAML file; what comes later in this list is stronger."""

    base: dict[str, Any] = Field({})
    """Settings of every run."""
    maps: dict[str, dict[str, Any]] = Field(min_length=1)
    """Settings by map; the key is the map's name."""
    methods: dict[str, dict[str, Any]] = Field(min_length=1)
    """Settings by method; the key is the algorithm's name unless the settings say another (a control)."""
    seeds: list[int] = Field(min_length=1)


@dataclass(frozen=True)
class Run:
    """One run of a sweep."""

    map: str
    method: str
    seed: int
    config: Config

    @property
    def name(self) -> str:
        """Name of its directory."""
        return f"{self.map}-{self.method}-seed{self.seed}"


@dataclass(frozen=True)
class Outcome:
    """How a run of a sweep ended."""

    name: str
    status: str
    """complete; skipped because it was complete already; untested, trained to the end but with a checkpoint
    without its test, which a damaged one is until its file is restored; failed; stopped"""
    exit_code: int
    log: Path

    @property
    def failed(self) -> bool:
        """Whether the run is not complete."""
        return self.status in ("untested", "failed", "stopped")


def plan(
    path: Path,
    methods: Sequence[str] = (),
    maps: Sequence[str] = (),
    seeds: Sequence[int] = (),
    settings: Sequence[str] = (),
) -> list[Run]:
    """The runs of the sweep at `path`, or the part that is named; `settings` (key.sub=value) are strongest.

    The environment has no say, so that a sweep is what its file and command line say.

    Raises:
        ConfigError: the file is no sweep, a name is not in it, or a run's configuration cannot be used.
    """
    sweep = _read(path)
    over = parse_settings(settings)
    return [
        _resolve(sweep, map_name, method, seed, over)
        for map_name in _chosen("map", maps, sweep.maps)
        for method in _chosen("method", methods, sweep.methods)
        for seed in seeds or sweep.seeds
    ]


def _read(path: Path) -> SweepConfig:
    try:
        return SweepConfig.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError(f"cannot read the sweep {path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not YAML: {error}") from None
    except ValidationError as error:
        raise ConfigError(f"{path} is not a sweep of base, maps, methods and seeds: {error}") from None


def _chosen(kind: str, names: Sequence[str], known: Mapping[str, Any]) -> Sequence[str]:
    unknown = set(names) - known.keys()
    if unknown:
        raise ConfigError(f"unknown {kind} {', '.join(sorted(unknown))}; this sweep has {', '.join(known)}")
    return names or list(known)


def _resolve(sweep: SweepConfig, map_name: str, method: str, seed: int, over: Mapping[str, Any]) -> Run:
    named = {"seed": seed, "env": {"map": map_name}, "algorithm": {"name": method}}
    layers = [sweep.base, named, sweep.maps[map_name], sweep.methods[method], over, _TOGETHER]
    try:
        return Run(map_name, method, seed, from_tree(reduce(merge, layers, {})))
    except ConfigError as error:
        raise ConfigError(f"{method} on {map_name}: {error}") from None


class Sweep:
    """Runs the runs, some at a time."""

    def __init__(self, runs: Sequence[Run], output: Path) -> None:
        """Keep everything under `output`.

        Raises:
            ConfigError: a run directory there belongs to another configuration.
        """
        self._output = output
        self._runs = runs
        self._stop_signal = 0
        self._running: dict[str, tuple[Run, subprocess.Popen[bytes]]] = {}
        self._outcomes: list[Outcome] = []
        for folder in ("configs", "logs"):
            (output / folder).mkdir(parents=True, exist_ok=True)
        for run in runs:
            self._check(run)

    def run(self, jobs: int = 1) -> list[Outcome]:
        """Complete every run, `jobs` at once, in order; a failed one does not stop the others.

        results.csv and runs.csv are written anew whenever one ends, or if that cannot be, when the next does.
        A signal asks the runs to save and end; what had not begun is left out of the outcomes.
        """
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, self._on_signal)
        for run in self._runs:  # now, so that to begin one writes nothing but its log
            text = yaml.safe_dump(run.config.tree(), sort_keys=False)
            write_atomic(self._config(run), text.encode())
        waiting = deque(self._runs)
        try:
            while self._running or (waiting and not self._stop_signal):
                while waiting and len(self._running) < jobs and not self._stop_signal:
                    self._begin(waiting.popleft())
                self._collect()
                time.sleep(_POLL_S if self._running else 0)
        finally:
            self._ask_to_end()
        self._write()
        return self._outcomes

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self._stop_signal = signum
        self._ask_to_end()

    def _ask_to_end(self) -> None:
        for _, process in self._running.values():
            process.terminate()

    def _begin(self, run: Run) -> None:
        if is_complete(self._output / run.name, run.config):
            self._end(run, "skipped", 0)
            return
        resumed = holds_run(self._output / run.name)
        _say(f"{run.name} {'goes on' if resumed else 'begins'}")
        with self._log(run).open("ab") as file:
            process = subprocess.Popen(
                self._command(run, resumed),
                stdout=file,
                stderr=file,
                stdin=subprocess.DEVNULL,
                # The run's configuration is complete but for tokens: settings in variables are not for it.
                env={k: v for k, v in os.environ.items() if k == VARIABLE or not k.startswith("LIIR_")},
                process_group=0,
                preexec_fn=die_with_parent,
            )
        self._running[run.name] = run, process
        if self._stop_signal:  # which came before there was anybody to ask
            process.terminate()

    def _command(self, run: Run, resumed: bool) -> list[str]:
        tree = run.config.tree()
        anew = {key: tree[key] for key in _WHERE_IT_RUNS}
        anew["training"] = {"total_env_steps": run.config.training.total_env_steps}
        settings = [part for key, value in anew.items() for part in ("--set", f"{key}={json.dumps(value)}")]
        source = ["--resume", *settings] if resumed else ["--config", str(self._config(run))]
        return [
            sys.executable,
            "-m",
            "liir_common.cli",
            "train",
            "--run-dir",
            str(self._output / run.name),
            *source,
        ]

    def _collect(self) -> None:
        """Take in the runs that ended."""
        for name, (run, process) in list(self._running.items()):
            code = process.poll()
            if code is not None:
                del self._running[name]
                self._end(run, self._status(run, code), code)
                try:
                    self._write()
                except OSError as error:  # the next to end brings all of it, and the others train meanwhile
                    _say(f"results.csv and runs.csv are not as new as the runs: {error}")

    def _status(self, run: Run, code: int) -> str:
        if code == 0:
            return "complete" if is_complete(self._output / run.name, run.config) else "untested"
        return "stopped" if self._stop_signal else "failed"

    def _end(self, run: Run, status: str, code: int) -> None:
        outcome = Outcome(run.name, status, code, self._log(run))
        self._outcomes.append(outcome)
        _say(f"{run.name} {status}" + (f" (exit code {code}); see {outcome.log}" if outcome.failed else ""))

    def _write(self) -> None:
        """Gather every run of the plan that has begun, whenever it ran, beside the sweep's other parts."""
        begun = [run for run in self._runs if holds_run(self._output / run.name)]
        rows = [row for run in begun for row in results.rows(self._output / run.name, run.method, run.map)]
        self._replace_rows("results.csv", rows, results.COLUMNS)
        status = [self._row(run) for run in self._runs]
        self._replace_rows("runs.csv", status, list(status[0]))

    def _replace_rows(self, name: str, rows: list[dict[str, Any]], columns: Sequence[str]) -> None:
        planned = {run.name for run in self._runs}
        kept = [row for row in read_table(self._output / name) if row["run"] not in planned]
        # An earlier build's file may have a column more.
        others = [{column: row[column] for column in columns} for row in kept]
        write_atomic(self._output / name, csv_text([*others, *rows], columns).encode())

    def _row(self, run: Run) -> dict[str, Any]:
        ended = {outcome.name: outcome.status for outcome in self._outcomes}.get(run.name)
        run_dir = self._output / run.name
        complete = is_complete(run_dir, run.config)
        begun = "begun" if holds_run(run_dir) else "waiting"
        last = last_row(run_dir / "metrics.csv")
        return {
            "run": run.name,
            "method": run.method,
            "map": run.map,
            "seed": run.seed,
            "config_digest": results.config_digest(run.config.tree()),
            "status": "complete" if complete else ended or begun,
            "env_steps": int(last["env_steps"]) if last else 0,
            "total_env_steps": run.config.training.total_env_steps,
        }

    def _config(self, run: Run) -> Path:
        return self._output / "configs" / f"{run.name}.yaml"

    def _log(self, run: Run) -> Path:
        return self._output / "logs" / f"{run.name}.log"

    def _check(self, run: Run) -> None:
        if not holds_run(self._output / run.name):
            return
        kept = self._output / run.name / "config.yaml"
        there = from_tree(yaml.safe_load(kept.read_text(encoding="utf-8")))
        differ = differences(results.what_matters(there.tree()), results.what_matters(run.config.tree()))
        if run.config.training.total_env_steps > there.training.total_env_steps:
            del differ["training.total_env_steps"]  # the run goes on
        if differ:
            raise ConfigError(
                f"{kept.parent} was trained with other settings ({'; '.join(differ.values())}); name another "
                "--output, or move it away to train anew"
            )


def is_complete(run_dir: Path, config: Config) -> bool:
    """Whether the run has all its environment steps and, if it tests its checkpoints, all their tests.

    A checkpoint that is lost and given up wants none.
    """
    last = last_row(run_dir / "metrics.csv")
    if not last or int(last["env_steps"]) < config.training.total_env_steps:
        return False
    if not config.evaluation.enabled:
        return True
    frozen = int(last["episodes"]) // config.training.checkpoint_interval
    tested = {int(row["episode"]) for row in read_table(run_dir / "evaluations.csv")}
    return len(tested | given_up(run_dir / "checkpoints")) == frozen


def _say(line: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)
