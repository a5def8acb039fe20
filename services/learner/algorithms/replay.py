"""The newest episodes of a run, to be learned from again and again."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence

import numpy as np
import zstandard

from liir_common.types import TRAJECTORY_ARRAYS, Batch, EnvSpec, Trajectory, expected_shape

# What an off-policy method reads; the behaviour policy's probabilities are not among it.
_ARRAYS = [name for name in TRAJECTORY_ARRAYS if name != "log_mu"]
_HEAD = struct.Struct("<i??")
"""Steps, terminated, truncated"""


class Replay:
    """A ring of episodes, each one a zstd frame without padding: a seventh of the size, and every bit kept.

    Episodes have numbers from 0 on, over the whole run; the newest `capacity` of them are here.
    """

    def __init__(self, spec: EnvSpec, capacity: int) -> None:
        self._spec = spec
        self._frames: deque[bytes] = deque(maxlen=capacity)
        self.total = 0
        """Episodes that have ever been added"""

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def first(self) -> int:
        """Number of the oldest episode that is here."""
        return self.total - len(self._frames)

    def add(self, batch: Batch) -> None:
        """Take in the episodes of `batch`, which has to fit (see `check`)."""
        pack = zstandard.ZstdCompressor(level=1).compress
        for b, length in enumerate(batch.filled.sum(1).tolist()):
            head = _HEAD.pack(length, bool(batch.terminated[b].any()), bool(batch.truncated[b].any()))
            self._frames.append(pack(head + b"".join(_bytes(batch, name, b, length) for name in _ARRAYS)))
            self.total += 1

    def sample(self, indices: Sequence[int]) -> Batch:
        """The episodes at these ascending places, 0 the oldest, without log μ, ε and policy version."""
        return Batch.from_trajectories([self._unpack(index) for index in indices], epsilon=0.0)

    def frames(self, first: int) -> list[bytes]:
        """The episodes from number `first` on, which has to be here or to come next."""
        return [self._frames[index] for index in range(first - self.first, len(self._frames))]

    def extend(self, first: int, frames: Sequence[bytes]) -> None:
        """Take in the episodes from number `first` on; unless they come next, nothing else stays."""
        if first != self.total:
            self._frames.clear()
        self._frames.extend(frames)
        self.total = first + len(frames)

    def _unpack(self, index: int) -> Trajectory:
        data = zstandard.ZstdDecompressor().decompress(self._frames[index])
        length, terminated, truncated = _HEAD.unpack_from(data)
        arrays, at = {"log_mu": np.zeros((length, self._spec.n_agents), np.float32)}, _HEAD.size
        for name in _ARRAYS:
            shape = expected_shape(name, self._spec, length)
            array = np.frombuffer(data, TRAJECTORY_ARRAYS[name][0], int(np.prod(shape)), at)
            arrays[name] = array.reshape(shape)
            at += array.nbytes
        return Trajectory(index, 0, terminated=terminated, truncated=truncated, info={}, **arrays)


def _bytes(batch: Batch, name: str, b: int, length: int) -> bytes:
    dtype, axes = TRAJECTORY_ARRAYS[name]
    rows = getattr(batch, name)[b, : length + (axes[0] == "T+1")]
    return np.ascontiguousarray(rows, dtype).tobytes()
