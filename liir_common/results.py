"""Results as one tidy table: a row per tested checkpoint, whatever run it is from."""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from liir_common.config import EnvConfig, holds_run
from liir_common.errors import ConfigError
from liir_common.files import read_table

_COPIED = (
    "greedy_wins",
    "greedy_episodes",
    "greedy_win_rate",
    "sampled_wins",
    "sampled_episodes",
    "sampled_win_rate",
)
COLUMNS = ("run", "method", "map", "seed", "commit", "config_digest", "episode", "env_steps", *_COPIED)
"""Columns of a results file, written in this order; a file may have more."""


def what_matters(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a configuration that the numbers depend on, the seed left out.

    Where a run listens, on what machines it plays and on how many actors, changes nothing.
    """
    evaluation = {key: value for key, value in tree["evaluation"].items() if key != "metrics_port"}
    return {section: tree[section] for section in ("env", "algorithm", "training")} | {
        "evaluation": evaluation
    }


def config_digest(tree: Mapping[str, Any]) -> str:
    """First 12 hex digits of the SHA-256 of `what_matters`: equal for the seeds of one experiment."""
    return hashlib.sha256(json.dumps(what_matters(tree), sort_keys=True).encode()).hexdigest()[:12]


def method_label(algorithm: Mapping[str, Any]) -> str:
    """Name of the method that the `algorithm` section configures, its control named with it."""
    controls = {"λ = 0": algorithm["lambda"] == 0, "η frozen": algorithm["freeze_eta"]}
    chosen = [name for name, on in controls.items() if on and algorithm["name"] == "liir"]
    return ", ".join([algorithm["name"], *chosen])


def rows(run_dir: Path, method: str = "", map_name: str = "") -> list[dict[str, Any]]:
    """The rows of one run, by episode; `method` and `map_name` replace what its configuration calls them.

    Raises:
        ConfigError: there is no run.
    """
    about = identity(run_dir, method, map_name)
    tests = sorted(read_table(run_dir / "evaluations.csv"), key=lambda row: int(row["episode"]))
    copied = ("episode", "env_steps", *_COPIED)
    return [about | {column: test[column] for column in copied} for test in tests]


def identity(run_dir: Path, method: str = "", map_name: str = "") -> dict[str, Any]:
    """The columns of `rows` that are the same in every row of a run.

    Raises:
        ConfigError: there is no run.
    """
    if not holds_run(run_dir):
        raise ConfigError(f"{run_dir} holds no run")
    tree = yaml.safe_load((run_dir / "config.yaml").read_text(encoding="utf-8"))
    return {
        "run": run_dir.name,
        "method": method or method_label(tree["algorithm"]),
        "map": map_name or EnvConfig(**tree["env"]).label,
        "seed": tree["seed"],
        "commit": json.loads((run_dir / "run.json").read_text())["git"],
        "config_digest": config_digest(tree),
    }


@dataclass(frozen=True)
class Curve:
    """The evaluations of one run, in order."""

    method: str
    map: str
    seed: int
    env_steps: list[int]
    wins: list[int]
    """Greedy wins"""
    episodes: list[int]
    """Greedy ones"""
    sampled_wins: list[int]
    sampled_episodes: list[int]

    @property
    def rates(self) -> list[float]:
        """Greedy win rates."""
        return _rates(self.wins, self.episodes)

    @property
    def sampled_rates(self) -> list[float]:
        """Win rates of sampled actions."""
        return _rates(self.sampled_wins, self.sampled_episodes)

    def until(self, env_steps: int) -> Curve:
        """The same up to there, and at least its first evaluation."""
        end = max(1, bisect_right(self.env_steps, env_steps))
        return replace(self, **{name: getattr(self, name)[:end] for name in _COUNTS})


_COUNTS = {
    "env_steps": "env_steps",
    "wins": "greedy_wins",
    "episodes": "greedy_episodes",
    "sampled_wins": "sampled_wins",
    "sampled_episodes": "sampled_episodes",
}
"""Fields of a curve by evaluation, and their columns"""


def _rates(wins: Sequence[int], episodes: Sequence[int]) -> list[float]:
    return [won / of for won, of in zip(wins, episodes, strict=True)]


def read_curves(sources: Sequence[Path]) -> list[Curve]:
    """All runs with evaluations in `sources`: results files, or run directories.

    Raises:
        ConfigError: a source is neither, none has an evaluation, or two runs say they are the same.
    """
    runs: dict[tuple[str, str, int], list[Mapping[str, Any]]] = {}
    for row in (row for source in sources for row in _read(source)):
        runs.setdefault((row["map"], row["method"], int(row["seed"])), []).append(row)
    if not runs:
        raise ConfigError(f"no evaluation in {', '.join(map(str, sources))}")
    return [_curve(*key, found) for key, found in runs.items()]


def _read(source: Path) -> Iterable[Mapping[str, Any]]:
    if source.is_dir():
        return rows(source)
    if not source.exists():
        raise ConfigError(f"{source}: wanted a results file (CSV) or a run directory, got nothing there")
    table = read_table(source)
    missing = set(COLUMNS) - set(table[0] if table else COLUMNS)
    if missing:
        raise ConfigError(f"{source} is not a results file: it lacks {', '.join(sorted(missing))}")
    return table


def _curve(map_name: str, method: str, seed: int, found: list[Mapping[str, Any]]) -> Curve:
    """One run's curve; a second run under the same name would be averaged into it unseen."""
    names = {(row["run"], row["config_digest"]) for row in found}
    if len(names) > 1 or len({row["episode"] for row in found}) < len(found):
        raise ConfigError(
            f"{method} on {map_name}, seed {seed}, is there more than once: {sorted(names)}; "
            "leave out all but one"
        )
    found.sort(key=lambda row: int(row["episode"]))
    counts = {name: [int(row[column]) for row in found] for name, column in _COUNTS.items()}
    return Curve(method, map_name, seed, **counts)
