"""Counter-based random numbers for compiled code: the k-th draw of a stream depends on (seed, k) only.

SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014): the
state after k draws is seed + k * GOLDEN and a draw is a mix of the state, so a stream is one uint64.
Streams are one-element arrays, so that compiled code advances them in place; no global state exists.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from liir_common import kernel_cache, seeds

# Before the first kernel: every module with kernels imports this one or `rollout.dense` first.
kernel_cache.install()

Stream = NDArray[np.uint64]
"""[1], the state of one stream; a fresh stream holds its seed"""

_GOLDEN, _MIX_1, _MIX_2 = np.uint64(seeds.GOLDEN), np.uint64(seeds.MIX_1), np.uint64(seeds.MIX_2)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 2.0**-53


@njit(cache=True, inline="always")
def mix(x):
    """`seeds.mix` on uint64."""
    x = (x ^ (x >> _S30)) * _MIX_1
    x = (x ^ (x >> _S27)) * _MIX_2
    return x ^ (x >> _S31)


@njit(cache=True)
def derive(seed, index):
    """`seeds.derive` on uint64."""
    return mix(mix(np.uint64(seed) + _GOLDEN) + np.uint64(index) * _GOLDEN)


@njit(cache=True, inline="always")
def next_u64(stream):
    """Next 64 random bits; advances `stream` in place."""
    stream[0] += _GOLDEN
    return mix(stream[0])


@njit(cache=True, inline="always")
def uniform(stream):
    """Next float64, uniform in [0, 1); advances `stream` in place."""
    return (next_u64(stream) >> _S11) * _TO_UNIT
