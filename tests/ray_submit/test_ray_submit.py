"""deploy/cluster.yaml as a user runs it: up, submit, a machine lost and back, finish, down. Needs root."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from liir_common.checkpoint import CheckpointStore
from liir_common.files import read_table
from tests.ray_submit.machines import ENVIRONMENT, SSHD, VENV, Machine

pytestmark = [pytest.mark.ray_submit, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parents[2]
UPLOADED = ("liir_common", "services", "configs", "deploy")
FILES = (
    "pyproject.toml",
    "requirements.txt",
    "requirements-torch.txt",
    "requirements-torch-cpu.txt",
    "README.md",
    "LICENSE",
)
ACTORS = 4
RUN = "runs/test"
SETTINGS = (
    f"actors.count={ACTORS}",
    "training.total_env_steps=100000000",
    "training.batch_episodes=8",
    "training.checkpoint_interval=80",
    "evaluation.episodes=2",
    "learner.threads=1",
)
CLUSTER, TRAIN = "deploy/cluster.yaml", "deploy/train.py"
LEARNER = "services.learner --"
"""In the learner's command line."""


class Cluster:
    """The user's machine, in the project's folder; a head and a worker with a key of the user's."""

    def __init__(self, folder: Path, workers_gpus: int) -> None:
        """All three on, no Ray yet, which will be told of so many GPUs that the worker has."""
        self.user, self.head, self.worker = (
            Machine(folder / name, number) for number, name in enumerate(("user", "head", "worker"), start=1)
        )
        self._give_project(workers_gpus)
        self._give_keys()
        self.user.boot("true", None)
        for machine in (self.head, self.worker):
            (machine.home / "liir-venv").symlink_to(VENV)
            machine.boot(SSHD, self.user)
        self.ray("get-auth-token --generate")

    def end(self) -> None:
        """All three off."""
        for machine in (self.worker, self.head, self.user):
            machine.lose()

    def ray(self, command: str) -> str:
        """Run `ray COMMAND` in the project's folder on the user's machine; returns its output."""
        return self.user.run(f"cd liir && ray {command}")

    def submit(self, output: Path, *arguments: str) -> subprocess.Popen[bytes]:
        """Begin `ray submit … -- ARGUMENTS`."""
        settings = " ".join(f"--set {setting}" for setting in SETTINGS)
        command = f"ray submit {CLUSTER} {TRAIN} -- --run-dir {RUN} {settings} {' '.join(arguments)}"
        return self.user.start(f"cd liir && {command}", output)

    def _give_project(self, workers_gpus: int) -> None:
        folder = self.user.home / "liir"
        for name in UPLOADED:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in FILES:
            shutil.copy(ROOT / name, folder)
        cluster = yaml.safe_load((ROOT / CLUSTER).read_text())
        cluster["provider"] |= {"head_ip": self.head.address, "worker_ips": [self.worker.address]}
        cluster["auth"]["ssh_user"] = "root"
        cluster["worker_start_ray_commands"][-1] += f" --num-gpus={workers_gpus}"
        # They reach no registry, and have this machine's packages instead.
        cluster["setup_commands"] = [
            line for line in cluster["setup_commands"] if " -r " not in line and "install-torch" not in line
        ]
        assert any("--no-deps" in line for line in cluster["setup_commands"])
        (folder / CLUSTER).write_text(yaml.safe_dump(cluster))

    def _give_keys(self) -> None:
        for machine in (self.user, self.head, self.worker):
            (machine.home / ".ssh").mkdir(mode=0o700)
        key = self.user.home / ".ssh" / "id_ed25519"
        subprocess.run(["ssh-keygen", "-q", "-N", "", "-t", "ed25519", "-f", str(key)], check=True)
        for machine in (self.head, self.worker):
            shutil.copy(f"{key}.pub", machine.home / ".ssh" / "authorized_keys")


@pytest.fixture
def cluster(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Cluster]:
    """Three machines that are on; the worker has as many GPUs as the test's parameter says, or none."""
    missing = [tool for tool in ("sshd", "rsync", "ip") if not shutil.which(tool, path=ENVIRONMENT["PATH"])]
    if missing:
        pytest.fail(f"wants {', '.join(missing)}: apt-get install openssh-server rsync iproute2")
    cluster = Cluster(tmp_path, getattr(request, "param", 0))
    try:
        yield cluster
    finally:
        cluster.end()


def wait_for(condition: Callable[[], object], what: str, timeout_s: float = 300.0) -> None:
    """Poll until `condition` holds."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {timeout_s:g} s"
        time.sleep(1)


def processes(machine: Machine, command: str) -> int:
    """How many processes of the machine have a command line that contains `command`."""
    return len(machine.run(f"pgrep -f '[{command[0]}]{command[1:]}' || true").split())


def learner_step(run_dir: Path) -> int:
    """The newest learner step of the run."""
    rows = read_table(run_dir / "metrics.csv")
    return int(rows[-1]["learner_step"]) if rows else 0


def secrets(certs: Path) -> list[str]:
    """Every token, and the second line of every private key."""
    tokens = [line.split()[1] for line in (certs / "learner" / "tokens").read_text().splitlines()]
    return tokens + [key.read_text().splitlines()[1] for key in certs.rglob("*key.pem")]


def holding(machine: Machine, texts: list[str]) -> list[str]:
    """Files that the machine has written, to its disk or /tmp, with one of the texts in them."""
    search = [
        "grep",
        "--recursive",
        "--files-with-matches",
        "--fixed-strings",
        *(f"--regexp={text}" for text in texts),
    ]
    found = subprocess.run([*search, str(machine.disk)], stdout=subprocess.PIPE, text=True).stdout
    return (found + machine.run(f"{' '.join(search)} /tmp || true")).split()


def test_up_submit_a_worker_lost_and_back_finish_down(cluster: Cluster, tmp_path: Path) -> None:
    cluster.ray(f"up --yes {CLUSTER}")
    run_dir, certs = cluster.head.home / RUN, cluster.head.home / "certs" / "test"
    output = tmp_path / "submit.log"
    submitted = cluster.submit(output, "--config configs/3m.yaml")

    def running() -> int:
        assert submitted.poll() is None, output.read_text(errors="replace")[-3000:]
        return learner_step(run_dir)

    # The learner and the evaluator are children of Ray actors, the rollout actors sit on both machines.
    wait_for(lambda: running() > 0, "the first learner step", 600)
    assert processes(cluster.head, LEARNER) == 1
    assert processes(cluster.head, "ray::Host") + processes(cluster.worker, "ray::Host") == 2
    wait_for(lambda: actors(cluster) == (ACTORS // 2, ACTORS // 2), "actors on both machines")
    wait_for(lambda: (run_dir / "evaluations.csv").exists(), "the first evaluation")

    # From outside nobody has Ray do anything without the token that `ray up` brought here.
    status = f"ray status --address={cluster.head.address}:6379"
    assert "Active" in cluster.worker.run(f"RAY_AUTH_MODE=token {status}")
    assert "InvalidAuthToken" in cluster.worker.run(f"RAY_AUTH_MODE=disabled {status} 2>&1 || true")

    # The worker is lost: the head plays on alone. It is back: Ray sets it up again, actors move there.
    cluster.worker.lose()
    lost_at = running()
    wait_for(lambda: running() > lost_at + 3, "learner steps without the worker")
    wait_for(lambda: processes(cluster.head, "ray::ActorProcess") == ACTORS, "all actors on the head")
    cluster.worker.boot(SSHD, cluster.user)
    wait_for(lambda: running() and actors(cluster) == (ACTORS // 2, ACTORS // 2), "actors on both again", 600)

    # A stop is graceful; the run goes on under the same address and token, and is complete in the end.
    stopped_at = running()
    address = json.loads((run_dir / "endpoints.json").read_text())["address"]
    cluster.ray(f"exec {CLUSTER} 'liir stop --learner {address} --set security=certs/test/operator'")
    assert submitted.wait(120) == 0, output.read_text(errors="replace")[-3000:]
    more = int(read_table(run_dir / "metrics.csv")[-1]["env_steps"]) + 2000
    submitted = cluster.submit(output, "--resume", f"--set training.total_env_steps={more}")
    assert submitted.wait(400) == 0, output.read_text(errors="replace")[-3000:]
    assert learner_step(run_dir) > stopped_at
    assert json.loads((run_dir / "summary.json").read_text())["evaluations"] > 0

    # What is fetched is the run; no secret is in it, in what was printed or in what Ray wrote.
    cluster.ray(f"rsync-down {CLUSTER} '~/runs/' runs/")
    fetched = cluster.user.home / "liir" / RUN
    store = CheckpointStore(str(fetched / "checkpoints"))
    assert [manifest.episode for manifest in store.manifests][:2] == [80, 160]
    ours = secrets(certs)
    assert len(ours) > 8
    leaks = [
        leak for machine in (cluster.user, cluster.head, cluster.worker) for leak in holding(machine, ours)
    ]
    assert leaks
    assert not [leak for leak in leaks if not Path(leak).is_relative_to(certs)]
    assert not [secret for secret in ours if secret in output.read_text(errors="replace")]

    cluster.ray(f"down --yes {CLUSTER}")
    assert processes(cluster.head, "raylet") == 0


@pytest.mark.parametrize("cluster", [1], indirect=True)
def test_a_learner_on_a_machine_with_a_gpu_that_is_lost_and_back(cluster: Cluster, tmp_path: Path) -> None:
    """Ray is told of a GPU, which is all that decides where the learner is; it computes on the CPU."""
    cluster.ray(f"up --yes {CLUSTER}")
    wait_for(lambda: processes(cluster.worker, "raylet/raylet"), "the worker's Ray")
    run_dir, output = cluster.worker.home / RUN, tmp_path / "submit.log"
    submitted = cluster.submit(output, "--config configs/3m.yaml --set training.save_interval=5")

    def running() -> int:
        assert submitted.poll() is None, output.read_text(errors="replace")[-3000:]
        return learner_step(run_dir)

    wait_for(lambda: running() > 10, "learner steps", 600)
    assert (processes(cluster.head, LEARNER), processes(cluster.worker, LEARNER)) == (0, 1)
    cluster.worker.lose()
    lost_at = running()
    time.sleep(45)  # longer than Ray takes to see it
    assert running() == lost_at
    assert not processes(cluster.head, LEARNER), "its run is on the other machine's disk"
    cluster.worker.boot(SSHD, cluster.user)
    wait_for(lambda: running() > lost_at + 5, "learner steps beyond those before", 600)
    assert (processes(cluster.head, LEARNER), processes(cluster.worker, LEARNER)) == (0, 1)
    steps = [int(row["learner_step"]) for row in read_table(run_dir / "metrics.csv")]
    assert steps == list(range(1, len(steps) + 1))

    # Its files are on the head in the end.
    address = json.loads((run_dir / "endpoints.json").read_text())["address"]
    cluster.ray(f"exec {CLUSTER} 'liir stop --learner {address} --set security=certs/test/operator'")
    assert submitted.wait(120) == 0, output.read_text(errors="replace")[-3000:]
    assert learner_step(cluster.head.home / RUN) == learner_step(run_dir)
    cluster.ray(f"down --yes {CLUSTER}")


def test_a_head_that_is_lost_and_back(cluster: Cluster, tmp_path: Path) -> None:
    """Launcher, driver and learner are on it: the run ends everywhere, and goes on from its last save."""
    cluster.ray(f"up --yes {CLUSTER}")
    run_dir, output = cluster.head.home / RUN, tmp_path / "submit.log"
    submitted = cluster.submit(output, "--config configs/3m.yaml --set training.save_interval=5")
    wait_for(lambda: learner_step(run_dir) > 10, "learner steps", 600)
    wait_for(lambda: actors(cluster) == (ACTORS // 2, ACTORS // 2), "actors on both machines")
    cluster.head.lose()
    assert submitted.wait(120) != 0
    wait_for(lambda: processes(cluster.worker, "ray::") == 0, "the end of all that was on the worker")
    lost_at = learner_step(run_dir)
    kept = CheckpointStore(str(run_dir / "checkpoints")).manifests

    cluster.head.boot(SSHD, cluster.user)
    cluster.ray(f"up --yes {CLUSTER}")
    more = int(read_table(run_dir / "metrics.csv")[-1]["env_steps"]) + 2000
    submitted = cluster.submit(output, "--resume", f"--set training.total_env_steps={more}")
    assert submitted.wait(600) == 0, output.read_text(errors="replace")[-3000:]
    steps = [int(row["learner_step"]) for row in read_table(run_dir / "metrics.csv")]
    assert steps == list(range(1, len(steps) + 1))
    assert len(steps) > lost_at
    manifests = CheckpointStore(str(run_dir / "checkpoints")).manifests
    assert manifests[: len(kept)] == kept != []
    tested = [int(row["episode"]) for row in read_table(run_dir / "evaluations.csv")]
    assert tested == [manifest.episode for manifest in manifests]
    cluster.ray(f"down --yes {CLUSTER}")


def actors(cluster: Cluster) -> tuple[int, int]:
    """How many rollout actors there are on the head and on the worker."""
    return processes(cluster.head, "ray::ActorProcess"), processes(cluster.worker, "ray::ActorProcess")
