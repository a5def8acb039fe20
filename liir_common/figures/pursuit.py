"""Figure 2: the learned intrinsic reward of good and of bad actions in 1D Pursuit (section 5.1)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from liir_common.errors import ConfigError
from liir_common.figures.run import Frozen, load, play, taken
from liir_common.figures.statistics import Values, auc, overlap
from liir_common.files import write_atomic
from liir_common.pursuit import SCALE
from liir_common.sweep import Run

EPISODES = 1000
_POLICIES = {"random": 1.0, "learned": 0.0}
"""Share of random actions of the two policies that play."""


@dataclass(frozen=True)
class Split:
    """r_in of the actions taken, by what they did to the distance from the target."""

    good: Values
    """Of moves towards the target"""
    bad: Values
    """Of moves away from it; staying is neither"""

    def figures(self) -> dict[str, Any]:
        """Counts, means, deviations, shared area of the histograms, and the chance that good is above bad."""
        return {
            "good": len(self.good),
            "bad": len(self.bad),
            "mean_good": float(self.good.mean()),
            "mean_bad": float(self.bad.mean()),
            "std_good": float(self.good.std()),
            "std_bad": float(self.bad.std()),
            "overlap": overlap(self.good, self.bad),
            "auc": auc(self.good, self.bad),
        }


def split(frozen: Frozen, epsilon: float, episodes: int = EPISODES) -> Split:
    """Play and sort; `epsilon` is the share of random actions.

    Raises:
        ConfigError: the run plays another game, or the policy took no good or no bad action.
    """
    if not frozen.spec.version.startswith("pursuit_1d"):
        raise ConfigError(f"{frozen.run} plays {frozen.spec.name}; figure 2 wants runs on 1D Pursuit")
    r_in, nearer = [], []
    for trajectory in play(frozen, range(episodes), "sampled", epsilon):
        distance = np.abs(np.rint(SCALE * trajectory.obs[..., 0]))
        r_in.append(taken(frozen.r_in(trajectory.obs[:-1]), trajectory).ravel())
        nearer.append((distance[:-1] - distance[1:]).ravel())
    values, moved = np.concatenate(r_in), np.concatenate(nearer)
    good, bad = values[moved > 0], values[moved < 0]
    if not len(good) or not len(bad):
        raise ConfigError(
            f"{frozen.run} took {len(good)} good and {len(bad)} bad actions in {episodes} episodes: nothing "
            "to compare; train with more exploration"
        )
    return Split(good, bad)


def write_figure(runs: Sequence[Run], folder: Path, output: Path, episodes: int = EPISODES) -> dict[str, Any]:
    """Measure the runs under `folder`, write figure2.json and figure2.png into `output`; returns the JSON."""
    splits: dict[str, dict[int, dict[str, Split]]] = {}
    figures: dict[str, Any] = {"episodes": episodes, "methods": {}}
    for run in runs:
        frozen = load(folder / run.name)
        measured = {name: split(frozen, epsilon, episodes) for name, epsilon in _POLICIES.items()}
        splits.setdefault(run.method, {})[run.seed] = measured
        method = figures["methods"].setdefault(run.method, {"seeds": {}})
        by_policy = {name: part.figures() for name, part in measured.items()}
        method["seeds"][str(run.seed)] = frozen.about() | by_policy
    for method in figures["methods"].values():
        method["auc"] = {name: _spread(method["seeds"].values(), name) for name in _POLICIES}
    output.mkdir(parents=True, exist_ok=True)
    write_atomic(output / "figure2.json", json.dumps(figures, indent=1).encode())
    _draw(splits, output / "figure2.png")
    return figures


def _spread(seeds: Any, policy: str) -> dict[str, float]:
    values = [seed[policy]["auc"] for seed in seeds]
    return {"mean": float(np.mean(values)), "min": min(values), "max": max(values)}


def _draw(splits: Mapping[str, Mapping[int, Mapping[str, Split]]], output: Path) -> None:
    """A row per method, a column per policy; all seeds in one histogram, each seed weighing the same."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3 * len(splits)), layout="constrained")
    panels = figure.subplots(len(splits), len(_POLICIES), squeeze=False)
    for row, (method, seeds) in zip(panels, splits.items(), strict=True):
        for axes, policy in zip(row, _POLICIES, strict=True):
            for kind, colour in (("good", "C0"), ("bad", "C3")):
                parts = [getattr(measured[policy], kind) for measured in seeds.values()]
                weights = np.concatenate([np.full(len(part), 1 / len(part) / len(parts)) for part in parts])
                label = f"{kind}, mean {np.mean([part.mean() for part in parts]):.2f}"
                axes.hist(np.concatenate(parts), 50, weights=weights, alpha=0.6, color=colour, label=label)
            axes.set(title=f"{method}, actions of the {policy} policy", xlabel="r_in", ylabel="share")
            axes.legend()
    figure.savefig(output, dpi=120)
