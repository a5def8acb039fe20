"""docker-compose.yml as a user runs it: up, deaths, rotations, down, up again. Needs docker with compose.

COMPOSE_FILE may add an override; the project's containers and volumes of an earlier test are removed.
"""

from __future__ import annotations

import json
import os
import re
import ssl
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import pytest

from liir_common.client import TrainingClient
from liir_common.config import SecurityConfig
from liir_common.errors import LiirError
from liir_common.rpc.gen.liir.v1 import training_pb2
from tests.e2e.service import LIIR

pytestmark = [pytest.mark.compose, pytest.mark.timeout(1800)]

ROOT = Path(__file__).parents[2]
LEARNER_PORT, PROMETHEUS_PORT, GRAFANA_PORT = 15051, 19090, 13000
# Another address than the usual one, which the certificate must then hold for.
LEARNER_ADDRESS = "127.0.0.2"
LEARNER = f"{LEARNER_ADDRESS}:{LEARNER_PORT}"
WORKERS, ACTORS = 3, 6
EPISODE = 80
# Exit code of a container that did not end within its grace period, too.
SIGKILLED = 137
DOCUMENT = ROOT / "docs/operations.md"
SETTINGS = {
    "LIIR_ACTORS__COUNT": ACTORS,
    "LIIR_TRAINING__BATCH_EPISODES": 8,
    "LIIR_TRAINING__CHECKPOINT_INTERVAL": EPISODE,
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
    """The project in a name space of its own, on ports of its own, and a user's shell to steer it from."""

    def __init__(self, folder: Path) -> None:
        """Put the run's settings into a file of `folder`, in which commands are run."""
        self.folder = folder
        settings = folder / "settings.env"
        settings.write_text("".join(f"{key}={value}\n" for key, value in SETTINGS.items()))
        files = os.environ.get("COMPOSE_FILE", "docker-compose.yml").split(os.pathsep)
        self._environment = os.environ | {
            "COMPOSE_PROJECT_NAME": "liir-test",
            "COMPOSE_FILE": os.pathsep.join(str(ROOT / file) for file in files),
            "PATH": os.pathsep.join((str(Path(LIIR).parent), os.environ["PATH"])),
            "ENV_FILE": str(settings),
            "CERTS_ARGS": f"--host {LEARNER_ADDRESS}",
            "LEARNER_ADDRESS": LEARNER_ADDRESS,
            "LEARNER_PORT": str(LEARNER_PORT),
            "PROMETHEUS_PORT": str(PROMETHEUS_PORT),
            "GRAFANA_PORT": str(GRAFANA_PORT),
        }

    def run(self, command: list[str], code: int = 0) -> str:
        """Run a command that ends with `code`; returns its output."""
        done = subprocess.run(command, cwd=self.folder, env=self._environment, capture_output=True, text=True)
        assert done.returncode == code, f"{' '.join(command)}:\n{done.stdout}{done.stderr}"
        return done.stdout + done.stderr if code else done.stdout

    def __call__(self, *arguments: str) -> str:
        """Run `docker compose ARGUMENTS`; returns its output."""
        return self.run(["docker", "compose", *arguments])

    def documented(self, heading: str) -> None:
        """Run the commands below a heading of docs/operations.md as a user would, on this test's learner."""
        block = re.search(rf"### {heading}\n.*?```\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
        assert block, heading
        commands = block[1].replace("127.0.0.1:50051", LEARNER).replace(" 1000 ", f" {EPISODE} ")
        self.run(["sh", "-ec", commands])

    def liir(self, *command: str, code: int = 0) -> str:
        """Run a `liir` command against the learner with the reader's folder that was last fetched."""
        return self.run([LIIR, *command, "--learner", LEARNER, "--set", "security=reader"], code)

    def client(self) -> TrainingClient:
        """The same from Python."""
        return TrainingClient(LEARNER, security=SecurityConfig.of(self.folder / "reader"))

    def serving(self) -> bool:
        """Whether the learner calls itself healthy, which it does without a token."""
        with self.client() as client:
            return client.serving()

    def status(self) -> training_pb2.GetStatusResponse:
        """How far the run is."""
        with self.client() as client:
            return client.status()

    def fetched(self) -> tuple[bytes, bytes]:
        """Manifest and weights as the documented command left them; they are gone then."""
        stem = self.folder / "here" / f"checkpoint-{EPISODE:09d}"
        files = stem.with_suffix(".json"), stem.with_suffix(".safetensors")
        contents = files[0].read_bytes(), files[1].read_bytes()
        for file in files:
            file.unlink()
        return contents

    def secrets(self) -> set[str]:
        """Every token, and every line of every private key."""
        command = "cat /certs/*/tokens /certs/*/key.pem /certs/ca-key.pem /certs/actor/ray-token"
        lines = self("run", "--rm", "certs", "sh", "-c", command).splitlines()
        return {line.split()[-1] for line in lines if "-----" not in line}

    def up(self, workers: int = WORKERS) -> None:
        """Start everything and wait until it is healthy."""
        self("up", "--detach", "--wait", "--wait-timeout", "600", "--scale", f"ray-worker={workers}")

    def drop_worker(self) -> int:
        """One worker less; returns the exit code of its container, which is removed."""
        workers = set(self("ps", "--quiet", "ray-worker").split())
        label = "label=com.docker.compose.project=liir-test"
        command = [
            "docker",
            "events",
            f"--since={time.time():.0f}",
            "--filter=event=die",
            f"--filter={label}",
        ]
        command += ["--format", "{{.ID}} {{.Actor.Attributes.exitCode}}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as events:
            try:
                self.up(WORKERS - 1)
                (removed,) = workers - set(self("ps", "--quiet", "ray-worker").split())
                deaths = (line.split() for line in events.stdout or ())
                return next(int(code) for container, code in deaths if container == removed)
            finally:
                events.terminate()

    def run_to(self, env_steps: int) -> None:
        """Give the run so many environment steps in all."""
        self._environment["LEARNER_ARGS"] = f"--set training.total_env_steps={env_steps}"
        self.up()

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


def wait_for(condition: Callable[[], object], what: str, timeout_s: float = 300.0) -> None:
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


def served_certificate() -> str:
    """The certificate that the learner shows to a new connection."""
    return ssl.get_server_certificate((LEARNER_ADDRESS, LEARNER_PORT), timeout=10)


def test_up_deaths_rotations_down_and_up_again(compose: Compose) -> None:
    compose.up()

    # Every process is scraped, the actors sit on all workers and nowhere else, battles are won.
    wait_for(lambda: query("sum(up)") == 4, "four targets up")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected")
    for index in range(1, WORKERS + 1):
        assert len(compose.processes("ray-worker", "ray::ActorProcess", index)) == ACTORS // WORKERS
    for service in ("ray-head", "actors"):
        assert not compose.processes(service, "ray::ActorProcess")
    wait_for(lambda: query('max_over_time(liir_win_rate{actions="sampled"}[1h])') > 0, "a battle won")

    # Nothing of ours runs as root.
    for service in ("learner", "ray-head", "ray-worker", "actors", "evaluator"):
        assert compose("exec", service, "id", "-u").strip() == "10001"

    # A service has the token of its role, and from outside it takes TLS and one, too.
    for service, role in {"ray-worker": "actor", "actors": "actor", "evaluator": "evaluator"}.items():
        assert re.fullmatch(rf"{role} \S+\n", compose("exec", service, "cat", "/certs/tokens"))
    status = "ray status --address=ray-head:6379 2>&1 || true"
    assert "Active" in compose("exec", "ray-worker", "sh", "-c", status)
    stranger = ("exec", "--env", "RAY_AUTH_MODE=disabled", "ray-worker")
    assert "InvalidAuthToken" in compose(*stranger, "sh", "-c", status)
    assert "no learner answered" in compose.run([LIIR, "status", "--learner", LEARNER], code=3)
    compose.documented("Fetch a checkpoint")
    first = compose.fetched()
    assert "it takes operator" in compose.liir("stop", code=5)

    # A worker dies: its actors go elsewhere, the worker comes back.
    compose.kill("ray-worker", "raylet/raylet --")
    wait_for(lambda: compose.restarts("ray-worker") > 0, "the worker started again")
    wait_for(lambda: query("liir_driver_actor_restarts_total") > 0, "actors started again")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected again")

    # The learner dies: it goes on from its last save.
    before = compose.status().learner_step
    compose.kill("learner", "/venv/bin/liir learner")
    wait_for(lambda: compose.restarts("learner") > 0, "the learner started again")
    wait_for(lambda: compose.status().learner_step > before + 5, "learner steps after its death")

    # All others but Grafana die at once: each is started again, and the run goes on.
    dying = {
        "ray-head": "gcs_server",
        "actors": "/venv/bin/liir actors",
        "evaluator": "/venv/bin/liir evaluator",
    }
    seen = compose.status()
    for service, command in dying.items():
        compose.kill(service, command)
    # As the first process of its container it ignores SIGKILL from inside.
    compose("exec", "prometheus", "sh", "-c", "kill -ABRT 1")
    wait_for(lambda: all(map(compose.restarts, (*dying, "prometheus"))), "all of them started again")
    wait_for(lambda: query("sum(up)") == 4, "four targets up again")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected to the next head")
    wait_for(lambda: compose.status().learner_step > seen.learner_step + 5, "learner steps")
    wait_for(lambda: compose.status().evaluations > seen.evaluations, "an evaluation")
    assert query("count(min_over_time(liir_learner_step[1h]) < 5)") == 1, "what it saw before it died"

    # New certificates are served at once, new tokens lock out whoever has the old ones; the run goes on.
    certificate, secrets = served_certificate(), compose.secrets()
    compose.documented("Renew the certificates")
    assert served_certificate() != certificate
    before = compose.status().learner_step
    compose.documented("Replace the tokens")
    wait_for(compose.serving, "the learner serves again")
    assert "does not know the token" in compose.liir("status", code=5)
    compose.documented("Fetch a checkpoint")
    assert compose.fetched() == first
    wait_for(lambda: compose.status().learner_step > before + 5, "learner steps with new tokens")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected with new tokens")

    # A worker less: it ends within its grace period, although actors live on it, and they go elsewhere.
    wait_for(
        lambda: all(compose.processes("ray-worker", "ray::ActorProcess", n + 1) for n in range(WORKERS)),
        "actors on every worker",
    )
    assert compose.drop_worker() != SIGKILLED
    before = compose.status().learner_step
    wait_for(lambda: compose.status().learner_step > before + 5, "learner steps with one worker less")
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors connected with one worker less")

    # A copy is made while the run goes on. A stop is graceful; nor did a secret reach a log or a container's
    # description.
    copied = compose.status()
    compose.documented("Back up")
    compose("stop")
    containers = [json.loads(line) for line in compose("ps", "--all", "--format", "json").splitlines()]
    exit_codes = {container["Service"]: container["ExitCode"] for container in containers}
    ended = ("certs", "learner", "actors", "evaluator")
    assert [exit_codes[service] for service in ended] == [0, 0, 0, 0], exit_codes
    killed = [container["Name"] for container in containers if container["ExitCode"] == SIGKILLED]
    assert not killed
    shown = compose("logs") + compose.run(["docker", "inspect", *(c["ID"] for c in containers)])
    secrets |= compose.secrets()
    assert len(secrets) > 30
    assert not [secret for secret in secrets if secret in shown]

    # Up again, from the copy and with another CA: the same checkpoint comes to who has the new one.
    compose("down")
    compose.run(["docker", "volume", "rm", "liir-test_runs"])
    compose.documented("Restore")
    compose.documented("Replace the CA")
    compose.up()
    assert "CERTIFICATE_VERIFY_FAILED" in compose.liir("status", code=3)
    compose.documented("Fetch a checkpoint")
    assert compose.fetched() == first
    resumed = compose.status()
    assert resumed.learner_step >= copied.learner_step - SETTINGS["LIIR_TRAINING__SAVE_INTERVAL"]
    assert resumed.evaluations >= copied.evaluations > 0
    wait_for(lambda: compose.status().learner_step > resumed.learner_step + 5, "steps after the resume")
    # Prometheus kept what it saw of the first learner.
    assert query("count(min_over_time(liir_learner_step[1h]) < 5)") == 1

    # A complete run is served, by parts that are not started in vain, and goes on when it gets more steps.
    parts = ("learner", "actors", "evaluator")
    restarts = [compose.restarts(service) for service in parts[1:]]
    compose.run_to(1)
    complete = training_pb2.PHASE_COMPLETE
    wait_for(lambda: compose.status().phase == complete, "the run complete")
    assert compose.status().evaluations == compose.status().checkpoints
    wait_for(lambda: query("liir_actors_connected") == ACTORS, "all actors waiting")
    compose.documented("Fetch a checkpoint")
    assert compose.fetched() == first
    before = compose.status().learner_step
    compose.run_to(10**9)
    wait_for(lambda: compose.status().learner_step > before + 5, "steps of the longer run")
    assert [compose.restarts(service) for service in parts] == [0, *restarts]
