"""What an image says about the commit that it was built from."""

from __future__ import annotations

import subprocess
import sys

import pytest

from liir_common import build


@pytest.fixture(autouse=True)
def _forget() -> None:
    build.git_commit.cache_clear()


def test_an_image_names_its_commit_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_COMMIT", "0123456789ab")
    assert build.git_commit() == "0123456789ab"


def test_a_checkout_is_asked_when_the_environment_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_COMMIT", "")  # as an image that was built without the argument has it
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout
    assert head.startswith(build.git_commit().removesuffix("+"))


def test_outside_a_checkout_nobody_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GIT_COMMIT", raising=False)
    script = "from liir_common import build; build._PACKAGE = '/'; print(build.git_commit())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "unknown\n"
