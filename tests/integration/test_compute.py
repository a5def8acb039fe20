"""The process that computes: the same bits as here, errors that come back, and an end with its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import psutil
import pytest
import torch

from liir_common import config, seeds
from liir_common.errors import ComputeError, ConfigError
from liir_common.types import Batch, EnvSpec, Weights
from services.learner.algorithms import Algorithm, make_algorithm
from services.learner.bench import synthetic_batch
from services.learner.compute import Compute
from tests.e2e.service import wait_for

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

SPEC = EnvSpec("test", "1", "{}", 3, 4, 3, 5, 9, ())
REPLAY = ["algorithm.replay.episodes=20", "algorithm.replay.batch_episodes=5"]
PARENT = f"""
from liir_common import config
from liir_common.types import EnvSpec
from services.learner.compute import Compute
compute = Compute({SPEC!r}, config.load(None, ["learner.device=cpu"]))
print(compute.pid, flush=True)
input()
"""


def settings(*more: str) -> config.Config:
    return config.load(None, ["algorithm.policy_hidden=8", "learner.device=cpu", "learner.threads=1", *more])


def batch_of(seed: int) -> Batch:
    return synthetic_batch(SPEC, episodes=6, steps=6, seed=seed, policy_version=seed, epsilon=0.2)


def same(a: Weights, b: Weights) -> bool:
    return a.keys() == b.keys() and all(
        a[name].dtype == b[name].dtype and np.array_equal(a[name], b[name]) for name in a
    )


def seen(algorithm: Algorithm) -> tuple[list[object], list[Weights]]:
    """Figures of two updates and parameter counts; policies announced and in the end, r_in and the state."""
    policies: list[Weights] = []
    figures: list[object] = [algorithm.update(batch_of(seed), policies.append) for seed in range(2)]
    arrays = [*policies, algorithm.policy(), algorithm.intrinsic(), algorithm.state()]
    return [*figures, algorithm.parameter_counts()], arrays


@pytest.mark.parametrize("method", [["algorithm=liir"], ["algorithm=qmix", *REPLAY]], ids=" ".join)
def test_it_learns_the_same_bits(method: list[str]) -> None:
    resolved = settings(*method)
    with Compute(SPEC, resolved) as there:
        seed = seeds.derive(resolved.seed, seeds.LEARNER)
        here = make_algorithm(SPEC, resolved.algorithm, seed, torch.device("cpu"))
        for _ in range(2):
            wanted, got = seen(here), seen(there)
            assert got[0] == wanted[0]
            assert len(wanted[1]) == 5
            assert all(map(same, got[1], wanted[1]))
        if here.replay is None:
            assert there.replay is None
        else:
            assert there.replay is not None
            assert there.replay.first == here.replay.first == 4
            assert there.replay.frames(10) == here.replay.frames(10)
            frames = there.replay.frames(4)
            there.replay.extend(10, frames)
            assert (there.replay.first, there.replay.frames(10)) == (10, frames)
        state = here.state()
        there.update(batch_of(7))
        assert not same(there.state(), state)
        there.load_state(state)
        assert same(there.state(), state)


def test_what_is_raised_there_is_raised_here_and_it_goes_on() -> None:
    with Compute(SPEC, settings()) as compute:
        before = compute.state()
        batch = batch_of(0)
        with pytest.raises(ValueError, match="mask without any"):
            compute.update(replace(batch, mask=np.zeros_like(batch.mask)))
        with pytest.raises(ValueError, match="missing") as raised:
            compute.load_state({})
        assert "in restore" in raised.value.__notes__[0], "the traceback of the other process"
        assert same(compute.state(), before)
        with pytest.raises(FloatingPointError, match="diverged"):
            compute.update(replace(batch, reward=batch.reward + np.float32(np.inf)))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is the device that this asks for in vain")
def test_a_device_that_is_not_there_is_explained() -> None:
    with pytest.raises(ConfigError, match=r"learner\.device: wanted a CUDA device"):
        Compute(SPEC, settings("learner.device=cuda"))


def test_signals_are_for_the_learner_and_what_kills_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with Compute(SPEC, settings()) as compute:
        for signum in (signal.SIGINT, signal.SIGTERM):  # as a terminal sends them, to all
            os.kill(compute.pid, signum)
        assert compute.parameter_counts()
        receive = compute._link.receive

        def kill_and_receive() -> object:
            os.kill(compute.pid, signal.SIGKILL)
            return receive()

        os.kill(compute.pid, signal.SIGSTOP)  # so that it has not answered by then
        monkeypatch.setattr(compute._link, "receive", kill_and_receive)
        with pytest.raises(ComputeError, match="gone: SIGKILL killed it during 'state'; resume the run"):
            compute.state()
        with pytest.raises(ComputeError, match="SIGKILL killed it before 'policy'"):
            compute.policy()


def test_a_process_that_dies_while_it_computes_is_told() -> None:
    """Once it has taken the batch, so that nothing that was sent is left unread."""
    with Compute(SPEC, settings("algorithm.policy_epochs=100000")) as compute:
        killer = threading.Thread(target=kill_when_it_computes, args=[compute.pid])
        killer.start()
        with pytest.raises(ComputeError, match="SIGKILL killed it during 'update'"):
            compute.update(batch_of(0))
        killer.join()


def kill_when_it_computes(pid: int) -> None:
    process = psutil.Process(pid)
    before = process.cpu_times().user
    wait_for(lambda: process.cpu_times().user > before + 0.5, "an update that computes")
    process.kill()


def test_nothing_that_json_cannot_say_is_sent() -> None:
    with Compute(SPEC, settings()) as compute:
        with pytest.raises(TypeError, match="not JSON serializable"):
            compute.update(replace(batch_of(0), epsilon=object()))  # type: ignore[arg-type]
        assert compute.update(batch_of(0))


def test_an_error_that_nobody_foresaw_says_what_it_was_there() -> None:
    with Compute(SPEC, settings()) as compute:
        with pytest.raises(RuntimeError, match="NotImplementedError: sing") as raised:
            compute._ask("sing")
        assert "in _do" in raised.value.__notes__[0]
        assert compute.parameter_counts()


def test_it_ends_with_whoever_started_it() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert runs(pid)
    parent.kill()
    parent.communicate()
    wait_for(lambda: not runs(pid), "the end of the process that computes")


def runs(pid: int) -> bool:
    """Whether there is such a process, dead ones that nobody has asked for left out."""
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
