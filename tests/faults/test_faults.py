"""A hundred faults during one training, and the same checkpoints as without any.

Learner, actors, evaluator and a Ray cluster run as processes under a supervisor; the links between
them go through proxies that break, their clocks go wrong, and the run directory is on a disk that fills up.
"""

from __future__ import annotations

import random
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
import yaml

from liir_common.errors import ComputeError, DiskFullError, UnreachableError
from tests.e2e import service
from tests.e2e.test_run import assert_same
from tests.faults.proxy import Proxy
from tests.faults.supervisor import Clock, Supervised, Supervisor, add_ray

pytestmark = [pytest.mark.faults, pytest.mark.timeout(1200)]

COMPOSE = Path(__file__).parents[2] / "docker-compose.yml"
SEED = 20191208
SETTINGS = (
    "actors.count=4",
    "actors.ticket_timeout_s=4",
    "training.total_env_steps=20000",
    "training.checkpoint_interval=25",
    "training.save_interval=5",
    "learner.threads=1",
)
PLAN = {
    "cut_actors": 24,
    "cut_evaluator": 12,
    "stall_actors": 4,
    "stall_evaluator": 4,
    "delay_actors": 10,
    "kill_actor": 12,
    "pause_actor": 4,
    "kill_evaluator": 6,
    "kill_learner": 5,
    "kill_compute": 3,
    "stop_learner": 2,
    "pause_learner": 3,
    "kill_driver": 2,
    "kill_node": 2,
    "kill_head": 2,
    "fill_disk": 4,
    "skew_learner": 6,
    "skew_evaluator": 4,
}
"""How often each fault happens; the seed shuffles them."""
ORDINARY_CODES = {
    "learner": {-signal.SIGKILL, -signal.SIGTERM, DiskFullError.exit_code, ComputeError.exit_code},
    "evaluator": {-signal.SIGKILL, UnreachableError.exit_code},
}
"""How an incarnation may fail: killed, asked to end or without room while it started, nobody there."""
WAITS_FOR_ROOM = "the run waits for room on its disk"


class Faults:
    """The service under a supervisor, and a method for everything that can go wrong with it."""

    def __init__(self, folder: Path, disk: Path, temporary: Path) -> None:
        """Start everything."""
        self.run_dir = disk / "run"
        self.due = 1
        """Learner step that the plan has come to"""
        self._slowness = 0.0
        self._closed = threading.Event()
        self._disk = disk
        self._random = random.Random(SEED)
        port = service.free_port()
        self.actors_link, self._evaluator_link = Proxy(port), Proxy(port)
        self._clocks = {name: Clock(folder, name) for name in ("learner", "evaluator")}
        self.supervisor = Supervisor()
        ray_address = add_ray(self.supervisor, folder, temporary, nodes=2)
        arguments = service.arguments([*SETTINGS, f"learner.port={port}"])
        self.add("learner", "--resume-if-begun", "--run-dir", str(self.run_dir), *arguments, folder=folder)
        self.add("evaluator", "--learner", self._evaluator_link.address, folder=folder)
        actors = ("--set", f"actors.ray_address={ray_address}", "--set", "actors.metrics_port=0")
        self.add("actors", "--learner", self.actors_link.address, *actors, folder=folder)
        threading.Thread(target=self._hold_back, daemon=True).start()

    def _hold_back(self) -> None:
        """Slow the actors' link as long as the run is ahead of the plan: in the seconds that some faults
        take, the actors would play it to its end."""
        while not self._closed.wait(0.05):
            ahead = max(0, service.learner_step(self.run_dir) - self.due)
            self.actors_link.delay_s = max(self._slowness, min(2.0, 0.05 * ahead))

    def add(self, name: str, *arguments: str, folder: Path) -> None:
        environment = self._clocks[name].environment if name in self._clocks else None
        self.supervisor.add(name, "liir", name, *arguments, folder=folder, environment=environment)

    def process(self, name: str) -> psutil.Process:
        return psutil.Process(self.supervisor.services[name].process.pid)

    def actor(self) -> psutil.Process:
        actors = [
            process
            for name in ("node-0", "node-1")
            for process in self.supervisor.services[name].tree()
            if "ActorProcess" in _title(process)
        ]
        if not actors:
            raise psutil.NoSuchProcess(0, "ActorProcess")
        return self._random.choice(actors)

    def cut_actors(self) -> None:
        self.actors_link.cut()

    def cut_evaluator(self) -> None:
        self._evaluator_link.cut()

    def stall_actors(self) -> None:
        """Sometimes longer than keepalive waits (12 s), sometimes not."""
        self.actors_link.stall(self._random.uniform(1, 16))

    def stall_evaluator(self) -> None:
        self._evaluator_link.stall(self._random.uniform(1, 16))

    def delay_actors(self) -> None:
        self._slowness = self._random.uniform(0.3, 1.0)
        time.sleep(1)
        self._slowness = 0.0

    def kill_actor(self) -> None:
        self.actor().kill()

    def pause_actor(self) -> None:
        """Longer than a ticket may take: another plays it too, and the first hands in a second copy."""
        with _paused(self.actor()):
            time.sleep(5)

    def kill_evaluator(self) -> None:
        self.process("evaluator").kill()

    def kill_learner(self) -> None:
        self.process("learner").kill()

    def kill_compute(self) -> None:
        """The process beside the learner's; the learner cannot do without."""
        children = self.process("learner").children()
        if not children:  # it has only begun
            raise psutil.NoSuchProcess(0, "services.learner.compute")
        for child in children:
            child.kill()

    def stop_learner(self) -> None:
        """It saves, says goodbye and ends with 0, which the supervisor takes for the run's end."""
        learner = self.supervisor.services["learner"]
        process = learner.process
        process.terminate()
        if process.wait(timeout=60) == 0:
            learner.start()

    def pause_learner(self) -> None:
        with _paused(self.process("learner")):
            time.sleep(self._random.uniform(1, 8))

    def kill_driver(self) -> None:
        self.process("actors").kill()

    def kill_node(self) -> None:
        """A whole machine of the cluster, with its actors: the raylet goes and takes them along."""
        self.supervisor.services[self._random.choice(("node-0", "node-1"))].kill()

    def kill_head(self) -> None:
        """The machine that knows the cluster: nodes and driver have to notice, and to join the new one."""
        self.supervisor.services["head"].kill()

    def fill_disk(self) -> None:
        """To the last byte, until the learner says so: it waits, or cannot start."""
        learner = self.supervisor.services["learner"]
        before = _complaints(learner)
        filler = self._disk / "filler"
        with filler.open("wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(65536)):
                pass
        service.wait_for(lambda: _complaints(learner) > before, "the learner's complaint")
        filler.unlink()

    def skew_learner(self) -> None:
        self._clocks["learner"].set(self._random.uniform(-86400, 86400))

    def skew_evaluator(self) -> None:
        self._clocks["evaluator"].set(self._random.uniform(-86400, 86400))

    def happens(self, name: str) -> bool:
        """Let it happen; false if its victim is dead at the moment."""
        try:
            getattr(self, name)()
        except psutil.NoSuchProcess:
            return False
        return True

    def close(self) -> None:
        """End everything."""
        self._closed.set()
        self.supervisor.end()
        for link in (self.actors_link, self._evaluator_link):
            link.close()


def _complaints(learner: Supervised) -> int:
    text = learner.log.read_text()
    return text.count(WAITS_FOR_ROOM) + text.count("error: cannot write to")


def _title(process: psutil.Process) -> str:
    with suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
        return " ".join(process.cmdline())
    return ""


@contextmanager
def _paused(process: psutil.Process) -> Iterator[None]:
    process.suspend()
    try:
        yield
    finally:
        with suppress(psutil.NoSuchProcess):
            process.resume()


def plan() -> list[str]:
    faults = [name for name, times in PLAN.items() for _ in range(times)]
    random.Random(SEED).shuffle(faults)
    return faults


def inject(faults: Faults, learner_steps: int) -> None:
    """Let everything happen while the run goes on, evenly over three quarters of its learner steps."""
    names = plan()
    assert len(names) >= 100
    for number, name in enumerate(names):
        faults.due = due = 1 + learner_steps * 3 * number // (4 * len(names))
        service.wait_for(lambda due=due: service.learner_step(faults.run_dir) >= due, f"learner step {due}")
        print(f"{time.monotonic():.1f} s, learner step {service.learner_step(faults.run_dir)}: {name}")
        service.wait_for(lambda name=name: faults.happens(name), name)
    faults.due = learner_steps


def test_a_hundred_faults_change_nothing(
    tmp_path: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in yaml.safe_load(COMPOSE.read_text())["x-ray"]["environment"].items():
        monkeypatch.setenv(name, str(value))  # Ray's nodes and the driver go by it
    undisturbed = tmp_path / "undisturbed"
    command = service.start("train", "--run-dir", str(undisturbed), *service.arguments(SETTINGS))
    service.finish(command, timeout_s=600)
    steps = service.learner_step(undisturbed)
    with tempfile.TemporaryDirectory(prefix="liir-", ignore_cleanup_errors=True) as temporary:
        faults = Faults(tmp_path, small_disk, Path(temporary))
        services = faults.supervisor.services
        try:
            service.wait_for(lambda: service.learner_step(faults.run_dir) > 0, "the first learner step")
            inject(faults, steps)
            assert service.learner_step(faults.run_dir) < steps, "the run was over before the faults were"
            service.wait_for(lambda: services["learner"].process.poll() == 0, "the run's end", 300)
        finally:
            faults.close()
    assert_same(faults.run_dir, undisturbed)
    for name, codes in ORDINARY_CODES.items():
        assert set(services[name].codes) <= codes, services[name].log.read_text()[-5000:]
    assert WAITS_FOR_ROOM in services["learner"].log.read_text()
