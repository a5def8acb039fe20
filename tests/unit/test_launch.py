"""What the launcher says of a process that died."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from liir_common.config import PLAINTEXT
from liir_common.launch import Launcher, LocalService
from tests.e2e.service import wait_for

PROGRAM = """
import os, signal, sys
import structlog
from liir_common import logs
from liir_common.errors import StorageError, exit_on_error

logs.configure("test")
structlog.get_logger().info("tested", episode=100)
{last}
"""


class Program(LocalService):
    """A process of the run whose program is its argument."""

    @property
    def command(self) -> list[str]:
        return [sys.executable, "-c", *self.arguments]


@pytest.mark.parametrize(
    ("last", "parts"),
    [
        ("{}[7]", ["code 1 (an error that is not foreseen)", "'tested'", "last exception: KeyError: 7;"]),
        (
            "with exit_on_error():\n    raise StorageError('no room')",
            ["code 6 (The run directory cannot be written to)", "last exception: error: no room;"],
        ),
        (
            "os.kill(os.getpid(), signal.SIGKILL)",
            ["code -9 (SIGKILL) in the phase 'tested'", "last exception: none in its log;", "episode"],
        ),
    ],
)
def test_an_obituary_has_code_phase_exception_and_log(tmp_path: Path, last: str, parts: list[str]) -> None:
    service = Program("evaluator", [PROGRAM.replace("{last}", last)], tmp_path)
    service.log_path.parent.mkdir()
    service.log_path.write_text("ValueError: of the incarnation before\n")
    service.start()
    wait_for(lambda: service.exit_code is not None, "the end of the program")
    text = service.obituary()
    assert text.startswith("the evaluator ended with")
    for part in parts:
        assert part in text
    assert "incarnation before" not in text


class Silent(Program):
    """A learner that never serves."""

    def address(self) -> None:
        return None


def test_a_signal_before_the_learner_serves_ends_the_start(tmp_path: Path) -> None:
    learner = Silent("learner", ["import time; time.sleep(60)"], tmp_path)
    others = [Program(name, ["raise SystemExit"], tmp_path) for name in ("actor", "evaluator")]
    launcher = Launcher(tmp_path, learner, *others, PLAINTEXT)
    launcher._on_signal(signal.SIGINT, None)
    try:
        assert launcher._start(evaluate=True) is None
    finally:
        learner.end()
    assert [service.exit_code for service in others] == [None, None], "neither was started"


def test_what_the_learner_said_of_itself_counts_more_than_its_log(tmp_path: Path) -> None:
    service = LocalService("learner", [], tmp_path)
    service.log_path.parent.mkdir()
    service.log_path.touch()
    service.phase = "learner updates"
    assert "in the phase 'learner updates'" in service.obituary()
