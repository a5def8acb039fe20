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


@njit(cache=True, fastmath={"contract"})
def add_product(x, weight, out):
    """out[n, columns] += x[n, rows] @ weight[rows, columns].

    Eight rows of the weight serve all n while they are in the first-level cache, and each pass over `out`
    does eight fused multiply-adds per load and store.
    """
    n, rows = x.shape
    columns = weight.shape[1]
    by_eight = rows - rows % 8
    for i in range(0, by_eight, 8):
        for a in range(n):
            x0, x1, x2, x3 = x[a, i], x[a, i + 1], x[a, i + 2], x[a, i + 3]
            x4, x5, x6, x7 = x[a, i + 4], x[a, i + 5], x[a, i + 6], x[a, i + 7]
            for j in range(columns):
                # From left to right, so that each product has one sum to fuse with.
                two = out[a, j] + x0 * weight[i, j] + x1 * weight[i + 1, j]
                four = two + x2 * weight[i + 2, j] + x3 * weight[i + 3, j]
                six = four + x4 * weight[i + 4, j] + x5 * weight[i + 5, j]
                out[a, j] = six + x6 * weight[i + 6, j] + x7 * weight[i + 7, j]
    for i in range(by_eight, rows):
        for a in range(n):
            for j in range(columns):
                out[a, j] += x[a, i] * weight[i, j]
