"""docker-compose.yml as a user runs it: up, deaths, stop, down, up again. Needs docker with compose.

COMPOSE_FILE may add an override; the project's containers and volumes of an earlier test are removed.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import pytest

from liir_common.client import CheckpointClient, TrainingClient
from liir_common.errors import LiirError
from liir_common.rpc.gen.liir.v1 import training_pb2

pytestmark = [pytest.mark.compose, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
LEARNER_PORT, PROMETHEUS_PORT, GRAFANA_PORT = 15051, 19090, 13000
WORKERS, ACTORS = 3, 6
SETTINGS = {
    "LIIR_ACTORS__COUNT": ACTORS,
    "LIIR_TRAINING__BATCH_EPISODES": 8,
    "LIIR_TRAINING__CHECKPOINT_INTERVAL": 80,
    "LIIR_TRAINING__SAVE_INTERVAL": 5,
    "LIIR_EVALUATION__EPISODES": 5,
    "LIIR_LEARNER__THREADS": 1,
}
# Prints the ids of the processes whose command line contains the argument, but not its own.
FIND = """
import os, pathlib, sys
for path in pathlib.Path('/proc').glob('[0-9]*/cmdline'):
    line = path.read_bytes().replace(b'\\0', b' ').decode()
    if sys.argv[1] in line and path.parent.name != str(os.getpid()):
        print(path.parent.name)
"""


class Compose:
    """The project in a name space of its own, on ports of its own."""

    def __init__(self, folder: Path) -> None:
        """Put the run's settings into a file of `folder`."""
        settings = folder / "settings.env"
        settings.write_text("".join(f"{key}={value}\n" for key, value in SETTINGS.items()))
        self._environment = os.environ | {
            "ENV_FILE": str(settings),
            "LEARNER_PORT": str(LEARNER_PORT),
            "PROMETHEUS_PORT": str(PROMETHEUS_PORT),
            "GRAFANA_PORT": str(GRAFANA_PORT),
        }

    def __call__(self, *arguments: str) -> str:
        """Run `docker compose ARGUMENTS`; returns its output."""
        done = subprocess.run(
            ["docker", "compose", "--project-name", "liir-test", *arguments],
            cwd=ROOT,
            env=self._environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"docker compose {' '.join(arguments)}:\n{done.stdout}{done.stderr}"
        return done.stdout

    def up(self) -> None:
        """Start everything and wait until it is healthy."""
        self("up", "--detach", "--wait", "--wait-timeout", "300", "--scale", f"ray-worker={WORKERS}")

    def processes(self, service: str, command: str, index: int = 1) -> list[str]:
        """Ids, inside the container, of the processes whose command line contains `command`."""
        return self("exec", "--index", str(index), service, "python", "-c", FIND, command).split()

    def kill(self, service: str, command: str) -> None:
        """SIGKILL to a container's process."""
        (process, *_) = self.processes(service, command)
        self("exec", service, "sh", "-c", f"kill -KILL {process}")

    def restarts(self, service: str) -> int:
        """How often the engine has started containers of a service again."""
        containers = self("ps", "--all", "--quiet", service).split()
        inspect = ["docker", "inspect", "--format", "{{.RestartCount}}", *containers]
        counts = subprocess.run(inspect, check=True, capture_output=True, text=True).stdout
        return sum(map(int, counts.split()))


@pytest.fixture
def compose(tmp_path: Path) -> Iterator[Compose]:
    """The project's images built, nothing running; everything removed in the end."""
    compose = Compose(tmp_path)
    compose("down", "--volumes", "--timeout", "5")
    compose("build", "ray-head", "learner")
    try:
        yield compose
    finally:
        print(compose("logs", "--tail", "40"))
        compose("down", "--volumes", "--timeout", "5")


def wait_for(condition: Callable[[], object], what: str, timeout_s: float = 180.0) -> None:
    """Poll until `condition` holds; an endpoint that is away does not hold."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            if condition():
                return
        except (OSError, LiirError, grpc.RpcError) as error:
            print(f"{what}: {error}")
        assert time.monotonic() < deadline, f"{what}: not within {timeout_s:g} s"
        time.sleep(1)


def query(expression: str) -> float:
    """Largest value of a Prometheus expression; 0 if there is none."""
    address = f"http://127.0.0.1:{PROMETHEUS_PORT}/api/v1/query?"
    with urllib.request.urlopen(address + urllib.parse.urlencode({"query": expression}), timeout=5) as page:
        result = json.load(page)["data"]["result"]
    return max((float(sample["value"][1]) for sample in result), default=0.0)


def status() -> training_pb2.GetStatusResponse:
    """How far the run is, asked from outside of the network."""
    with TrainingClient(f"127.0.0.1:{LEARNER_PORT}") as client:
        return client.status()


def test_up_deaths_down_and_up_again(compose: Compose) -> None:
    compose.up()

    # Every process is scraped, the actors sit on all workers and nowhere else, battles are won.
    wait_for(lambda: query("sum(up)") == 4, "four targets up")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected")
    for index in range(1, WORKERS + 1):
        assert len(compose.processes("ray-worker", "ray::RolloutActor", index)) == ACTORS // WORKERS
    for service in ("ray-head", "actors"):
        assert not compose.processes(service, "ray::RolloutActor")
    wait_for(lambda: query('max_over_time(liir_win_rate{actions="sampled"}[1h])') > 0, "a battle won")

    # A worker dies: its actors go elsewhere, the worker comes back.
    compose.kill("ray-worker", "raylet/raylet --")
    wait_for(lambda: compose.restarts("ray-worker") > 0, "the worker started again")
    wait_for(lambda: query("liir_driver_actor_restarts_total") > 0, "actors started again")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected again")

    # The learner dies: it goes on from its last save.
    before = status().learner_step
    compose.kill("learner", "/venv/bin/liir learner")
    wait_for(lambda: compose.restarts("learner") > 0, "the learner started again")
    wait_for(lambda: status().learner_step > before + 5, "learner steps after its death")

    # A checkpoint is fetched from outside; a stop is graceful and nothing of it is lost.
    with CheckpointClient(f"127.0.0.1:{LEARNER_PORT}") as client:
        first, data = client.download(80)
    stopped_at = status()
    compose("stop")
    containers = map(json.loads, compose("ps", "--all", "--format", "json").splitlines())
    exit_codes = {container["Service"]: container["ExitCode"] for container in containers}
    assert [exit_codes[service] for service in ("learner", "actors", "evaluator")] == [0, 0, 0], exit_codes
    compose("down")

    compose.up()
    resumed = status()
    assert resumed.learner_step >= stopped_at.learner_step
    assert resumed.evaluations >= stopped_at.evaluations > 0
    wait_for(lambda: status().learner_step > resumed.learner_step + 5, "learner steps after the resume")
    with CheckpointClient(f"127.0.0.1:{LEARNER_PORT}") as client:
        assert client.download(80) == (first, data)
    # Prometheus kept what it saw of the first learner.
    assert query("count(min_over_time(liir_learner_step[1h]) < 5)") == 1
