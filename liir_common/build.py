"""What this program is: both ends of a stream must be the same build to play the same episodes."""

import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path


@cache
def build() -> str:
    """Version of the package and, in a git checkout, the commit ("+" marks uncommitted changes)."""
    return f"{version('liir-service')}-{git_commit()}"


@cache
def git_commit() -> str:
    """Commit of the checkout this code runs from, or "unknown" outside one."""
    root = Path(__file__).parent.parent
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
