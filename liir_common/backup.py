"""`liir backup`: a copy of a run that may go on meanwhile, from which the run can be resumed.

A state counts checkpoints and learner steps and needs episodes of the replay; before a checkpoint is deleted
its test is in evaluations.csv and then a line of it in deleted.csv. So the state is read first, then the
checkpoints, then deleted.csv, and the other tables last: what is read later may know more, never less, than
what counts on it.
"""

from __future__ import annotations

import io
import os
import tarfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import BinaryIO

from liir_common.config import holds_run
from liir_common.errors import ConfigError
from liir_common.files import complete_bytes

Member = tuple[Path, BinaryIO, int]
"""Where it was, and of the open file so many bytes."""


def back_up(run_dir: Path, archive: BinaryIO) -> None:
    """Write a run, as a folder of its name, to a compressed tar archive.

    Raises:
        ConfigError: there is no run at `run_dir`.
    """
    run_dir = run_dir.resolve()
    if not holds_run(run_dir):
        raise ConfigError(f"there is no run at {run_dir}; name the folder that has its run.json")
    with ExitStack() as stack, tarfile.open(fileobj=archive, mode="w|gz") as tar:
        for path, file, size in _members(run_dir, stack):
            member = tarfile.TarInfo(str(path.relative_to(run_dir.parent)))
            member.size, member.mtime = size, int(time.time())
            tar.addfile(member, file)


def _members(run_dir: Path, stack: ExitStack) -> Iterator[Member]:
    yield from _state(run_dir / "state", stack)
    for name in ("run.json", "config.yaml"):
        yield _whole(run_dir / name)
    yield from _checkpoints(run_dir / "checkpoints")
    for path in (run_dir / "metrics.csv", run_dir / "evaluations.csv"):
        if path.exists():
            # Without a row that is just being written.
            yield path, stack.enter_context(path.open("rb")), complete_bytes(path)


def _state(folder: Path, stack: ExitStack) -> list[Member]:
    """The saved states with the replay that they need, held open, so that the learner may remove them."""
    while True:
        paths = sorted(folder.glob("*.safetensors"))
        with suppress(FileNotFoundError):
            files = [stack.enter_context(path.open("rb")) for path in paths]
            if sorted(folder.glob("*.safetensors")) == paths:  # nothing was saved or removed in between
                return [
                    (path, file, os.fstat(file.fileno()).st_size)
                    for path, file in zip(paths, files, strict=True)
                ]


def _checkpoints(folder: Path) -> Iterator[Member]:
    for manifest in sorted(folder.glob("*.json")):
        # In this order: weights are removed after their manifest.
        for path in (manifest.with_suffix(".safetensors"), manifest):
            with suppress(FileNotFoundError):  # deleted meanwhile
                yield _whole(path)
    with suppress(FileNotFoundError):  # none was ever
        yield _whole(folder / "deleted.csv")


def _whole(path: Path) -> Member:
    data = path.read_bytes()
    return path, io.BytesIO(data), len(data)
