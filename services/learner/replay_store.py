"""The replay on disk: what is new is appended, nothing is written twice.

Each file `replay-FIRST-STOP-DIGEST.safetensors` holds the episodes FIRST … STOP-1 of the run, as the frames
that the replay has in memory. A saved state has its first so many episodes in files that were written before
it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from liir_common.errors import CorruptError
from liir_common.files import check_digest, write_digested
from liir_common.types import Array


def join(frames: Sequence[bytes]) -> dict[str, Array]:
    """Frames as two arrays."""
    data = np.frombuffer(b"".join(frames), np.uint8)
    return {"frames": data, "sizes": np.array([len(frame) for frame in frames], np.int64)}


def split(arrays: Mapping[str, Array]) -> list[bytes]:
    """The frames that were joined."""
    stops = arrays["sizes"].cumsum()
    data = arrays["frames"].data
    return [bytes(data[stop - size : stop]) for stop, size in zip(stops, arrays["sizes"], strict=True)]


class ReplayStore:
    """The files of one run; nobody else may write to them."""

    def __init__(self, path: Path) -> None:
        """Go on with the files in the directory `path`."""
        self._path = path

    @property
    def stop(self) -> int:
        """Number after that of the newest episode on disk; 0 if there is none."""
        return max((stop for _, stop, _ in self._files()), default=0)

    def append(self, first: int, frames: Sequence[bytes]) -> None:
        """Keep the episodes from `first` on."""
        if frames:
            name = f"replay-{first:09d}-{first + len(frames):09d}.safetensors"
            write_digested(self._path / name, save(join(frames)))

    def load(self, first: int, stop: int) -> Iterator[tuple[int, list[bytes]]]:
        """The episodes `first` … `stop` - 1 file by file, each with its first number.

        Later ones, which no state knows, are removed.

        Raises:
            CorruptError: some are missing or cannot be read.
        """
        known = []
        for start, end, path in self._files():
            if start >= stop:
                path.unlink()
            elif end > first:
                known.append((start, end, path))
        missing = set(range(first, stop)).difference(*(range(start, end) for start, end, _ in known))
        if missing:
            raise CorruptError(
                f"{len(missing)} episodes of the replay, from {min(missing)} on, are missing under "
                f"{self._path}; restore them from a backup, or remove all states to train from the start"
            )
        for start, end, path in known:
            yield first, _read(path)[first - start : stop - start]
            first = end

    def prune(self, before: int) -> None:
        """Remove the files that have no episode from number `before` on."""
        for _, stop, path in self._files():
            if stop <= before:
                path.unlink()

    def _files(self) -> list[tuple[int, int, Path]]:
        found = [
            (re.match(r"replay-(\d+)-(\d+)", path.stem), path)
            for path in self._path.glob("replay-*.safetensors")
        ]
        return sorted((int(match[1]), int(match[2]), path) for match, path in found if match)


def _read(path: Path) -> list[bytes]:
    try:
        check_digest(path)
        return split(load_file(path))
    except (SafetensorError, CorruptError) as error:
        raise CorruptError(
            f"{path} cannot be read ({error}); restore it from a backup, or remove all states to train "
            "from the start"
        ) from None
