"""The statistics of the figures, against numbers worked out by hand or published."""

import math

import numpy as np
import pytest

from liir_common.figures.statistics import auc, bootstrap, cosine, overlap, wilson


def test_auc_counts_pairs_and_half_the_ties() -> None:
    # Of six pairs 3 > 1, 3 > 2, 2 > 1 are won, 2 = 2 is tied, 0 loses both.
    assert auc(np.array([3.0, 2.0, 0.0]), np.array([1.0, 2.0])) == pytest.approx(3.5 / 6)
    with pytest.raises(ValueError, match="2 good and 0 bad"):
        auc(np.ones(2), np.ones(0))


def test_overlap_is_the_area_that_is_shared() -> None:
    low, high = np.linspace(0, 1, 100), np.linspace(2, 3, 50)
    assert overlap(low, low) == pytest.approx(1)
    assert overlap(low, high) == 0
    assert overlap(low, np.concatenate([low, high, high])) == pytest.approx(0.5, abs=0.02)


def test_wilson_agrees_with_published_intervals() -> None:
    # Newcombe (1998), table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29.
    for wins, episodes, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        assert wilson(wins, episodes) == pytest.approx((low, high), abs=5e-5)
    with pytest.raises(ValueError, match="3 of 2"):
        wilson(3, 2)


def test_bootstrap_wants_seeds_and_is_the_same_every_time() -> None:
    assert bootstrap([0.7]) is None
    assert bootstrap([0.5, 0.5]) == (0.5, 0.5)
    # Of the means of two draws from {0, 1} a quarter is 0 and a quarter 1.
    assert bootstrap([0.0, 1.0]) == (0.0, 1.0)
    interval = bootstrap([0.1, 0.4, 0.6, 0.9, 1.0])
    assert interval == bootstrap([0.1, 0.4, 0.6, 0.9, 1.0])
    assert interval is not None
    assert 0.1 < interval[0] < 0.6 < interval[1] < 1.0


def test_cosine_is_of_the_angle() -> None:
    assert cosine(np.array([1.0, 0.0]), np.array([1.0, 1.0])) == pytest.approx(math.sqrt(0.5))
    assert cosine(np.array([1.0, 2.0]), np.array([-2.0, -4.0])) == pytest.approx(-1)
    assert math.isnan(cosine(np.zeros(2), np.ones(2)))
