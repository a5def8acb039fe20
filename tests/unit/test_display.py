"""What a person sees while a run trains, on a terminal and off it."""

import io
import json

import pytest
import structlog
from rich.console import Console

from liir_common import logs
from liir_common.display import LivePanel, LogLines, WinRates, make_display, rows
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, training_pb2

STATUS = training_pb2.GetStatusResponse(
    phase=training_pb2.PHASE_UPDATING,
    learner_step=12,
    env_steps=250_000,
    total_env_steps=1_000_000,
    episodes=384,
    actors=32,
    tickets_outstanding=5,
    checkpoints=3,
    evaluations=2,
    env_steps_per_second=10_000.0,
    metrics={"policy_lag": 0.0, "return_mean": 12.5, "length_mean": 24.0, "reward_ratio": 0.016},
)


def win_rates(*wins: int) -> WinRates:
    """So many greedy wins of 20, one checkpoint after the other."""
    shown = WinRates()
    for i, won in enumerate(wins):
        greedy, sampled = (checkpoint_pb2.EpisodeStats(episodes=20, wins=n) for n in (won, 5))
        shown.add(checkpoint_pb2.Evaluation(episode=100 * (i + 1), greedy=greedy, sampled=sampled))
    return shown


def test_terminal_shows_all_of_it() -> None:
    output = io.StringIO()
    console = Console(file=output, force_terminal=True, width=100, color_system=None)
    display = make_display("title", console)
    assert isinstance(display, LivePanel)
    display.show(training_pb2.GetStatusResponse(), WinRates())
    display.show(STATUS, win_rates(2, 19))
    display.close()
    shown = output.getvalue()
    for text in (
        "title",
        "learner updates",
        "250,000 of 1,000,000, 10,000/s",
        "12 (384 episodes, lag 0)",
        "12.50 over 24 steps",
        "0.016",
        "10% 95% (best 95%; sampled 25%)",
        "2 of 3 tested",
        "32 (5 tickets out)",
        "0:01:15",
    ):
        assert text in shown


@pytest.mark.parametrize(
    ("wins", "text"),
    [
        ((), "no checkpoint tested yet"),
        ((0,), "0% (best 0%; sampled 25%)"),
        ((18, 1, 2, 3, 4), "90% 5% 10% 15% 20% (best 90%; sampled 25%)"),
        ((18, 1, 2, 3, 4, 5, 6), "10% 15% 20% 25% 30% (best 90%; sampled 25%)"),
    ],
)
def test_the_newest_five_and_the_best_of_all_are_shown(wins: tuple[int, ...], text: str) -> None:
    assert rows(STATUS, win_rates(*wins))["win rate"] == text


def test_what_is_shown_does_not_grow() -> None:
    shown = win_rates(20, *[1] * 1000)
    assert [evaluation.episode for evaluation in shown.newest] == [99_700, 99_800, 99_900, 100_000, 100_100]
    assert shown.best == 1.0


def test_elsewhere_a_json_line_now_and_then() -> None:
    display = make_display("title", Console(file=io.StringIO()))
    assert isinstance(display, LogLines)
    with structlog.testing.capture_logs() as lines:
        display.show(STATUS, win_rates(2, 19))
        display.show(STATUS, win_rates(2, 19))
    assert len(lines) == 1
    line = json.loads(json.dumps(lines[0]))
    assert line["env_steps"] == 250_000
    assert line["env_steps_per_second"] == 10_000
    assert line["greedy_win_rate"] == 0.95
    assert line["sampled_win_rate"] == 0.25
    assert line["reward_ratio"] == 0.016


def test_logs_are_json_lines_off_a_terminal(capfd) -> None:  # type: ignore[no-untyped-def]
    try:
        logs.configure("test")
        try:
            raise ValueError("what went wrong")
        except ValueError:
            structlog.get_logger().exception("failed", step=3)
    finally:
        structlog.reset_defaults()
        structlog.contextvars.clear_contextvars()
    line = json.loads(capfd.readouterr().err)
    assert (line["process"], line["event"], line["step"]) == ("test", "failed", 3)
    assert "what went wrong" in json.dumps(line["exception"])
