"""`liir train` on every interface with TLS, client certificates and tokens; it leaves no secret anywhere."""

from __future__ import annotations

import json
import shutil
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from liir_common.files import read_table
from tests.e2e import service


@pytest.fixture
def ray_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where Ray writes; short, since its sockets are in there."""
    folder = Path(tempfile.mkdtemp(prefix="ray-"))
    monkeypatch.setenv("RAY_TMPDIR", str(folder))
    yield folder
    shutil.rmtree(folder)


def test_a_secure_run_lets_in_by_role_and_leaves_no_secret(
    tmp_path: Path, ray_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRPC_VERBOSITY", "debug")
    monkeypatch.setenv("PYTHONASYNCIODEBUG", "1")
    certs, run_dir = tmp_path / "certs", tmp_path / "run"
    printed = service.finish(service.start("certs", "-o", str(certs)))
    config = tmp_path / "secure.yaml"
    config.write_text(f"learner: {{host: 0.0.0.0}}\n{printed}")
    tokens = (certs / "learner" / "tokens").read_text()
    # At first the tokens are in the environment, after the restart in the file that the configuration names.
    environment = ("security.tokens=''", "training.total_env_steps=1000000")
    outputs = [printed]
    monkeypatch.setenv("LIIR_TOKENS", tokens)
    with service.training(run_dir, *environment, options=["--config", str(config)]) as process:
        monkeypatch.delenv("LIIR_TOKENS")
        service.wait_for(lambda: (run_dir / "evaluations.csv").exists(), "the first evaluation")
        address = service.endpoints(run_dir)["address"]

        def liir(*command: str, code: int = 0, role: str = "reader", **files: str) -> str:
            settings = [f"security={certs / role}", *(f"security.{k}='{name}'" for k, name in files.items())]
            options = [part for setting in settings for part in ("--set", setting)]
            outputs.append(service.finish(service.start(*command, "--learner", address, *options), code))
            return outputs[-1]

        assert '"actors": 2' in liir("status")
        assert " 20 " in liir("checkpoints", "list")
        liir("checkpoints", "get", "20", "-o", str(tmp_path / "fetched"))
        assert "may not call this; it takes operator" in liir("stop", code=5)
        assert "PERMISSION_DENIED: a token of role reader" in liir("actors", code=5)
        assert "got none; name a file" in liir("status", code=5, tokens="")
        metrics = service.endpoints(run_dir)["metrics"]
        outputs.append(urllib.request.urlopen(f"http://{metrics}/metrics", timeout=5).read().decode())
        liir("stop", role="operator")
        outputs.append(service.finish(process))
    # The run keeps the names of the files, not what is in them.
    more = int(read_table(run_dir / "metrics.csv")[-1]["env_steps"]) + 1000
    file = (f"training.total_env_steps={more}", f"security.tokens={certs / 'learner' / 'tokens'}")
    outputs.append(service.train(run_dir, *file, options=["--resume"]))
    assert json.loads((run_dir / "summary.json").read_text())["evaluations"] > 0

    written = [file for folder in (run_dir, ray_folder, tmp_path / "fetched") for file in files_of(folder)]
    assert run_dir / "logs" / "actors.log" in written
    assert any(file.suffix == ".err" for file in written), "Ray's logs are elsewhere"
    kept = secrets(certs)
    assert len(kept) > 8
    for text in [*(file.read_bytes() for file in written), *(output.encode() for output in outputs)]:
        assert not [secret for secret in kept if secret in text]


def files_of(folder: Path) -> list[Path]:
    return [file for file in folder.rglob("*") if file.is_file()]


def secrets(certs: Path) -> list[bytes]:
    """Every token, and every line of every private key."""
    found = [line.split()[1] for line in (certs / "learner" / "tokens").read_bytes().splitlines()]
    for file in certs.rglob("*key.pem"):
        found += [line for line in file.read_bytes().splitlines() if b"-----" not in line]
    return found
