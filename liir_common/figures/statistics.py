"""The few statistics that the figures report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.floating[Any]]
Interval = tuple[float, float]

_Z = 1.959964
"""Two-sided 95 % of the normal distribution."""
_RESAMPLES = 10_000


def auc(good: Values, bad: Values) -> float:
    """Chance that a value of `good` is above one of `bad`, a tie counting half (Mann-Whitney).

    Raises:
        ValueError: one of them is empty.
    """
    if not len(good) or not len(bad):
        raise ValueError(f"auc wants values of both kinds, got {len(good)} good and {len(bad)} bad")
    ordered = np.sort(bad)
    below = np.searchsorted(ordered, good, "left")
    not_above = np.searchsorted(ordered, good, "right")
    return float((below + not_above).mean() / (2 * len(bad)))


def overlap(a: Values, b: Values, bins: int = 50) -> float:
    """Area that the normalised histograms of both share, over `bins` bins of their common range."""
    edges = np.histogram_bin_edges(np.concatenate([a, b]), bins)
    shares = [np.histogram(values, edges)[0] / len(values) for values in (a, b)]
    return float(np.minimum(*shares).sum())


def wilson(wins: int, episodes: int) -> Interval:
    """95 % interval of a win rate (Wilson, 1927).

    Raises:
        ValueError: no episode, or more wins than episodes.
    """
    if not 0 <= wins <= episodes or episodes == 0:
        raise ValueError(f"wilson wants 0 <= wins <= episodes and an episode, got {wins} of {episodes}")
    rate, z2 = wins / episodes, _Z**2
    centre = (rate + z2 / (2 * episodes)) / (1 + z2 / episodes)
    half = _Z / (1 + z2 / episodes) * math.sqrt(rate * (1 - rate) / episodes + z2 / (4 * episodes**2))
    # Rounding would leave the range where all or none are won.
    return max(0.0, centre - half), min(1.0, centre + half)


def bootstrap(values: Sequence[float]) -> Interval | None:
    """95 % percentile interval of the mean over seeds, the same at every call; none for a single seed."""
    if len(values) < 2:
        return None
    draws = np.random.default_rng(0).choice(values, (_RESAMPLES, len(values)))
    low, high = np.quantile(draws.mean(1), [0.025, 0.975])
    return float(low), float(high)


def cosine(a: Values, b: Values) -> float:
    """Cosine similarity of two vectors, in [-1, 1]; NaN if one of them is zero."""
    length = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / length if length else math.nan
