"""Figure 3: greedy win rate against environment steps, a panel per map, and its table (section 5.2)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from liir_common.figures.statistics import Interval, Values, bootstrap, wilson
from liir_common.files import csv_text, write_atomic
from liir_common.report import IN_A_ROW, TEN, first_at_level, smooth, tens
from liir_common.results import Curve

_BETWEEN = "\nAbove, all seeds of a method end where the shortest ends; below, each run at its own end.\n\n"
_POINTS = 200
_PANELS = 5
"""Maps in a row of the figure"""


@dataclass(frozen=True)
class Row:
    """One method on one map as far as every seed has come; win rates are greedy, means over seeds."""

    map: str
    method: str
    seeds: int
    env_steps: int
    final: float
    """Of the last ten evaluations"""
    final_seeds: Interval | None
    """95 % bootstrap interval over seeds; none for a single one"""
    final_episodes: Interval
    """95 % Wilson interval of all test episodes in `final` taken together"""
    best: float
    """Of each seed's best ten evaluations in a row"""
    best_seeds: Interval | None
    goal_env_steps: tuple[int, ...]
    """When each seed's last ten evaluations first came to 90 %; seeds that never did are left out"""

    def cells(self) -> dict[str, Any]:
        """The row as flat columns."""
        return {
            "map": self.map,
            "method": self.method,
            "seeds": self.seeds,
            "env_steps": self.env_steps,
            "final": f"{self.final:.4f}",
            "final_seeds_low_high": _interval(self.final_seeds),
            "final_wilson_low_high": _interval(self.final_episodes),
            "best": f"{self.best:.4f}",
            "best_seeds_low_high": _interval(self.best_seeds),
            "goal_env_steps": " ".join(map(str, self.goal_env_steps)),
        }


@dataclass(frozen=True)
class RunRow:
    """One run to its own end; levels are win rates, means of ten evaluations in a row."""

    map: str
    method: str
    seed: int
    env_steps: int
    three_env_steps: int | None
    """First of the first three greedy evaluations in a row that are at 90 % or above"""
    ten_env_steps: int | None
    """Last of the first ten greedy evaluations that are at 90 % together"""
    lowest_after: float | None
    """Lowest greedy level from those ten on"""
    lowest_from: tuple[float, float] | None
    """Lowest level, greedy and sampled, of ten evaluations that all come from a given step on"""
    last: tuple[float, float]
    """Greedy and sampled"""


def _interval(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval[0]:.4f} {interval[1]:.4f}"


def groups(curves: Sequence[Curve]) -> dict[str, dict[str, list[Curve]]]:
    """The curves by map and method, in their order."""
    by_map: dict[str, dict[str, list[Curve]]] = {}
    for curve in curves:
        by_map.setdefault(curve.map, {}).setdefault(curve.method, []).append(curve)
    return by_map


def tabulate(curves: Sequence[Curve]) -> list[Row]:
    """A row per map and method."""
    return [
        _row(map_name, method, runs)
        for map_name, methods in groups(curves).items()
        for method, runs in methods.items()
    ]


def _row(map_name: str, method: str, runs: Sequence[Curve]) -> Row:
    env_steps = min(run.env_steps[-1] for run in runs)
    runs = [run.until(env_steps) for run in runs]
    levels = [tens(run.rates) for run in runs]
    final = [of[-1] for of in levels]
    best = [max(of) for of in levels]
    wins = sum(sum(run.wins[-TEN:]) for run in runs)
    episodes = sum(sum(run.episodes[-TEN:]) for run in runs)
    return Row(
        map_name,
        method,
        len(runs),
        env_steps,
        float(np.mean(final)),
        bootstrap(final),
        wilson(wins, episodes),
        float(np.mean(best)),
        bootstrap(best),
        tuple(run.env_steps[first + TEN - 1] for run in runs if (first := _first_ten(run)) is not None),
    )


def _first_ten(run: Curve) -> int | None:
    """Index of the evaluation that the first ten at 90 % together begin with."""
    return first_at_level(tens(run.rates)) if len(run.rates) >= TEN else None


def tabulate_runs(curves: Sequence[Curve], lowest_from: Mapping[str, int]) -> list[RunRow]:
    """A row per run; `lowest_from` has the environment step of each map that `RunRow.lowest_from` is of."""
    return [
        _run_row(run, lowest_from.get(map_name))
        for map_name, methods in groups(curves).items()
        for runs in methods.values()
        for run in runs
    ]


def _run_row(run: Curve, env_steps: int | None) -> RunRow:
    greedy, sampled = tens(run.rates), tens(run.sampled_rates)
    three, ten = first_at_level(run.rates, IN_A_ROW), _first_ten(run)
    start = len(run.rates) if env_steps is None else bisect_left(run.env_steps, env_steps)
    return RunRow(
        run.map,
        run.method,
        run.seed,
        run.env_steps[-1],
        None if three is None else run.env_steps[three],
        None if ten is None else run.env_steps[ten + TEN - 1],
        None if ten is None else min(greedy[ten:]),
        (min(greedy[start:]), min(sampled[start:])) if start + TEN <= len(run.rates) else None,
        (greedy[-1], sampled[-1]),
    )


def markdown(rows: Sequence[Row]) -> str:
    """The table of means for people; win rates in percent, intervals of 95 %."""
    levels = ("final", "over seeds", "over episodes", "best", "over seeds", "90 % from")
    return _head(("map", "method", "seeds", "env steps", *levels)) + "".join(
        f"| {r.map} | {r.method} | {r.seeds} | {r.env_steps:,} | {100 * r.final:.1f} "
        f"| {_percent(r.final_seeds)} | {_percent(r.final_episodes)} "
        f"| {100 * r.best:.1f} | {_percent(r.best_seeds)} | {_goal(r)} |\n"
        for r in rows
    )


def markdown_runs(rows: Sequence[RunRow], lowest_from: Mapping[str, int]) -> str:
    """The table of runs for people; win rates in percent, with columns more for a `lowest_from`."""
    cells = [_run_cells(row, lowest_from) for row in rows]
    return _head(list(cells[0])) + "".join(f"| {' | '.join(line.values())} |\n" for line in cells)


def _run_cells(row: RunRow, lowest_from: Mapping[str, int]) -> dict[str, str]:
    greedy, sampled = row.lowest_from or (None, None)
    later = {
        "from": _steps(lowest_from.get(row.map)),
        "lowest greedy": _level(greedy),
        "lowest sampled": _level(sampled),
    }
    return {
        "map": row.map,
        "method": row.method,
        "seed": str(row.seed),
        "env steps": _steps(row.env_steps),
        "three at 90 % in a row from": _steps(row.three_env_steps),
        "90 % from": _steps(row.ten_env_steps),
        "lowest after": _level(row.lowest_after),
        **(later if lowest_from else {}),
        "last ten greedy": _level(row.last[0]),
        "last ten sampled": _level(row.last[1]),
    }


def _steps(env_steps: int | None) -> str:
    return "–" if env_steps is None else f"{env_steps:,}"


def _level(rate: float | None) -> str:
    return "–" if rate is None else f"{100 * rate:.1f}"


def _head(columns: Sequence[str]) -> str:
    return f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|\n"


def _percent(interval: Interval | None) -> str:
    return "–" if interval is None else f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"


def _goal(row: Row) -> str:
    reached = len(row.goal_env_steps)
    mean = f"{np.mean(row.goal_env_steps):,.0f}" if reached else "–"
    return mean if reached == row.seeds else f"{mean} ({reached} of {row.seeds})"


def points(curves: Sequence[Curve]) -> Iterator[dict[str, Any]]:
    """Every evaluation with its Wilson interval."""
    for curve in curves:
        for steps, wins, episodes in zip(curve.env_steps, curve.wins, curve.episodes, strict=True):
            low, high = wilson(wins, episodes)
            yield {
                "map": curve.map,
                "method": curve.method,
                "seed": curve.seed,
                "env_steps": steps,
                "wins": wins,
                "episodes": episodes,
                "win_rate": f"{wins / episodes:.4f}",
                "wilson_low": f"{low:.4f}",
                "wilson_high": f"{high:.4f}",
            }


def mean_curve(runs: Sequence[Curve]) -> tuple[Values, Values, Values]:
    """Environment steps, and mean and standard deviation over seeds of the win rate there, as far as every
    seed has come; each seed's is the mean of five evaluations, interpolated."""
    first = max(run.env_steps[0] for run in runs)
    grid = np.linspace(first, max(first, min(run.env_steps[-1] for run in runs)), _POINTS)
    rates = [np.interp(grid, run.env_steps, smooth(run.rates)) for run in runs]
    return grid, np.mean(rates, 0), np.std(rates, 0, ddof=1 if len(runs) > 1 else 0)


def write_figure(curves: Sequence[Curve], output: Path, lowest_from: Mapping[str, int] | None = None) -> str:
    """Write figure3.png, .md (both tables), .csv (that of means) and figure3-points.csv (every evaluation).

    `lowest_from` has environment steps by map, see `tabulate_runs`. Returns the text of figure3.md.
    """
    output.mkdir(parents=True, exist_ok=True)
    table = tabulate(curves)
    steps = lowest_from or {}
    text = markdown(table) + _BETWEEN + markdown_runs(tabulate_runs(curves, steps), steps)
    write_atomic(output / "figure3.md", text.encode())
    write_atomic(output / "figure3.csv", csv_text([row.cells() for row in table]).encode())
    write_atomic(output / "figure3-points.csv", csv_text(list(points(curves))).encode())
    _draw(groups(curves), output / "figure3.png")
    return text


def _draw(by_map: dict[str, dict[str, list[Curve]]], output: Path) -> None:
    from matplotlib.figure import Figure

    methods = list(dict.fromkeys(method for names in by_map.values() for method in names))
    columns = min(len(by_map), _PANELS)
    rows = ceil(len(by_map) / columns)
    figure = Figure(figsize=(5 * columns, 4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes in panels.flat[len(by_map) :]:
        axes.remove()
    for axes, (map_name, runs_of) in zip(panels.flat, by_map.items(), strict=False):
        for method, runs in runs_of.items():
            steps, mean, deviation = mean_curve(runs)
            colour = f"C{methods.index(method)}"  # the same in every panel
            axes.plot(steps / 1e6, mean, color=colour, label=f"{method} ({len(runs)})")
            axes.fill_between(steps / 1e6, mean - deviation, mean + deviation, color=colour, alpha=0.2, lw=0)
        axes.set(title=map_name, xlabel="million environment steps", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.25)
        # Below: ten methods leave no room among the curves.
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=3, frameon=False, title="method (seeds)"
        )
    for axes in panels[:, 0]:
        axes.set_ylabel("greedy win rate, mean ± deviation")
    figure.savefig(output, dpi=120)
