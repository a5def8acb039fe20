"""Where the learner goes in a cluster, and how secrets get there."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import chain, repeat
from pathlib import Path
from unittest.mock import Mock

import pytest
import ray

from liir_common.certs import make_certs
from liir_common.config import PLAINTEXT, SecurityConfig, load
from liir_common.errors import ConfigError, LiirError
from liir_common.launch import Request
from liir_common.rpc import carry
from liir_common.rpc.tokens import VARIABLE, Role, Tokens
from services.cluster.__main__ import learners_place, roles_security
from services.cluster.host import Host, RemoteService

HEAD = {"CPU": 4.0, "node:10.0.0.1": 1.0, "node:__internal_head__": 1.0}
WORKER = {"CPU": 8.0, "node:10.0.0.2": 1.0}
ON_HEAD = {"node:__internal_head__": 0.001}


def request(run_dir: Path, *settings: str, resume: bool = False) -> Request:
    return Request(run_dir, load(None, settings), None, settings, resume)


@pytest.mark.parametrize(
    ("head", "worker", "settings", "gpus", "resources"),
    [
        ({}, {}, (), 0, ON_HEAD),
        ({}, {"GPU": 2.0}, (), 1, None),
        ({}, {"GPU": 2.0}, ("learner.device=cpu",), 0, ON_HEAD),
        ({"GPU": 1.0}, {}, (), 1, None),
    ],
)
def test_a_new_run_takes_a_gpu_or_the_head(
    head: dict[str, float],
    worker: dict[str, float],
    settings: tuple[str, ...],
    gpus: int,
    resources: dict[str, float] | None,
    tmp_path: Path,
) -> None:
    nodes = {"10.0.0.1": HEAD | head, "10.0.0.2": WORKER | worker}
    place = learners_place(request(tmp_path, *settings), nodes)
    assert (place["num_cpus"], place["num_gpus"], place.get("resources")) == (0, gpus, resources)


def test_a_resumed_run_goes_where_its_directory_is(tmp_path: Path) -> None:
    (tmp_path / "endpoints.json").write_text(json.dumps({"address": "10.0.0.2:50051"}))
    resumed = request(tmp_path, resume=True)
    nodes = {"10.0.0.1": HEAD, "10.0.0.2": WORKER | {"GPU": 1.0}}
    assert learners_place(resumed, nodes) == {
        "num_cpus": 0,
        "num_gpus": 1,
        "resources": {"node:10.0.0.2": 0.001},
    }
    with pytest.raises(LiirError, match=r"on the disk of 10\.0\.0\.2, and only 10\.0\.0\.1"):
        learners_place(resumed, {"10.0.0.1": HEAD})
    (tmp_path / "state").mkdir()  # of a learner that was here, or was copied here
    assert learners_place(resumed, {"10.0.0.1": HEAD})["resources"] == ON_HEAD


def test_a_run_that_never_served_or_comes_from_a_backup_goes_to_the_head(tmp_path: Path) -> None:
    nodes = {"10.0.0.1": HEAD, "10.0.0.2": WORKER | {"GPU": 1.0}}
    assert learners_place(request(tmp_path, resume=True), nodes)["resources"] == ON_HEAD


def test_tokens_of_the_environment_are_carried(monkeypatch: pytest.MonkeyPatch) -> None:
    line = f"operator {'x' * 32}"
    monkeypatch.setenv(VARIABLE, line)
    carried = carry.unpack(carry.pack(SecurityConfig()))
    monkeypatch.delenv(VARIABLE)
    assert Tokens(carried.tokens).own(Role.OPERATOR).secret == "x" * 32


def test_carried_files_are_in_memory_and_hold_only_the_token_of_the_role(tmp_path: Path) -> None:
    make_certs(tmp_path)
    learner = SecurityConfig.of(tmp_path / "learner")
    tokens = Tokens(learner.tokens)
    carried = carry.unpack(carry.pack(learner, Role.ACTOR))
    assert Path(carried.key).read_bytes() == Path(learner.key).read_bytes()
    assert Tokens(carried.tokens).own(Role.OPERATOR) == tokens.own(Role.ACTOR)
    assert Tokens(carry.unpack(carry.pack(learner)).tokens).own(Role.OPERATOR) == tokens.own(Role.OPERATOR)
    assert all(path.startswith("/proc/") for path in carried.model_dump().values())
    # A child, which the learner is, reads them by the same names.
    child = [sys.executable, "-c", "import sys; print(open(sys.argv[1]).read())", carried.ca]
    assert subprocess.run(child, capture_output=True, text=True, check=True).stdout.startswith("-----BEGIN")


def test_each_role_has_its_own_and_another_address_keeps_the_tokens(tmp_path: Path) -> None:
    before = roles_security(request(tmp_path), tmp_path / "certs", "10.0.0.2")
    tokens, certificate = (
        Path(before["learner"].tokens).read_text(),
        Path(before["learner"].cert).read_text(),
    )
    after = roles_security(request(tmp_path), tmp_path / "certs", "10.0.0.3")
    assert Path(after["learner"].tokens).read_text() == tokens
    assert Path(after["learner"].cert).read_text() != certificate
    assert len({security.key for security in after.values()}) == 1 + len(Role)


def test_what_is_configured_is_used_by_all(tmp_path: Path) -> None:
    make_certs(tmp_path)
    learner = tmp_path / "learner"
    for settings, security in (
        ((f"security={learner}",), SecurityConfig.of(learner)),
        (("learner.insecure=true",), PLAINTEXT),
    ):
        made = roles_security(request(tmp_path, *settings), tmp_path / "certs", "10.0.0.2")
        assert set(made.values()) == {security}
    assert not (tmp_path / "certs").exists()


def test_a_file_that_cannot_be_sent_is_named() -> None:
    with pytest.raises(ConfigError, match=r"security\.ca, /nowhere/ca\.pem: No such file"):
        carry.pack(SecurityConfig(ca="/nowhere/ca.pem"))


def lost(monkeypatch: pytest.MonkeyPatch, *logs: str, how: Exception | None = None) -> RemoteService:
    """A started evaluator whose node is lost after it told these ends of its log."""
    service = RemoteService("evaluator", [], Path("/runs/a"), {})
    answers = [None, *((None, log) for log in logs), how or ray.exceptions.RayActorError()]
    monkeypatch.setattr(service, "_new_host", Mock)
    monkeypatch.setattr("services.cluster.host.ray.wait", lambda asked, timeout: (asked, []))
    monkeypatch.setattr("services.cluster.host.ray.get", Mock(side_effect=chain(answers, repeat(None))))
    service.start()
    assert [service.exit_code for _ in answers] == [None] * (1 + len(logs)) + [-9]
    return service


def test_the_obituary_of_a_lost_process_has_its_last_phase_and_rays_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = [f'{{"event": "{phase}"}}\n' for phase in ("starts", "tested")]
    service = lost(monkeypatch, told[0], told[0] + told[1])
    text = service.obituary()
    assert "code -9 (SIGKILL) in the phase 'tested'; last exception: its node is lost: The actor" in text
    assert text.endswith("evaluator.log ends with\n" + (told[0] + told[1]).rstrip())
    service.start()
    assert service.exit_code is None
    assert "in the phase 'starting'" in service.obituary(), "the one before is no matter"


@pytest.mark.parametrize("logs", [(), ("",), ("Traceback (most recent call last):\n",)])
def test_a_lost_process_that_named_no_phase_was_in_an_unknown_one(
    logs: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "in the phase 'unknown'; last exception: its node is lost: " in lost(monkeypatch, *logs).obituary()


def test_one_that_rays_memory_monitor_killed_is_lost_too(monkeypatch: pytest.MonkeyPatch) -> None:
    text = lost(monkeypatch, how=ray.exceptions.OutOfMemoryError("low on memory")).obituary()
    assert "code -9 (SIGKILL)" in text
    assert "low on memory" in text


def test_what_is_written_or_deleted_meanwhile_is_not_brought(tmp_path: Path) -> None:
    for name in ("run.json", "metrics.csv", ".metrics.csv.x1y2"):
        (tmp_path / name).write_text(name)
    files = Host("learner", tmp_path).files("*.*")
    assert next(files) == ("metrics.csv", b"metrics.csv")
    (tmp_path / "run.json").unlink()
    assert list(files) == []


@pytest.mark.parametrize("trouble", [ray.exceptions.RaySystemError("away"), OSError("no room")])
def test_files_that_cannot_be_brought_keep_no_process_from_its_end(
    trouble: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = RemoteService("evaluator", [], tmp_path, {})
    monkeypatch.setattr(service, "_new_host", Mock)
    service.start()
    monkeypatch.setattr(service, "fetch", Mock(side_effect=trouble))
    monkeypatch.setattr("services.cluster.host.ray.get", Mock())
    kill = Mock()
    monkeypatch.setattr("services.cluster.host.ray.kill", kill)
    service.end()
    kill.assert_called_once()
