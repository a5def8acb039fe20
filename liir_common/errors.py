"""Errors that a person can act on, and what each means as an exit code."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager


class LiirError(Exception):
    """Something outside the program is wrong; the message says what was wanted, what came, what to do."""

    exit_code = 1


class ConfigError(LiirError, ValueError):
    """The configuration, or a command's arguments, cannot be used."""

    exit_code = 2


class UnreachableError(LiirError):
    """Another process did not answer."""

    exit_code = 3


class CorruptError(LiirError, ValueError):
    """Stored or received bytes are not what their digest or format says."""

    exit_code = 4


class RefusedError(LiirError):
    """The learner will never serve this process; to start it again would not help."""

    exit_code = 5


class EpisodeLostError(LiirError):
    """The game broke down in an episode but is there for another: the ticket can be played again."""


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Turn a `LiirError` into one line on stderr and its exit code; anything else stays a traceback."""
    try:
        yield
    except LiirError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
