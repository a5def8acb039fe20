"""Write a recording in the format that the file's name asks for."""

from __future__ import annotations

from pathlib import Path

from liir_common.errors import ConfigError
from liir_common.files import write_atomic
from liir_common.replay.animation import write_gif, write_mp4
from liir_common.replay.page import write_page
from liir_common.replay.record import Recording

FORMATS = {
    ".html": lambda recording: write_page(recording).encode(),
    ".gif": write_gif,
    ".mp4": write_mp4,
}


def check_output(path: Path) -> None:
    """Refuse early what `write` could not do.

    Raises:
        ConfigError: the format is unknown, or the folder does not exist.
    """
    if path.suffix not in FORMATS:
        raise ConfigError(f"a replay is written as one of {', '.join(FORMATS)}, got {path}")
    if not path.parent.is_dir():
        raise ConfigError(f"{path.parent} is no folder; make it first")


def write(recording: Recording, path: Path) -> None:
    """Write the recording to `path`.

    Raises:
        ConfigError: as `check_output`, or a package that the format needs is not installed.
    """
    check_output(path)
    write_atomic(path, FORMATS[path.suffix](recording))
