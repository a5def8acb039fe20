"""Compare the simulator with what is published about SMAC v1 on StarCraft II.

The targets are means over training logs of the real game: first episodes of uniformly random teams, and
test episodes of greedy untrained networks that never attack.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liir_common.battle.policies import CLOSEST_ENEMY, RANDOM, STAND, STEP_ASIDE, play
from liir_common.battle.scenarios import make_battle

_COLUMNS: Mapping[str, int] = {
    "mean length": 0,
    "median length": 0,
    "mean return": 1,
    "win rate": 2,
    "dead allies": 3,
}
"""Of the outcomes of `policies.play`"""
POLICIES: Mapping[str, int] = {
    "random": RANDOM,
    "stand": STAND,
    "step aside": STEP_ASIDE,
    "closest enemy": CLOSEST_ENEMY,
}


@dataclass(frozen=True)
class Target:
    """A figure of the real game."""

    policy: str
    figure: str
    value: float


TARGETS: Mapping[str, tuple[Target, ...]] = {
    "3m": (
        Target("random", "mean length", 27.6),
        Target("random", "median length", 26),
        Target("random", "mean return", 1.53),
        Target("random", "win rate", 0),
        Target("stand", "mean length", 21.7),
        Target("step aside", "dead allies", 0),
    ),
    "8m": (
        Target("random", "mean length", 35.3),
        Target("random", "median length", 30),
        Target("random", "mean return", 1.92),
        Target("random", "win rate", 0),
        Target("stand", "mean length", 24.0),
        Target("step aside", "dead allies", 0),
    ),
    "2s3z": (
        Target("random", "mean length", 52.6),
        Target("random", "median length", 50),
        Target("random", "mean return", 3.88),
        Target("random", "win rate", 0),
        Target("stand", "mean length", 43.1),
        Target("closest enemy", "win rate", 0.9),
    ),
}


@dataclass(frozen=True)
class Row:
    """A figure of the real game beside the simulator's."""

    target: Target
    measured: float
    standard_error: float

    @property
    def difference(self) -> float:
        """Relative to the target; absolute where the target is 0."""
        return (self.measured - self.target.value) / (self.target.value or 1.0)


def calibrate(map_name: str, episodes: int = 2000, seed: int = 0, **options: Any) -> list[Row]:
    """Play the scripted policies on a map that has targets and compare.

    Raises:
        ValueError: an unknown map, one without targets, or an illegal option.
    """
    tables, _ = make_battle(map_name, **options)
    if map_name not in TARGETS:
        raise ValueError(
            f"nothing is published about {map_name!r} to compare with; known: {', '.join(TARGETS)}"
        )
    targets = TARGETS[map_name]
    outcomes = {name: play(tables, POLICIES[name], episodes, seed) for name in {t.policy for t in targets}}
    return [Row(target, *estimate(outcomes[target.policy], target.figure)) for target in targets]


def estimate(outcomes: NDArray[np.float64], figure: str) -> tuple[float, float]:
    """A figure of outcomes [episodes, 5] as `policies.play` returns them, and its standard error."""
    values, root = outcomes[:, _COLUMNS[figure]], np.sqrt(len(outcomes))
    if figure.startswith("median"):
        # As many values lie between these two as the rank of the median is uncertain by.
        low, high = np.quantile(values, np.clip([0.5 - 0.5 / root, 0.5 + 0.5 / root], 0, 1))
        return float(np.median(values)), float(high - low) / 2
    return float(values.mean()), float(values.std() / root)


def format_rows(map_name: str, rows: list[Row]) -> str:
    """A table for people; ± is one standard error."""
    lines = [f"{map_name:<8}{'policy':<15}{'figure':<15}{'real':>8}{'here':>9}{'±':>7}{'diff':>9}"]
    for row in rows:
        target = row.target
        lines.append(
            f"{'':<8}{target.policy:<15}{target.figure:<15}"
            f"{target.value:8.2f}{row.measured:9.2f}{row.standard_error:7.2f}{row.difference:9.1%}"
        )
    return "\n".join(lines)
