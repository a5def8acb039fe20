"""A small disk to fill."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 MiB of its own; the rest of the machine never notices that it is full."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    if mounted.returncode:
        pytest.fail(
            f"wanted to mount a tmpfs: {mounted.stderr.strip()}; `make test-faults` runs this as root may"
        )
    yield path
    # Lazily: a process that is about to end may still have its directory there.
    subprocess.run(["umount", "--lazy", str(path)], check=True)
