"""What the launcher says of a process that died, and when it starts one again."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from liir_common import launch
from liir_common.config import PLAINTEXT
from liir_common.display import WinRates
from liir_common.errors import (
    ConfigError,
    CorruptError,
    DivergedError,
    LiirError,
    RefusedError,
    StorageError,
    UnreachableError,
)
from liir_common.launch import Launcher, LocalService, Service
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
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
            [
                "code 6 (A run directory, or other output, cannot be written to)",
                "last exception: no room;",
            ],
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


def test_an_obituary_says_nothing_twice(tmp_path: Path) -> None:
    service = Program("learner", ["raise SystemExit('error: unknown map')"], tmp_path)
    service.start()
    wait_for(lambda: service.exit_code is not None, "the end of the program")
    assert service.obituary().count("unknown map") == 1
    assert service.obituary().endswith(f"last exception: unknown map; {service.log_path} has no more")


def test_what_the_learner_said_of_itself_counts_more_than_its_log(tmp_path: Path) -> None:
    service = LocalService("learner", [], tmp_path)
    service.log_path.parent.mkdir()
    service.log_path.touch()
    service.phase = "learner updates"
    assert "in the phase 'learner updates'" in service.obituary()


class Mortal(Service):
    """A process of the run that ends when the test says so."""

    exit_code: int | None = None
    starts = 0

    def start(self) -> None:
        self.exit_code = None
        self.starts += 1

    def address(self) -> str | None:
        return None

    def end(self) -> None:
        pass

    def last_words(self) -> str:
        return ""


def test_a_signal_before_the_learner_serves_ends_the_start(tmp_path: Path) -> None:
    learner, actors, evaluator = (Mortal(name, [], tmp_path) for name in ("learner", "actor", "evaluator"))
    launcher = Launcher(tmp_path, learner, actors, evaluator, PLAINTEXT)
    launcher._on_signal(signal.SIGINT, None)
    assert launcher._start(evaluate=True) is None
    assert (learner.starts, actors.starts, evaluator.starts) == (1, 0, 0)


def test_where_one_cannot_be_ended_the_others_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[str] = []

    class Stuck(Mortal):
        def end(self) -> None:
            ended.append(self.name)
            raise OSError(self.name)

    monkeypatch.setattr(Launcher, "_start", Mock(return_value=None))
    launcher = Launcher(
        tmp_path, *(Stuck(name, [], tmp_path) for name in ("learner", "actor", "evaluator")), PLAINTEXT
    )
    with pytest.raises(OSError, match="learner"):
        launcher.run(evaluate=True)
    assert ended == ["evaluator", "actor", "learner"]


class Watched:
    """A launcher that watches three processes, by a clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
        self.learner = Mortal("learner", [], path)
        self.actors = Mortal("actor", [], path)
        self.evaluator = Mortal("evaluator", [], path)
        self._launcher = Launcher(path, self.learner, self.actors, self.evaluator, PLAINTEXT)
        self._now = Mock(return_value=1000.0)
        monkeypatch.setattr(launch, "time", Mock(monotonic=self._now))

    def look(self, after_s: float) -> None:
        """Let time pass, then look after the processes as the launcher does while it watches."""
        self._now.return_value += after_s
        self._launcher._revive()

    def die(self, code: int, after_s: float = 1.0) -> None:
        """The evaluator ends with that code."""
        self.evaluator.exit_code = code
        self.look(after_s)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Watched:
    return Watched(monkeypatch, tmp_path)


@pytest.mark.parametrize("kind", [ConfigError, CorruptError, RefusedError, StorageError, DivergedError])
def test_what_would_only_end_in_the_same_way_is_not_started_again(
    watched: Watched, kind: type[LiirError]
) -> None:
    with pytest.raises(LiirError, match="the evaluator ended with") as caught:
        watched.die(kind.exit_code)
    assert caught.value.exit_code == kind.exit_code
    assert watched.evaluator.starts == 0


@pytest.mark.parametrize("code", [1, -9])
def test_the_fourth_death_within_five_minutes_is_the_last(watched: Watched, code: int) -> None:
    for _ in range(3):
        watched.die(code, after_s=99.0)
    assert watched.evaluator.starts == 3
    with pytest.raises(LiirError, match="the evaluator ended with") as caught:
        watched.die(code, after_s=101.0)
    assert caught.value.exit_code == code
    assert (watched.learner.starts, watched.actors.starts, watched.evaluator.starts) == (0, 0, 3)


def test_rare_deaths_never_end_a_run(watched: Watched) -> None:
    for _ in range(20):
        watched.die(1, after_s=100.0)
    assert watched.evaluator.starts == 20


def test_one_that_found_no_learner_tries_for_ever(watched: Watched) -> None:
    for _ in range(20):
        watched.die(UnreachableError.exit_code)
    assert watched.evaluator.starts == 20


def test_one_that_left_in_peace_is_missed_only_while_the_learner_goes_on(watched: Watched) -> None:
    watched.evaluator.exit_code = watched.actors.exit_code = 0
    watched.look(0.0)
    watched.look(10.0)
    assert (watched.evaluator.starts, watched.actors.starts) == (0, 0), "the learner may follow yet"
    watched.look(0.5)
    assert (watched.evaluator.starts, watched.actors.starts) == (1, 1)
    watched.evaluator.exit_code = watched.learner.exit_code = 0
    watched.look(0.0)
    watched.look(100.0)
    assert (watched.evaluator.starts, watched.learner.starts) == (1, 0)


def test_a_run_directory_that_is_a_file_is_explained(tmp_path: Path) -> None:
    (tmp_path / "run").touch()
    with pytest.raises(StorageError, match=r"cannot use .*run.*: Not a directory"):
        LocalService("learner", [], tmp_path / "run").start()


def test_the_newest_run_is_one_that_made_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not one whose port was taken when it began."""
    monkeypatch.chdir(tmp_path)
    for name, files in (("trained", ("run.json", "metrics.csv")), ("failed", ("run.json",))):
        (tmp_path / "runs" / name).mkdir(parents=True)
        for file in files:
            (tmp_path / "runs" / name / file).touch()
    assert launch._newest_run() == Path("runs/trained")
    (tmp_path / "runs/trained/metrics.csv").unlink()
    with pytest.raises(ConfigError, match="no run under runs/ with a step to go on from"):
        launch._newest_run()


def test_only_tests_that_are_not_shown_yet_are_asked_for(tmp_path: Path) -> None:
    learner, actors, evaluator = (Mortal(name, [], tmp_path) for name in ("learner", "actor", "evaluator"))
    launcher = Launcher(tmp_path, learner, actors, evaluator, PLAINTEXT)
    stats = checkpoint_pb2.EpisodeStats(episodes=20, wins=1)
    tested = [
        checkpoint_pb2.Evaluation(episode=episode, greedy=stats, sampled=stats) for episode in range(1, 9)
    ]
    checkpoints, display, win_rates = Mock(), Mock(), WinRates()
    checkpoints.evaluations.side_effect = [tested[:6], [], tested[6:]]
    for _ in range(3):
        launcher._show(display, Mock(), checkpoints, win_rates)
    assert [call.args for call in checkpoints.evaluations.call_args_list] == [(0,), (6,), (6,)]
    assert [evaluation.episode for evaluation in win_rates.newest] == [4, 5, 6, 7, 8]
    assert display.show.call_count == 3
