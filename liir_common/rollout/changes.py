"""Arrays whose rows mostly repeat the row before, as what changes: a mark per value, then the changed values.

An observation of a battle keeps four of five values from one step to the next, and what is not sent is not
copied from buffer to buffer either. Bits are compared, so that every byte comes back.
"""

import math

import numpy as np
from numba import njit, types
from numba.cpython.unsafe.numbers import trailing_zeros
from numpy.typing import NDArray

from liir_common import kernel_cache

kernel_cache.install()

_WORD = np.dtype("<u4")
_BITS = 32


def pack(array: NDArray[np.float32]) -> bytes:
    """Little-endian words of 32 bits: the marks of `array` [R, ...], whole words for each row and the lowest
    bit first, then the changed values; the first row is compared with zeros."""
    rows = array.reshape(len(array), -1).view(_WORD)
    marks = len(rows) * _words_per_row(rows.shape[1])
    words = np.empty(marks + rows.size, _WORD)
    return words[: _pack(rows, words)].tobytes()


def unpack(data: bytes, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The array of that shape [R, ...], read-only as one that shares a message's bytes.

    Raises:
        ValueError: the words are not as many as their marks say, or there is a mark beyond a row's end.
    """
    out = np.empty((shape[0], math.prod(shape[1:])), _WORD)
    if len(data) % _WORD.itemsize or not _unpack(np.frombuffer(data, _WORD), out):
        raise ValueError(f"marks for {list(shape)} and a value for each of them, got {len(data)} other bytes")
    out.flags.writeable = False  # another type to numba, which would compile the checks for both
    return out.view(np.float32).reshape(shape)


@njit(cache=True, nogil=True)
def _words_per_row(width):
    return (width + _BITS - 1) // _BITS


@njit(cache=True, nogil=True)
def _pack(rows, words):
    """Writes `words`; returns how many."""
    per_row = _words_per_row(rows.shape[1])
    count = len(rows) * per_row
    words[:count] = 0
    for r in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            value = rows[r, j]
            changed = value != (rows[r - 1, j] if r > 0 else types.uint32(0))
            # Written in any case, and over again if it has not changed: a branch is often guessed wrong.
            words[count] = value
            count += changed
            words[r * per_row + j // _BITS] |= types.uint32(changed) << types.uint32(j % _BITS)
    return count


@njit(cache=True, nogil=True)
def _unpack(words, rows):
    """Whether marks and values belong together; only then are all `rows` written."""
    per_row = _words_per_row(rows.shape[1])
    count = len(rows) * per_row
    if len(words) < count:
        return False
    for r in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[r, j] = rows[r - 1, j] if r > 0 else types.uint32(0)
        for w in range(per_row):
            marks = words[r * per_row + w]
            while marks != 0:
                j = w * _BITS + trailing_zeros(marks)  # type: ignore[call-arg]
                if j >= rows.shape[1] or count == len(words):
                    return False
                rows[r, j] = words[count]
                count += 1
                marks &= marks - types.uint32(1)
    return count == len(words)
