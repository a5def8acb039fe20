"""`make soak` tells a leak from noise, and misses no process."""

from __future__ import annotations

import subprocess
import sys
from collections import defaultdict

import numpy as np
import psutil
import pytest

from tests.faults import soak


def lower_bound(minutes: float, per_hour: float, seed: int) -> float:
    """Of the growth per hour, of a figure that grows so much under noise of 2, which lasts for 20 s."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0, 60 * minutes, soak.EVERY_S)
    noise = np.repeat(rng.normal(0, 2, len(seconds)), 10)[: len(seconds)]
    values = 200 + per_hour * seconds / 3600 + noise
    _, slope, error = soak.growth(list(zip(seconds, values, strict=True)))
    return slope - soak.CERTAIN * error


@pytest.mark.parametrize(("minutes", "per_hour"), [(4, 400), (60, 25)])
def test_a_leak_is_told_from_noise(minutes: float, per_hour: float) -> None:
    most = soak.MOST_PER_HOUR["memory, MiB"]
    leaks = [lower_bound(minutes, per_hour, seed) > most for seed in range(50)]
    steady = [lower_bound(minutes, 0, seed) > most for seed in range(50)]
    assert np.mean(leaks) > 0.9
    assert np.mean(steady) < 0.1


def test_a_process_that_is_gone_ends_it() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        process = psutil.Process(child.pid)
    with pytest.raises(psutil.NoSuchProcess):
        soak.sample(process, "actor 0", 1.0, defaultdict(list))
