"""What a person sees while a run trains: a live panel on a terminal, a JSON line now and then elsewhere."""

from __future__ import annotations

import time
from collections import deque
from typing import Protocol

import structlog
from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, training_pb2

log = structlog.get_logger()

_LINE_EVERY_S = 10.0
_PHASES = {
    training_pb2.PHASE_COLLECTING: "actors play",
    training_pb2.PHASE_UPDATING: "learner updates",
    training_pb2.PHASE_EVALUATING: "last checkpoints are tested",
    training_pb2.PHASE_STOPPING: "stopping",
    training_pb2.PHASE_COMPLETE: "complete",
}


def phase_name(status: training_pb2.GetStatusResponse) -> str:
    """What the learner is doing, in words."""
    return _PHASES.get(status.phase, "starting")


class WinRates:
    """What is shown of the evaluations so far, however many there are."""

    def __init__(self) -> None:
        """None yet."""
        self.newest: deque[checkpoint_pb2.Evaluation] = deque(maxlen=5)
        self.best = 0.0
        """Greedy win rate, of all."""

    def add(self, evaluation: checkpoint_pb2.Evaluation) -> None:
        """That of the next checkpoint."""
        self.newest.append(evaluation)
        self.best = max(self.best, _win_rate(evaluation.greedy))


class Display(Protocol):
    """Shows how far a run is."""

    def show(self, status: training_pb2.GetStatusResponse, win_rates: WinRates) -> None:
        """Show this now."""

    def close(self) -> None:
        """Leave the terminal as it was."""


def make_display(title: str, console: Console) -> Display:
    """A live panel if the console is a terminal, log lines otherwise."""
    return LivePanel(title, console) if console.is_terminal else LogLines()


class LivePanel:
    """Redraws one table in place."""

    def __init__(self, title: str, console: Console) -> None:
        """Begin drawing."""
        self._title = title
        self._live = Live(console=console, refresh_per_second=4, transient=False)
        self._live.start()

    def show(self, status: training_pb2.GetStatusResponse, win_rates: WinRates) -> None:
        """Redraw."""
        table = Table(title=self._title, show_header=False, title_justify="left", min_width=64)
        table.add_column(style="dim")
        table.add_column()
        table.add_row(
            "progress", ProgressBar(total=status.total_env_steps, completed=status.env_steps, width=44)
        )
        for name, value in rows(status, win_rates).items():
            table.add_row(name, value)
        self._live.update(table)

    def close(self) -> None:
        """Stop drawing; the last table stays."""
        self._live.stop()


class LogLines:
    """Writes the same figures as a structured log line every ten seconds."""

    def __init__(self) -> None:
        """Begin; the first call of `show` writes a line."""
        self._next = 0.0

    def show(self, status: training_pb2.GetStatusResponse, win_rates: WinRates) -> None:
        """Write a line if it is time for one."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + _LINE_EVERY_S
            log.info("training", **_figures(status, win_rates))

    def close(self) -> None:
        """Nothing to undo."""


def _figures(status: training_pb2.GetStatusResponse, win_rates: WinRates) -> dict[str, object]:
    """What a log line holds."""
    shown = ("return_mean", "length_mean", "policy_lag", "reward_ratio")
    figures: dict[str, object] = {
        "phase": phase_name(status),
        "env_steps": status.env_steps,
        "total_env_steps": status.total_env_steps,
        "env_steps_per_second": round(status.env_steps_per_second),
        "learner_step": status.learner_step,
        "episodes": status.episodes,
        "actors": status.actors,
        "checkpoints": status.checkpoints,
        "evaluations": status.evaluations,
        **{name: round(status.metrics[name], 4) for name in shown if name in status.metrics},
    }
    if win_rates.newest:
        figures["greedy_win_rate"] = _win_rate(win_rates.newest[-1].greedy)
        figures["sampled_win_rate"] = _win_rate(win_rates.newest[-1].sampled)
    return figures


def rows(status: training_pb2.GetStatusResponse, win_rates: WinRates) -> dict[str, str]:
    """Names and values of what is shown."""
    newest = status.metrics
    rate, lag = status.env_steps_per_second, newest["policy_lag"]
    return {
        "phase": phase_name(status),
        "env steps": f"{status.env_steps:,} of {status.total_env_steps:,}, {rate:,.0f}/s",
        "learner step": f"{status.learner_step:,} ({status.episodes:,} episodes, lag {lag:.0f})",
        "return": f"{newest['return_mean']:.2f} over {newest['length_mean']:.0f} steps an episode",
        "intrinsic / extrinsic": f"{newest['reward_ratio']:.3f}" if "reward_ratio" in newest else "–",
        "win rate": _win_rates(win_rates),
        "checkpoints": f"{status.evaluations:,} of {status.checkpoints:,} tested",
        "actors": f"{status.actors} ({status.tickets_outstanding} tickets out)",
        "time left": _time_left(status),
    }


def _win_rates(win_rates: WinRates) -> str:
    if not win_rates.newest:
        return "no checkpoint tested yet"
    latest = " ".join(f"{_win_rate(evaluation.greedy):.0%}" for evaluation in win_rates.newest)
    return f"{latest} (best {win_rates.best:.0%}; sampled {_win_rate(win_rates.newest[-1].sampled):.0%})"


def _win_rate(stats: checkpoint_pb2.EpisodeStats) -> float:
    return float(stats.wins / stats.episodes)


def _time_left(status: training_pb2.GetStatusResponse) -> str:
    missing = max(0, status.total_env_steps - status.env_steps)
    if not status.env_steps_per_second:
        return "–" if missing else "0:00:00"
    seconds = int(missing / status.env_steps_per_second)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
