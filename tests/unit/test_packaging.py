"""What an installation holds and needs: the battle alone wants only the base dependencies."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.replays import publish

ROOT = Path(__file__).parents[2]
TORCH = "deploy/install-torch.sh"

# The first argument names what must not be imported.
BLOCKED = """
import sys
from importlib.abc import MetaPathFinder

class Blocked(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(f"{name} is no base dependency", name=name)

sys.meta_path.insert(0, Blocked())
"""
PLAY = """
from liir_common.battle.env import parallel_env
env = parallel_env("3m", render_mode="ansi")
env.reset(seed=1)
env.step(dict.fromkeys(env.agents, 1))
print(env.render())
"""


def needed(names: list[str]) -> set[str]:
    """The distributions that come with those of `names`, themselves included."""
    found: set[str] = set()
    while names:
        requirement = Requirement(names.pop())
        name, marker = canonicalize_name(requirement.name), requirement.marker
        if name not in found and (marker is None or marker.evaluate({"extra": ""})):
            found.add(name)
            names += metadata.requires(name) or ()
    return found


def all_but_base_dependencies(*extras: str) -> set[str]:
    """Top-level modules of everything installed that a `pip install` of the project would not bring.

    Of the `extras` none may name another of the project's own.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [name for extra in extras for name in project["optional-dependencies"][extra]]
    base = needed([*project["dependencies"], *wanted]) | {project["name"]}
    return {
        module
        for module, distributions in metadata.packages_distributions().items()
        if not base & {name.lower().replace("_", "-") for name in distributions}
    }


def run(code: str, blocked: set[str], path: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED + code, ",".join(blocked)],
        capture_output=True,
        text=True,
        cwd=path,
        env=os.environ | {"PYTHONPATH": str(path)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_battle_needs_the_base_dependencies_alone() -> None:
    blocked = all_but_base_dependencies()
    assert blocked >= {"torch", "ray", "grpc", "pydantic", "typer", "yaml", "PIL", "google"}
    assert "enemy 2" in run(PLAY, blocked, ROOT)
    with pytest.raises(AssertionError, match="yaml is no base dependency"):
        run("import liir_common.config", blocked, ROOT)


def test_the_command_says_what_to_install_where_the_battle_is_alone() -> None:
    with pytest.raises(AssertionError, match=r"error: the liir command needs typer; install"):
        run("from liir_common.console import main; main()", all_but_base_dependencies(), ROOT)


def test_the_client_and_its_policies_need_its_extra_alone(tmp_path: Path) -> None:
    """A checkpoint is fetched and played without torch, Ray or what else the service has."""
    blocked = all_but_base_dependencies("client")
    assert blocked >= {"torch", "ray", "onnx", "matplotlib", "zstandard"}
    path = publish(tmp_path, map_name="3m")
    play = f"""
import liir_common.client
from liir_common.battle.env import parallel_env
from liir_common.policy import Policy
print(sum(1 for _ in Policy.load({str(path)!r}).play(parallel_env("3m"), seed=1)))
"""
    assert int(run(play, blocked, ROOT)) > 5


def test_every_pinned_requirement_has_a_hash_and_no_file_names_a_registry() -> None:
    files = sorted([*ROOT.glob("requirements*.txt"), *ROOT.glob("deploy/requirements*.txt")])
    versions = set(re.findall("^torch==.*", (ROOT / "requirements-torch.in").read_text(), flags=re.M))
    assert len(files) == 9
    pinned: dict[str, set[str]] = {}
    for path in files:
        text = path.read_text()
        pins = re.split(r"^(?=[a-z])", text, flags=re.M)[1:]
        assert pins
        assert all("==" in pin and "--hash=sha256:" in pin for pin in pins)
        assert "://" not in text
        for pin in pins:
            pinned.setdefault(pin.partition("==")[0], set()).add(pin.split()[0].removesuffix("+cpu"))
        torch = {pin.split()[0].removesuffix("+cpu") for pin in pins if pin.startswith("torch==")}
        assert torch == (versions if "torch" in path.name else set()), "one version, in files of its own"
    several = {name for name, pins in pinned.items() if len(pins) > 1}
    assert not several, "what is installed together was not pinned together"


@pytest.mark.parametrize(
    "name", ["Makefile", "deploy/Dockerfile", "deploy/cluster.yaml", "deploy/cluster.aws.yaml", TORCH]
)
def test_nothing_is_installed_without_a_hash_but_ourselves(name: str) -> None:
    lines = (ROOT / name).read_text().splitlines()
    commands = [
        c for line in lines for c in re.findall(r'pip\d?"?\s.*?(?:install|wheel|download) [^&|;)]*', line)
    ]
    assert commands
    ours = re.compile(r"--no-deps.* (-e \.|\.|/wheel/\*\.whl|~/liir-service)\s*$")
    assert not [
        c for c in commands if "--require-hashes" not in c and not ours.search(c) and "apt-get" not in c
    ]


@pytest.mark.parametrize(
    ("build", "refusal"),
    [("+cpu", "DO NOT MATCH THE HASHES"), ("", "No matching distribution found for cuda-bindings==")],
)
def test_torch_is_pinned_with_or_without_cuda_as_it_is_offered(
    tmp_path: Path, build: str, refusal: str
) -> None:
    """Not as it is installed; and one that nobody pinned, as that which is offered here, is refused."""
    (version,) = re.findall("^torch==(.*)", (ROOT / "requirements-torch.in").read_text(), flags=re.M)
    wheel, info = f"torch-{version}{build}", f"torch-{version}{build}.dist-info"
    with zipfile.ZipFile(tmp_path / f"{wheel}-py3-none-any.whl", "w") as archive:
        archive.writestr(
            f"{info}/METADATA", f"Metadata-Version: 2.1\nName: torch\nVersion: {version}{build}\n"
        )
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    offered = {"PIP_FIND_LINKS": str(tmp_path), "PIP_NO_INDEX": "1", "PIP_TARGET": str(tmp_path / "site")}
    done = subprocess.run(
        [ROOT / TORCH, Path(sys.executable).with_name("pip")],
        capture_output=True,
        text=True,
        env=os.environ | offered | {"PIP_CONFIG_FILE": os.devnull},
    )
    assert done.returncode == 1
    assert refusal in done.stderr
    assert not (tmp_path / "site").exists()


def test_the_wheel_holds_the_whole_package(tmp_path: Path) -> None:
    source, site = tmp_path / "source", tmp_path / "site"
    for name in ("liir_common", "services"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, str(source), "-w", str(tmp_path)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(site)
    for package in ("liir_common", "services"):
        wanted = {p.relative_to(ROOT) for p in (ROOT / package).rglob("*") if p.is_file()}
        wanted = {p for p in wanted if "__pycache__" not in p.parts}
        assert wanted == {p.relative_to(site) for p in (site / package).rglob("*") if p.is_file()}
    code = "import liir_common.battle.env as env; print(env.__file__, env.battle_spec('3m').n_actions)"
    imported, n_actions = run(code, all_but_base_dependencies(), site).split()
    assert Path(imported).is_relative_to(site)
    assert n_actions == "9"
