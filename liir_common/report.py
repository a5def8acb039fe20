"""What a run came to: a summary and the win-rate curve, from the files in its run directory."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from liir_common.config import EnvConfig, leaves
from liir_common.errors import ConfigError
from liir_common.files import csv_text, last_row, read_table, write_atomic
from liir_common.results import COLUMNS, identity, method_label, rows

_LEVEL = 0.9
IN_A_ROW = 3
"""Evaluations that have to reach a level one after the other: one alone can be luck."""
TEN = 10
"""Evaluations that a level is the mean of: one alone jumps between 0 and 1."""


@dataclass(frozen=True)
class Summary:
    """Figures of one run; win rates are wins / episodes of 20 test episodes unless configured otherwise."""

    learner_steps: int
    env_steps: int
    episodes: int
    evaluations: int
    first_win_rate_90_env_steps: int | None
    """Environment steps of the first greedy evaluation at 90 % or above."""
    first_win_rate_90_seconds: float | None
    """Seconds from the beginning of the run until that checkpoint was frozen."""
    reached_90_env_steps: int | None
    """The same for the first of three such evaluations in a row: one alone can be luck."""
    last_ten_greedy: float | None
    """Mean greedy win rate of the last ten evaluations."""
    last_ten_sampled: float | None
    best_greedy: float | None


def summarise(run_dir: Path) -> Summary:
    """Read the figures of the run in `run_dir`."""
    last = last_row(run_dir / "metrics.csv") or {"learner_step": "0", "env_steps": "0", "episodes": "0"}
    tests = sorted(read_table(run_dir / "evaluations.csv"), key=lambda row: int(row["episode"]))
    greedy = [float(row["greedy_win_rate"]) for row in tests]
    sampled = [float(row["sampled_win_rate"]) for row in tests]
    first = first_at_level(greedy)
    lasting = first_at_level(greedy, IN_A_ROW)
    return Summary(
        learner_steps=int(last["learner_step"]),
        env_steps=int(last["env_steps"]),
        episodes=int(last["episodes"]),
        evaluations=len(tests),
        first_win_rate_90_env_steps=int(tests[first]["env_steps"]) if first is not None else None,
        first_win_rate_90_seconds=float(tests[first]["seconds"]) if first is not None else None,
        reached_90_env_steps=int(tests[lasting]["env_steps"]) if lasting is not None else None,
        last_ten_greedy=tens(greedy)[-1] if greedy else None,
        last_ten_sampled=tens(sampled)[-1] if sampled else None,
        best_greedy=max(greedy, default=None),
    )


def write_report(run_dir: Path) -> Summary:
    """Write summary.json and, once there are evaluations, winrate.png into `run_dir`."""
    summary = summarise(run_dir)
    write_atomic(run_dir / "summary.json", json.dumps(asdict(summary), indent=1).encode())
    if summary.evaluations:
        plot_win_rate({run_dir.name: [run_dir]}, run_dir / "winrate.png")
    return summary


def print_summary(run_dir: Path, summary: Summary) -> None:
    """Print the summary of the run in `run_dir` for a person to read."""
    print(f"\n{run_dir}")
    for name, value in asdict(summary).items():
        shown = "–" if value is None else f"{value:.4g}" if isinstance(value, float) else value
        print(f"  {name.replace('_', ' '):30} {shown}")
    counts = json.loads((run_dir / "run.json").read_text()).get("parameters", {})
    for name, count in counts.items():
        print(f"  {'parameters of ' + name:30} {count}")
    if summary.evaluations:
        print(f"  curve: {run_dir / 'winrate.png'}")


def write_results(run_dirs: Sequence[Path], output: Path) -> None:
    """Gather runs into `output`: runs.csv (a row per run), results.csv (a row per evaluation), winrate.png.

    Raises:
        ConfigError: two run directories have the same name.
    """
    run_dirs = [run_dir.resolve() for run_dir in run_dirs]
    names = Counter(run_dir.name for run_dir in run_dirs)
    if twice := sorted(name for name, count in names.items() if count > 1):
        raise ConfigError(f"wanted runs with names of their own, got {', '.join(twice)} more than once")
    output.mkdir(parents=True, exist_ok=True)
    configs = [yaml.safe_load((run_dir / "config.yaml").read_text(encoding="utf-8")) for run_dir in run_dirs]
    groups: dict[str, list[Path]] = {}
    for run_dir, label in zip(run_dirs, curve_labels(configs), strict=True):
        groups.setdefault(label, []).append(run_dir)
    for run_dir in run_dirs:
        write_atomic(output / f"{run_dir.name}.yaml", (run_dir / "config.yaml").read_bytes())
    runs = [_named(run_dir) | asdict(summarise(run_dir)) for run_dir in run_dirs]
    write_atomic(output / "runs.csv", csv_text(runs).encode())
    tests = [row for run_dir in run_dirs for row in rows(run_dir)]
    write_atomic(output / "results.csv", csv_text(tests, COLUMNS).encode())
    plot_win_rate(groups, output / "winrate.png")


def _named(run_dir: Path) -> dict[str, Any]:
    about = identity(run_dir)
    return {column: about[column] for column in ("run", "method", "map", "seed", "commit")}


def curve_labels(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The method of each, its map where there are several, and its differences from others of that method."""
    methods = [method_label(config["algorithm"]) for config in configs]
    maps = [EnvConfig(**config["env"]).label for config in configs]
    settings = [leaves(config["algorithm"]) for config in configs]
    labels = []
    for method, map_name, own in zip(methods, maps, settings, strict=True):
        alike = [other for name, other in zip(methods, settings, strict=True) if name == method]
        apart = [f"{key} {own[key]}" for key in own if any(o.get(key, own[key]) != own[key] for o in alike)]
        labels.append(", ".join([map_name, method, *apart] if len(set(maps)) > 1 else [method, *apart]))
    return labels


def plot_win_rate(groups: dict[str, list[Path]], output: Path) -> None:
    """Draw greedy (solid) and sampled (faint) win rate against environment steps, a colour per group."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4 + 0.2 * len(groups)), layout="constrained")
    axes = figure.subplots()
    for number, (label, run_dirs) in enumerate(groups.items()):
        for run_dir in run_dirs:
            tests = sorted(read_table(run_dir / "evaluations.csv"), key=lambda row: int(row["episode"]))
            steps = [int(row["env_steps"]) for row in tests]
            for actions, alpha in (("greedy", 1.0), ("sampled", 0.35)):
                rates = [float(row[f"{actions}_win_rate"]) for row in tests]
                name = label if run_dir is run_dirs[0] and actions == "greedy" else None
                axes.plot(steps, smooth(rates), color=f"C{number}", label=name, alpha=alpha)
    axes.set(xlabel="environment steps", ylabel="win rate", ylim=(-0.02, 1.02))
    axes.axhline(_LEVEL, color="grey", lw=0.8, ls=":")
    axes.grid(alpha=0.25)
    figure.legend(loc="outside lower left", fontsize=8)
    axes.set_title(
        "Win rate of frozen checkpoints, mean of five evaluations: greedy, faint: sampled", fontsize=10
    )
    figure.savefig(output, dpi=120)


def smooth(values: Sequence[float], window: int = 5) -> list[float]:
    """Mean of each value and those before it in the window, at the start of fewer."""
    return [
        sum(part) / len(part) for i in range(len(values)) if (part := values[max(0, i + 1 - window) : i + 1])
    ]


def tens(rates: Sequence[float]) -> list[float]:
    """Means of ten rates in a row, from the first ten to the last, or of all where there are fewer."""
    return smooth(rates, TEN)[min(TEN, len(rates)) - 1 :]


def first_at_level(rates: Sequence[float], in_a_row: int = 1) -> int | None:
    """Index of the first rate of 90 % that so many in a row begin with; None if there is none."""
    for i in range(len(rates) - in_a_row + 1):
        # A mean of ten that is 90 % may be less by a rounding.
        if all(rate > _LEVEL - 1e-9 for rate in rates[i : i + in_a_row]):
            return i
    return None
