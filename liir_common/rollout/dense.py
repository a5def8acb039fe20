"""What compiled networks are built from: matrix products of a few rows, and activations that vectorise.

Only `contract` of fast-math is on: a product and a sum may fuse, nothing may change order, so equal
inputs give equal bytes on equal machines.

Loops over units vectorise if they write one array alone and index it, and all that they read, by the bare
loop variable: after `x[j + offset]` numba looks for negative indices, so take a slice first.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from liir_common import kernel_cache
from liir_common.rollout.tile import write_tile
from liir_common.types import FloatArray

kernel_cache.install()

# Numerators and denominators of tanh as a 13/6 rational function, as Eigen has it; beyond the bound
# float32 tanh is 1.
_BOUND = np.float32(7.90531110763549805)
_A1, _A3, _A5, _A7 = map(
    np.float32, (4.89352455891786e-03, 6.37261928875436e-04, 1.48572235717979e-05, 5.12229709037114e-08)
)
_A9, _A11, _A13 = map(np.float32, (-8.60467152213735e-11, 2.00018790482477e-13, -2.76076847742355e-16))
_B0, _B2, _B4, _B6 = map(
    np.float32, (4.89352518554385e-03, 2.26843463243900e-03, 1.18534705686654e-04, 1.19825839466702e-06)
)
_HALF = np.float32(0.5)


def aligned(values: NDArray[np.floating]) -> FloatArray:
    """A float32 copy at the start of a cache line; loads that span two lines cost a quarter of the speed."""
    line = 64
    memory = np.empty(values.size * 4 + line, np.uint8)
    start = -memory.ctypes.data % line
    copy = memory[start : start + values.size * 4].view(np.float32).reshape(values.shape)
    copy[...] = values
    return copy


@njit(inline="always")
def tanh(x):
    """tanh of a float32."""
    x = min(max(x, -_BOUND), _BOUND)
    s = x * x
    numerator = x * (_A1 + s * (_A3 + s * (_A5 + s * (_A7 + s * (_A9 + s * (_A11 + s * _A13))))))
    return numerator / (_B0 + s * (_B2 + s * (_B4 + s * _B6)))


@njit(inline="always")
def sigmoid(x):
    """1 / (1 + exp(-x)) of a float32."""
    return _HALF + _HALF * tanh(_HALF * x)


@njit(inline="always")
def _columns(x, weight, start, out, column, vectors, lanes):
    """The vectors·lanes columns of `_product` from `column` on."""
    n = len(out)
    by_four = n - n % 4
    for a in range(0, by_four, 4):
        write_tile(4, vectors, lanes, x, weight, start, out, a, column)
    if n - by_four == 3:
        write_tile(3, vectors, lanes, x, weight, start, out, by_four, column)
    elif n - by_four == 2:
        write_tile(2, vectors, lanes, x, weight, start, out, by_four, column)
    elif n - by_four == 1:
        write_tile(1, vectors, lanes, x, weight, start, out, by_four, column)


@njit(inline="always")
def _product(x, weight, start, out):
    """Tiles of 4 x 24 fill the sixteen vector registers of AVX2: twelve sums, three weights and a factor."""
    columns = out.shape[1]
    j = 0
    while columns - j >= 24:
        _columns(x, weight, start, out, j, 3, 8)
        j += 24
    if columns - j >= 16:
        _columns(x, weight, start, out, j, 2, 8)
        j += 16
    if columns - j >= 8:
        _columns(x, weight, start, out, j, 1, 8)
        j += 8
    while columns > j:
        _columns(x, weight, start, out, j, 1, 1)
        j += 1


@njit(cache=True, nogil=True)
def add_product(x, weight, out):
    """out[n, columns] += x[n, rows] @ weight[rows, columns]."""
    _product(x, weight, out, out)


@njit(cache=True, nogil=True)
def affine(x, weight, bias, out):
    """out[n, columns] = bias[columns] + x[n, rows] @ weight[rows, columns]."""
    _product(x, weight, np.broadcast_to(bias, out.shape), out)
