"""Compiled random streams: the same numbers as plain Python, apart from each other, uniform."""

import numpy as np
import pytest

from liir_common import rng, seeds

EDGES = [0, 1, 2, 12345, 2**31, 2**63 - 1, 2**63, 2**64 - 1]


@pytest.mark.parametrize("seed", EDGES)
@pytest.mark.parametrize("index", [0, 1, 5, 2**40, 2**64 - 1])
def test_compiled_seeds_are_those_of_plain_python(seed: int, index: int) -> None:
    assert int(rng.derive(np.uint64(seed), np.uint64(index))) == seeds.derive(seed, index)
    assert int(rng.mix(np.uint64(seed))) == seeds.mix(seed)


def test_first_draws_are_the_published_ones() -> None:
    # Outputs of SplitMix64 from seed 1234567, as published with several reference implementations.
    stream = np.array([1234567], np.uint64)
    drawn = [int(rng.next_u64(stream)) for _ in range(3)]
    assert drawn == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_draw_k_depends_on_seed_and_k_only() -> None:
    stream = np.array([99], np.uint64)
    drawn = [int(rng.next_u64(stream)) for _ in range(10)]
    assert drawn == [seeds.mix((99 + (k + 1) * seeds.GOLDEN) % 2**64) for k in range(10)]


def test_streams_of_domains_and_episodes_never_meet() -> None:
    domains = [seeds.TRAINING, seeds.EVALUATION, seeds.BATTLE, seeds.POLICY, seeds.LEARNER]
    starts = [seeds.episode_seed(1, domain, episode) for domain in domains for episode in range(40)]
    streams = [np.array([start], np.uint64) for start in starts]
    drawn = [int(rng.next_u64(stream)) for stream in streams for _ in range(1000)]
    assert len(set(drawn)) == len(drawn)


def test_seeds_of_runs_differ() -> None:
    of_runs = {
        seeds.episode_seed(run, seeds.TRAINING, episode) for run in range(100) for episode in range(100)
    }
    assert len(of_runs) == 10_000


def test_uniform_is_uniform() -> None:
    stream = np.array([seeds.derive(7, seeds.POLICY)], np.uint64)
    draws = np.array([rng.uniform(stream) for _ in range(50_000)])
    assert draws.min() >= 0
    assert draws.max() < 1
    counts = np.histogram(draws, 100, (0, 1))[0]
    chi_square = ((counts - 500) ** 2 / 500).sum()
    # 99 degrees of freedom: 99.99 % of uniform samples are below 160.
    assert chi_square < 160
    assert abs(np.corrcoef(draws[:-1], draws[1:])[0, 1]) < 4 / np.sqrt(len(draws))
