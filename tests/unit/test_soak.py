"""`make soak` tells a leak from noise, and misses no process."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext

import grpc
import numpy as np
import psutil
import pytest

from liir_common.rpc.gen.liir.v1 import training_pb2
from tests.e2e import service
from tests.faults import soak


def grows(name: str, figure: str, minutes: float, per_hour: float, seed: int, *, noise: float = 2) -> bool:
    """Whether a figure is reported that grows so much under noise, which lasts for 20 s."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0, 60 * minutes, soak.EVERY_S)
    noises = np.repeat(rng.normal(0, noise, len(seconds)), 10)[: len(seconds)]
    values = 200 + per_hour * seconds / 3600 + noises
    growth = soak.growth(list(zip(seconds, values, strict=True)))
    assert growth is not None
    return soak.most(name)[figure].is_exceeded(growth)


@pytest.mark.parametrize(("minutes", "per_hour"), [(4, 400), (60, 12), (600, 2)])
def test_a_leak_is_told_from_noise(minutes: float, per_hour: float) -> None:
    leaks = [grows("learner", "memory, MiB", minutes, per_hour, seed) for seed in range(50)]
    steady = [grows("learner", "memory, MiB", minutes, 0, seed) for seed in range(50)]
    assert np.mean(leaks) > 0.9
    assert np.mean(steady) < 0.1


def test_of_our_threads_and_descriptors_a_few_an_hour_are_growth_of_rays_not() -> None:
    for figure in ("threads", "descriptors"):
        assert grows("learner", figure, 60, 6, 0, noise=0.3)
        assert grows("a stranger", figure, 60, 6, 0, noise=0.3)
        assert not grows("gcs_server", figure, 60, 4, 0, noise=0.3)
    assert grows("gcs_server", "threads", 60, 30, 0, noise=0.3)


def test_one_thread_more_is_no_growth() -> None:
    growth = soak.growth([(second, 10.0 + (second > 400)) for second in range(0, 720, 2)])
    assert growth
    assert growth.per_hour > 1
    assert not soak.MOST_OURS["threads"].is_exceeded(growth)


def test_a_process_that_was_there_briefly_has_no_slope() -> None:
    assert soak.growth([(second, 10.0) for second in range(0, 20, 2)]) is None


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("/v/bin/python3.11 /v/bin/liir train --run-dir r --set seed=7", "launcher"),
        ("/v/bin/python -m services.learner --run-dir r", "learner"),
        ("/v/bin/python -m services.learner.compute 15", "compute"),
        ("ray::ActorProcess.run", "actor"),
        ("/v/ray/core/src/ray/raylet/raylet --agent_command=/v/ray/dashboard/agent.py", "raylet"),
        ("/v/bin/python -u /v/ray/autoscaler/_private/monitor.py --logs-dir=l", "monitor"),
        ("/v/bin/python -u /v/ray/_private/log_monitor.py --session-dir=s", "log monitor"),
        ("/v/bin/python /v/ray/dashboard/dashboard.py --host=127.0.0.1", "dashboard"),
        ("ray::DashboardAgent", "dashboard agent"),
        ("ray::IDLE", "ray::IDLE"),
        ("/usr/bin/python3 -u /a/stranger.py --with options", "python3 -u stranger.py -"),
        ("", "no command"),
    ],
)
def test_a_process_goes_by_its_kind_or_else_by_its_command(command: str, kind: str) -> None:
    assert soak.kind_of(command) == kind
    assert sum(part in command for part in (soak.OURS | soak.RAYS).values()) <= 1


PARENT = """
import subprocess, sys
for line in sys.stdin:
    subprocess.Popen(["sleep", line.strip()])
"""


@pytest.fixture
def parent(monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    """A stand-in for the launcher; it starts a process for every line that it is given."""
    monkeypatch.setattr(soak, "OURS", {"launcher": "/liir train "})
    arguments = [sys.executable, "-c", PARENT, "/liir train ", "x"]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            for child in psutil.Process(process.pid).children() if process.poll() is None else ():
                child.kill()
            process.kill()


def start_a_child(parent: subprocess.Popen[str]) -> psutil.Process:
    assert parent.stdin
    parent.stdin.write("60\n")
    parent.stdin.flush()
    service.wait_for(lambda: bool(service.descendants(parent, "sleep 60")), "the child")
    return service.descendants(parent, "sleep 60")[0]


def test_a_process_that_comes_later_is_sampled_under_its_own_name(parent: subprocess.Popen[str]) -> None:
    samples, family = soak.Samples(), soak.Family(psutil.Process(parent.pid))
    family.sample(samples, 0.0, thread_names=True)
    child = start_a_child(parent)
    family.sample(samples, 2.0, thread_names=True)
    child.kill()
    # Its parent does not ask how it ended, so it goes on as a zombie, which is a leak, too.
    service.wait_for(lambda: child.status() == psutil.STATUS_ZOMBIE, "the child's end")
    family.sample(samples, 4.0, thread_names=True)
    assert [value for _, value in samples.points["training", "processes"]] == [1, 2, 2]
    assert [second for second, _ in samples.points["launcher", "threads"]] == [0, 2, 4]
    assert [second for second, _ in samples.points["sleep 60", "threads"]] == [2]
    assert samples.threads["sleep 60"][0] == (2.0, {"sleep": 1})


def test_a_process_that_is_gone_ends_it(parent: subprocess.Popen[str]) -> None:
    family = soak.Family(psutil.Process(parent.pid))
    parent.kill()
    parent.wait()
    with pytest.raises(soak.EndedError, match="after 0 s gone: launcher"):
        family.sample(soak.Samples(), 0.0, thread_names=False)


class Learner(nullcontext[None]):
    """A stand-in for its client; the third time that streams are counted, something ends."""

    def __init__(self, end: Callable[[], None]) -> None:
        super().__init__()
        self._end, self._asked = end, 0

    def __enter__(self) -> Learner:  # type: ignore[override]
        return self

    def status(self) -> training_pb2.GetStatusResponse:
        self._asked += 1
        if self._asked == 4:  # the first time it is asked whether all actors are there
            self._end()
        return training_pb2.GetStatusResponse(actors=soak.ACTORS)


class Unavailable(grpc.RpcError):
    def code(self) -> grpc.StatusCode:
        return grpc.StatusCode.UNAVAILABLE


def be_silent() -> None:
    raise Unavailable


@pytest.fixture
def printed_of(
    parent: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[Callable[[], None]], str]:
    """What is printed of a stand-in for a training that does not last, as something ends it."""

    def printed(end: Callable[[], None]) -> str:
        monkeypatch.setattr(service, "client", lambda _: Learner(end))
        assert soak.main() == 1
        return capsys.readouterr().out

    monkeypatch.setattr(soak, "OURS", soak.OURS | {"driver": "sleep 60"})
    monkeypatch.setattr(soak, "EVERY_S", 0.01)
    monkeypatch.setattr(sys, "argv", ["soak", "--minutes", "2"])
    monkeypatch.setattr(service, "training", lambda *_: nullcontext(parent))
    monkeypatch.setattr(service, "learner_step", lambda _: 42)
    return printed


def test_what_was_sampled_before_a_process_ended_is_reported(
    parent: subprocess.Popen[str], printed_of: Callable[[Callable[[], None]], str]
) -> None:
    printed = printed_of(start_a_child(parent).kill)
    assert "42 learner steps" in printed
    assert re.search(r"^driver +threads +1\.0 and was there only from 0 s", printed, re.MULTILINE)
    assert re.search(r"not measured to the end: after \d+ s gone: driver\n$", printed)


def test_what_was_sampled_before_the_learner_fell_silent_is_reported(
    parent: subprocess.Popen[str], printed_of: Callable[[Callable[[], None]], str]
) -> None:
    start_a_child(parent)
    printed = printed_of(be_silent)
    assert re.search(r"^learner +streams +8\.0 and was there only from 0 s", printed, re.MULTILINE)
    assert re.search(r"after \d+ s the learner does not answer: UNAVAILABLE\n$", printed)


def test_a_process_of_ours_that_is_missing_is_noticed(
    parent: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soak, "OURS", soak.OURS | {"actor": "ray::ActorProcess"})
    with pytest.raises(AssertionError, match="'actor': 0"):
        soak.Family(psutil.Process(parent.pid))
