"""The run directory: everything a run leaves on disk, and what it needs to go on.

config.yaml      the resolved configuration
run.json         run id, build, environment, parameter counts
endpoints.json   where the learner listens, or did last
state/           the learner's own state at the last saves, and the replay if the method has one
checkpoints/     frozen checkpoints
metrics.csv      one row per learner step
evaluations.csv  one row per tested checkpoint
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import structlog
import yaml
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from liir_common.build import build, git_commit
from liir_common.checkpoint import CheckpointStore
from liir_common.config import Config
from liir_common.errors import ConfigError, CorruptError
from liir_common.files import Table, check_digest, remove_leftovers, write_atomic, write_digested
from liir_common.types import Array, EnvSpec
from services.learner.evaluations import Evaluations
from services.learner.replay_store import ReplayStore

log = structlog.get_logger()


@dataclass(frozen=True)
class Counters:
    """How far a run is."""

    learner_step: int = 0
    env_steps: int = 0
    episodes: int = 0


class RunDirectory:
    """One run on disk; the learner owns it."""

    def __init__(self, path: Path, config: Config, spec: EnvSpec) -> None:
        """Begin a run at `path`, or go on with the one that is there.

        Raises:
            ConfigError: the run that is there plays another environment.
            CorruptError: its record is damaged.
        """
        self.path = path
        self.config = config
        self.spec = spec
        for folder in (path, path / "state", path / "checkpoints"):
            folder.mkdir(parents=True, exist_ok=True)
            remove_leftovers(folder)
        if not (path / "run.json").exists():
            self._write_json("run.json", {"run_id": uuid.uuid4().hex, "created": time.time()})
        record = self._read_record()
        if record.get("env_spec_hash", spec.hash) != spec.hash:
            raise ConfigError(
                f"{path} was trained on {record['env_spec']}, this build and configuration play "
                f"{asdict(spec)}; resume with the simulator and env section that began it"
            )
        self.run_id: str = record["run_id"]
        self.created: float = record["created"]
        self._write_json(
            "run.json",
            record
            | {"env_spec_hash": spec.hash, "env_spec": asdict(spec), "build": build(), "git": git_commit()},
        )
        write_atomic(path / "config.yaml", yaml.safe_dump(config.tree(), sort_keys=False).encode())
        self.checkpoints = CheckpointStore(str(path / "checkpoints"))
        self.checkpoints.remove_leftovers()
        self.replay = ReplayStore(path / "state")
        self.metrics = Table(path / "metrics.csv")
        self.evaluations = Evaluations(Table(path / "evaluations.csv"), self.created)

    def write_parameters(self, counts: Mapping[str, int]) -> None:
        """Record how many parameters each network has."""
        self._write_json("run.json", self._read_record() | {"parameters": dict(counts)})

    def write_endpoints(self, endpoints: Mapping[str, Any]) -> None:
        """Say where this learner listens, for whoever starts the other processes."""
        self._write_json("endpoints.json", {**endpoints, "pid": os.getpid()})

    def save_state(self, counters: Counters, arrays: Mapping[str, Array], notes: Mapping[str, Any]) -> None:
        """Keep what the learner needs to go on after `counters.learner_step`, and the state before it."""
        metadata = {"counters": json.dumps(asdict(counters)), "notes": json.dumps(notes)}
        name = f"state-{counters.learner_step:09d}.safetensors"
        new = write_digested(self.path / "state" / name, save(dict(arrays), metadata))
        before = [path for path in self._state_paths() if _step(path) < counters.learner_step]
        # A later one is damaged, or the run would have gone on from it.
        for path in {*self._state_paths()} - {new, *before[-1:]}:
            path.unlink()

    @property
    def oldest_state_step(self) -> int:
        """Learner step of the oldest state that is kept; 0 if there is none."""
        paths = self._state_paths()
        return _step(paths[0]) if paths else 0

    def load_state(self) -> tuple[Counters, dict[str, Array], dict[str, Any]] | None:
        """The newest state that can be read, or nothing if the run never saved one.

        Raises:
            CorruptError: there are states, and none of them can be read.
        """
        paths = self._state_paths()
        for path in reversed(paths):
            try:
                check_digest(path)
                with safe_open(path, framework="np") as file:
                    metadata = file.metadata()
                    arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                counters = Counters(**json.loads(metadata["counters"]))
                return counters, arrays, json.loads(metadata["notes"])
            except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
                log.error(
                    "a saved state cannot be read; trying the one before", path=str(path), error=str(error)
                )
        if paths:
            raise CorruptError(
                f"no state under {self.path / 'state'} can be read; restore one from a backup, or remove "
                "them all to train from the start"
            )
        return None

    def _read_record(self) -> dict[str, Any]:
        path = self.path / "run.json"
        try:
            record = json.loads(path.read_text())
        except ValueError as error:
            raise CorruptError(f"{path} is damaged ({error}); restore it from a backup") from error
        if not isinstance(record, dict) or not {"run_id", "created"} <= record.keys():
            raise CorruptError(f"{path} is damaged (no run_id or created); restore it from a backup")
        return record

    def _state_paths(self) -> list[Path]:
        return sorted((self.path / "state").glob("state-*.safetensors"))

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        write_atomic(self.path / name, json.dumps(value, indent=1).encode())


def _step(state: Path) -> int:
    """Learner step in a state's name, `state-STEP-DIGEST`."""
    return int(state.stem.split("-")[1])
