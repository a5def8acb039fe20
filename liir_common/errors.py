"""Errors that a person can act on, and what each means as an exit code."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class LiirError(Exception):
    """Something outside the program is wrong; the message says what was wanted, what came, what to do."""

    exit_code = 1


class ConfigError(LiirError, ValueError):
    """The configuration, or a command's arguments, cannot be used."""

    exit_code = 2


class UnreachableError(LiirError):
    """Another process did not answer."""

    exit_code = 3


class MissingError(LiirError):
    """What was asked for is not there, or no longer."""


class CorruptError(LiirError, ValueError):
    """Stored or received bytes are not what their digest or format says."""

    exit_code = 4


class DamagedError(CorruptError):
    """The learner's own copy of a checkpoint is damaged."""


class RefusedError(LiirError):
    """The learner will never serve this process; to start it again would not help."""

    exit_code = 5


class StorageError(LiirError):
    """A run directory, or other output, cannot be written to."""

    exit_code = 6


class DivergedError(LiirError):
    """Learning has diverged, and would again."""

    exit_code = 7


class ComputeError(LiirError):
    """The process that computes learner steps died; the last saved state is there."""

    exit_code = 8


class DiskFullError(StorageError):
    """There is no room for what should be written; later there may be."""


class EpisodeLostError(LiirError):
    """The game broke down in an episode but is there for another: the ticket can be played again."""


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Turn a `LiirError` into one line on stderr and its exit code; anything else stays a traceback."""
    try:
        yield
    except LiirError as error:
        say(f"error: {error}")
        raise SystemExit(error.exit_code) from None


def meaning(exit_code: int) -> str:
    """What an exit code says, in one sentence."""
    kinds = [kind for kind in LiirError.__subclasses__() if "exit_code" in vars(kind)]
    texts = {0: "asked to end"} | {kind.exit_code: kind.__doc__ for kind in kinds}
    return (texts.get(exit_code) or "an error that is not foreseen").rstrip(".")


def say(line: str) -> None:
    """Write a line to stderr; where that is a file on a full disk the line is lost and nothing else.

    Python's own stream would keep what it could not write, fail again at exit, and end with its own code.
    """
    with suppress(OSError):
        os.write(2, f"{line}\n".encode())


@contextmanager
def storage_explained(path: Path, then: str = "resume the run") -> Iterator[None]:
    """Turn an `OSError` of writing under `path` into a `StorageError` that says what to do, and `then` what.

    Raises:
        DiskFullError: the disk or the user's quota is full.
        StorageError: anything else that the operating system refused.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFullError(
                f"cannot write to {path}: {error.strerror}; free some space on its disk, then {then}"
            ) from error
        what = f"use {error.filename}" if error.filename else f"write to {path}"
        raise StorageError(f"cannot {what}: {error.strerror}; mend that, then {then}") from error
