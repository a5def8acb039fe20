"""Frozen checkpoints: a weights file in safetensors and a manifest that names its SHA-256.

The manifest is written last, so a checkpoint exists exactly when its manifest does. Before one is deleted
`deleted.csv` gets a line, its episode and SHA-256, so that a resumed run that comes to it again neither
freezes it anew nor differs from it unnoticed. A store may be a folder or any URL that fsspec knows.
"""

from __future__ import annotations

import bisect
import hashlib
import json
import re
import threading
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from liir_common.errors import CorruptError
from liir_common.files import append_line, write_atomic
from liir_common.types import EnvSpec

Tensors = Mapping[str, NDArray[np.float32]]

_LOST = "lost"
"""In place of the digest of a checkpoint that somebody does without, whatever it was."""
_EPISODE = attrgetter("episode")


@dataclass(frozen=True)
class Manifest:
    """What a checkpoint is and where it came from."""

    episode: int
    """Number of training episodes after which it was frozen; its name within the run."""
    policy_version: int
    env_steps: int
    run_id: str
    git_commit: str
    env_spec: Mapping[str, Any]
    """Fields of the `EnvSpec` it was trained on, simulator version included."""
    config: Mapping[str, Any]
    """The resolved configuration."""
    created: float
    """Unix time; not part of the weights file, so equal runs have equal digests."""
    sha256: str
    """Of the weights file, as hex."""
    size_bytes: int

    @property
    def spec(self) -> EnvSpec:
        """The environment it was trained on."""
        return EnvSpec.of(self.env_spec)

    def to_json(self) -> str:
        """The manifest file's text."""
        return json.dumps(asdict(self), indent=1, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Manifest:
        """Read a manifest.

        Raises:
            CorruptError: the text is not a manifest.
        """
        try:
            return cls(**json.loads(text))
        except (ValueError, TypeError) as error:
            raise CorruptError(f"not a checkpoint manifest: {error}") from None


def pack(tensors: Tensors) -> bytes:
    """The weights file: equal tensors give equal bytes."""
    return save({name: np.ascontiguousarray(tensors[name]) for name in sorted(tensors)})


def unpack(data: bytes, sha256: str) -> dict[str, NDArray[np.float32]]:
    """Tensors of a weights file.

    Raises:
        CorruptError: the bytes do not have that digest, or are not a weights file.
    """
    got = hashlib.sha256(data).hexdigest()
    if got != sha256:
        raise CorruptError(f"the weights file is corrupt: wanted SHA-256 {sha256}, got {got}; fetch it again")
    try:
        return load(data)
    except (SafetensorError, KeyError) as error:
        raise CorruptError(f"not a safetensors weights file: {error}") from None


def section(tensors: Tensors, prefix: str) -> dict[str, NDArray[np.float32]]:
    """The tensors named `prefix`.*, without the prefix: "policy" or "intrinsic"."""
    start = f"{prefix}."
    return {name.removeprefix(start): array for name, array in tensors.items() if name.startswith(start)}


class CheckpointStore:
    """The checkpoints of one run, which never change. One thread may publish while another deletes."""

    def __init__(self, url: str) -> None:
        """Use the folder or fsspec URL, made if missing."""
        self._fs, self._root = fsspec.core.url_to_fs(url)
        self._fs.makedirs(self._root, exist_ok=True)
        self._lock = threading.Lock()
        names = [path.rpartition("/")[2] for path in self._fs.ls(self._root, detail=False)]
        kept = _episodes(names, r"checkpoint-(\d+)\.json")
        self._manifests: list[Manifest] = []
        for episode in sorted(kept):
            self._manifests.append(
                _sharing(self._read_manifest(self._manifest_path(episode)), self._manifests)
            )
        # Of the many that a long run deletes, a number each is in memory.
        digests = {episode: sha256 for episode, sha256 in self._deletions() if episode not in kept}
        self._deleted = array("q", sorted(digests))
        self._left_over = _episodes(names, r"checkpoint-(\d+)\.safetensors") & digests.keys()
        self._lost = [*digests.values()].count(_LOST)

    @property
    def manifests(self) -> list[Manifest]:
        """All checkpoints that are there, oldest first; the list does not change any more."""
        return self._manifests

    @property
    def frozen(self) -> int:
        """How many checkpoints were ever frozen: the deleted ones, too, but not those given up as lost."""
        with self._lock:
            return len(self._manifests) + len(self._deleted) - self._lost

    def publish(self, manifest: Manifest, data: bytes) -> bool:
        """Write a checkpoint; false if a resumed run came to the same one again, deleted since or not.

        Raises:
            CorruptError: a checkpoint of that episode exists with other weights, so this run is not the
                one that the store belongs to, or is not reproducible.
        """
        sha256 = self._known_digest(manifest)
        if sha256 == manifest.sha256:
            return False
        if sha256:
            raise CorruptError(
                f"checkpoint {manifest.episode} exists with SHA-256 {sha256}, and this run made "
                f"{manifest.sha256}; use a new run directory, or resume with the build and machine "
                "type that began this one"
            )
        self._write(self._weights_path(manifest.episode), data)
        self._write(self._manifest_path(manifest.episode), manifest.to_json().encode())
        with self._lock:
            manifests = self._manifests.copy()
            bisect.insort(manifests, manifest, key=_EPISODE)
            self._manifests = manifests
        return True

    def delete(self, episode: int) -> None:
        """Remove a checkpoint for good; whoever dies in the middle leaves it there or not, never a part.

        Raises:
            KeyError: there is no such checkpoint.
        """
        self._append_deletion(self.find(episode))
        self._fs.rm(self._manifest_path(episode))
        with self._lock:
            bisect.insort(self._deleted, episode)
            self._manifests = [other for other in self._manifests if other.episode != episode]
        self._fs.rm(self._weights_path(episode))

    def remove_leftovers(self) -> None:
        """Remove the weights of deleted checkpoints that were there when the store was opened: who wanted to
        died before. For the store's owner; a mere reader might not be allowed to."""
        for episode in self._left_over:
            self._fs.rm(self._weights_path(episode))
        self._left_over = set()

    def __contains__(self, episode: int) -> bool:
        return self._there(episode) is not None

    def find(self, episode: int) -> Manifest:
        """The manifest of the checkpoint frozen after `episode` episodes.

        Raises:
            KeyError: there is none, or none any more.
        """
        if manifest := self._there(episode):
            return manifest
        if self._was_deleted(episode):
            raise KeyError(f"checkpoint {episode} was deleted, as the run's section checkpoints wants it")
        raise KeyError(f"no checkpoint of episode {episode}")

    def check_all(self, episodes: Sequence[int]) -> None:
        """See that the checkpoints of these episodes are there or were deleted.

        Raises:
            CorruptError: some are neither.
        """
        there = [manifest.episode for manifest in self._manifests]
        missing = np.setdiff1d(episodes, np.concatenate([there, self._deleted]))
        if missing.size:
            raise CorruptError(
                f"{missing.size} checkpoints, from {missing[0]} on, are missing under {self._root}; restore "
                f"them from a backup, or append a line {missing[0]},{_LOST} to {self._deleted_path} for each "
                "to go on without them"
            )

    def read(self, manifest: Manifest) -> bytes:
        """The weights file, checked.

        Raises:
            CorruptError: the stored bytes do not have the manifest's digest.
        """
        data: bytes = self._fs.cat_file(self._weights_path(manifest.episode))
        unpack(data, manifest.sha256)
        return data

    def _there(self, episode: int) -> Manifest | None:
        manifests = self._manifests  # which another thread may replace
        position = bisect.bisect_left(manifests, episode, key=_EPISODE)
        at = manifests[position : position + 1]
        return at[0] if at and at[0].episode == episode else None

    def _was_deleted(self, episode: int) -> bool:
        with self._lock:
            position = bisect.bisect_left(self._deleted, episode)
            return episode in self._deleted[position : position + 1]

    def _known_digest(self, manifest: Manifest) -> str:
        """SHA-256 of the checkpoint of that episode, there or deleted; empty if there never was one."""
        # In this order: another thread may delete it in between.
        if there := self._there(manifest.episode):
            return there.sha256
        if not self._was_deleted(manifest.episode):
            return ""
        digests = [sha256 for episode, sha256 in self._deletions() if episode == manifest.episode]
        return manifest.sha256 if _LOST in digests else [manifest.sha256, *digests][-1]

    def _deletions(self) -> Iterator[tuple[int, str]]:
        """Episode and digest of all that were deleted; of one that was put back there may be more."""
        if not self._fs.exists(self._deleted_path):
            return
        with self._fs.open(self._deleted_path, "r") as file:
            yield from _deletions(file)

    def _append_deletion(self, manifest: Manifest) -> None:
        path, line = self._deleted_path, f"{manifest.episode},{manifest.sha256}"
        if not self._fs.exists(path):
            self._write(path, f"episode,sha256\n{line}\n".encode())
        elif "file" in self._fs.protocol:
            append_line(Path(path), line)
        else:
            self._fs.pipe_file(path, self._fs.cat_file(path) + f"{line}\n".encode())

    def _read_manifest(self, path: str) -> Manifest:
        try:
            return Manifest.from_json(self._fs.cat_file(path).decode())
        except (CorruptError, UnicodeDecodeError) as error:
            (episode,) = _episodes([path.rpartition("/")[2]], r"checkpoint-(\d+)\.json")
            raise CorruptError(
                f"{path}: {error}; restore it from a backup, or remove it and append a line "
                f"{episode},{_LOST} to {self._deleted_path} to go on without it"
            ) from None

    def _weights_path(self, episode: int) -> str:
        return f"{self._root}/checkpoint-{episode:09d}.safetensors"

    @property
    def _deleted_path(self) -> str:
        return f"{self._root}/deleted.csv"

    def _manifest_path(self, episode: int) -> str:
        return f"{self._root}/checkpoint-{episode:09d}.json"

    def _write(self, path: str, data: bytes) -> None:
        if "file" in self._fs.protocol:
            write_atomic(Path(path), data)
        else:
            # Object stores show an object when it is complete.
            self._fs.pipe_file(path, data)


def given_up(folder: Path) -> set[int]:
    """Episodes of the checkpoints in `folder` that are lost and that somebody chose to go on without."""
    path = folder / "deleted.csv"
    lines = path.read_text().splitlines() if path.exists() else []
    return {episode for episode, sha256 in _deletions(lines) if sha256 == _LOST}


def _deletions(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    for line in lines:
        # Else it is the header, or what a dying process left; then the checkpoint is still there.
        if match := re.fullmatch(r"(\d+),(\w+)", line.strip()):
            yield int(match[1]), match[2]


def _episodes(names: Iterable[str], form: str) -> set[int]:
    """The numbers in the names of that form."""
    found = (re.fullmatch(form, name) for name in names)
    return {int(match[1]) for match in found if match}


def _sharing(manifest: Manifest, others: Sequence[Manifest]) -> Manifest:
    """The manifest, with what the newest other says alike: a run's configuration is in memory once."""
    shared = {
        name: getattr(others[-1], name)
        for name in ("env_spec", "config")
        if others and getattr(others[-1], name) == getattr(manifest, name)
    }
    return replace(manifest, **shared)
