"""What this program is: which episodes it plays, and which commit it runs from."""

import hashlib
import os
import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path

_PACKAGE = Path(__file__).parent


@cache
def source_digest() -> str:
    """SHA-256 of all sources that episodes are compiled from, as hex."""
    files = [_PACKAGE / "rng.py", _PACKAGE / "seeds.py"]
    for folder in ("battle", "rollout"):
        files += sorted((_PACKAGE / folder).glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@cache
def build() -> str:
    """Both ends of a stream must have the same: equal builds play the same episodes."""
    return f"{version('liir-service')}-{source_digest()[:12]}"


@cache
def git_commit() -> str:
    """Commit this runs from ("+" marks uncommitted changes): of the checkout, or as GIT_COMMIT has it.

    The environment variable is for images, which hold no checkout; without either it is "unknown".
    """
    if commit := os.environ.get("GIT_COMMIT"):
        return commit
    command = ["git", "-C", str(_PACKAGE), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
