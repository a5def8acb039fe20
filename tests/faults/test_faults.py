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
from collections import Counter
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import yaml

from liir_common.certs import make_certs
from liir_common.errors import ComputeError, DiskFullError, UnreachableError
from tests.e2e import service
from tests.e2e.test_run import assert_same
from tests.faults.proxy import Proxy
from tests.faults.supervisor import Clock, Supervised, Supervisor, add_ray, alive, kill

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
HITS = 100
"""So many at least must have hit something."""
TRY_S = 60.0
"""For which a fault is tried until it does."""
ORDINARY_CODES = {
    "learner": {-signal.SIGKILL, -signal.SIGTERM, DiskFullError.exit_code, ComputeError.exit_code},
    "evaluator": {-signal.SIGKILL, UnreachableError.exit_code},
}
"""How an incarnation may fail: killed, asked to end or without room while it started, nobody there."""
WAITS_FOR_ROOM = "the run waits for room on its disk"


class Faults:
    """The service under a supervisor, and a method for everything that can go wrong with it.

    Each of them returns whether it hit anything, or raises `psutil.NoSuchProcess` if its victim is dead.
    """

    def __init__(self, folder: Path, disk: Path, temporary: Path) -> None:
        """Start everything."""
        self.run_dir = disk / "run"
        self.due = 1
        """Learner step that the plan has come to"""
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
            self.actors_link.delay_s = min(2.0, 0.2 * ahead)

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

    def cut_actors(self) -> bool:
        return self.actors_link.cut()

    def cut_evaluator(self) -> bool:
        return self._evaluator_link.cut()

    def stall_actors(self) -> bool:
        """Sometimes longer than keepalive waits (12 s), sometimes not."""
        return self.actors_link.stall(self._random.uniform(1, 16))

    def stall_evaluator(self) -> bool:
        return self._evaluator_link.stall(self._random.uniform(1, 16))

    def delay_actors(self) -> bool:
        return self.actors_link.slow(self._random.uniform(0.3, 1.0), seconds=1)

    def kill_actor(self) -> bool:
        return kill(self.actor())

    def pause_actor(self) -> bool:
        """Longer than a ticket may take: another plays it too, and the first hands in a second copy."""
        return _pause(self.actor(), 5)

    def kill_evaluator(self) -> bool:
        return kill(self.process("evaluator"))

    def kill_learner(self) -> bool:
        return kill(self.process("learner"))

    def kill_compute(self) -> bool:
        """The process beside the learner's, which is not there when the learner has only begun; the learner
        cannot do without."""
        return sum(kill(child) for child in self.process("learner").children()) > 0

    def stop_learner(self) -> bool:
        """It saves, says goodbye and ends with 0, which the supervisor takes for the run's end."""
        learner = self.supervisor.services["learner"]
        process = learner.process
        if process.poll() is not None:
            return False
        process.terminate()
        code = process.wait(timeout=60)
        if code == 0:
            learner.start()
        return code in (0, -signal.SIGTERM)

    def pause_learner(self) -> bool:
        return _pause(self.process("learner"), self._random.uniform(1, 8))

    def kill_driver(self) -> bool:
        return kill(self.process("actors"))

    def kill_node(self) -> bool:
        """A whole machine of the cluster, with its actors: the raylet goes and takes them along."""
        return self._lose(self._random.choice(("node-0", "node-1")), "/raylet/raylet")

    def kill_head(self) -> bool:
        """The machine that knows the cluster: nodes and driver have to notice, and to join the new one."""
        return self._lose("head", "/gcs/gcs_server")

    def _lose(self, name: str, program: str) -> bool:
        """Kill all of a machine on which this part of Ray runs; it may be about to start, or to end."""
        machine = self.supervisor.services[name]
        if not any(program in _title(process) for process in machine.tree()):
            return False
        machine.kill()
        return True

    def fill_disk(self) -> bool:
        """To the last byte, until the learner says so: it waits, or cannot start."""
        learner = self.supervisor.services["learner"]
        before = _complaints(learner)
        filler = self._disk / "filler"
        with filler.open("wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(65536)):
                pass
        service.wait_for(lambda: _complaints(learner) > before, "the learner's complaint")
        filler.unlink()
        return True

    def skew_learner(self) -> bool:
        return self._skew("learner")

    def skew_evaluator(self) -> bool:
        return self._skew("evaluator")

    def _skew(self, name: str) -> bool:
        clock = self._clocks[name]
        if not clock.rules(self.process(name)):
            return False
        clock.set(self._random.uniform(-86400, 86400))
        return True

    def hits(self, name: str, number: int) -> bool:
        """Let the plan's fault of that number happen as soon as there is anything that it can hit."""
        deadline = time.monotonic() + TRY_S
        while time.monotonic() < deadline:
            self._random.seed(SEED + number)  # however often it and those before were tried
            with suppress(psutil.NoSuchProcess):
                if getattr(self, name)():
                    return True
            time.sleep(0.05)
        return False

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


def _pause(process: psutil.Process, seconds: float) -> bool:
    """Stop it for a while, and return then; false if it is dead or stopped already."""
    if not alive(process) or process.status() == psutil.STATUS_STOPPED:
        return False
    process.suspend()
    try:
        time.sleep(seconds)
    finally:
        with suppress(psutil.NoSuchProcess):
            process.resume()
    return True


def plan() -> list[str]:
    faults = [name for name, times in PLAN.items() for _ in range(times)]
    random.Random(SEED).shuffle(faults)
    return faults


def inject(faults: Faults, learner_steps: int) -> Counter[str]:
    """Let everything happen while the run goes on, evenly over three quarters of its learner steps.

    Returns how often each fault hit something.
    """
    names, hits = plan(), Counter[str]()
    for number, name in enumerate(names):
        faults.due = due = 1 + learner_steps * 3 * number // (4 * len(names))
        service.wait_for(lambda due=due: service.learner_step(faults.run_dir) >= due, f"learner step {due}")
        begin, hit = time.monotonic(), faults.hits(name, number)
        hits[name] += hit
        print(
            f"{begin:.1f} s, learner step {service.learner_step(faults.run_dir)}: {name} "
            f"{'hit' if hit else 'missed'} after {time.monotonic() - begin:.1f} s"
        )
    faults.due = learner_steps
    return hits


def test_a_hundred_faults_change_nothing(
    tmp_path: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in yaml.safe_load(COMPOSE.read_text())["x-ray"]["environment"].items():
        monkeypatch.setenv(name, str(value))  # Ray's nodes and the driver go by it
    make_certs(tmp_path / "certs")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "certs/actor/ray-token"))
    undisturbed = tmp_path / "undisturbed"
    command = service.start("train", "--run-dir", str(undisturbed), *service.arguments(SETTINGS))
    service.finish(command, timeout_s=600)
    steps = service.learner_step(undisturbed)
    with tempfile.TemporaryDirectory(prefix="liir-", ignore_cleanup_errors=True) as temporary:
        faults = Faults(tmp_path, small_disk, Path(temporary))
        services = faults.supervisor.services
        try:
            service.wait_for(lambda: service.learner_step(faults.run_dir) > 0, "the first learner step")
            hits = inject(faults, steps)
            assert service.learner_step(faults.run_dir) < steps, "the run was over before the faults were"
            service.wait_for(lambda: services["learner"].process.poll() == 0, "the run's end", 300)
        finally:
            faults.close()
    assert_same(faults.run_dir, undisturbed)
    for name, codes in ORDINARY_CODES.items():
        assert set(services[name].codes) <= codes, services[name].log.read_text()[-5000:]
    assert WAITS_FOR_ROOM in services["learner"].log.read_text()
    with capsys.disabled():
        print(f"\n{hits.total()} of {len(plan())} faults hit:", *(f"{name} {hits[name]}" for name in PLAN))
    assert hits.total() >= HITS
    assert all(hits[name] for name in PLAN)
