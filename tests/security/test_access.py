"""Who may call what: a real TLS server on loopback, asked by every role for every method."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2
from grpc_reflection.v1alpha import reflection_pb2

from liir_common import config, metrics
from liir_common.certs import make_certs
from liir_common.client import CheckpointClient
from liir_common.config import PLAINTEXT, SecurityConfig, load
from liir_common.errors import ConfigError, UnreachableError
from liir_common.rpc import channel, tokens
from liir_common.rpc.gen.liir.v1 import (
    checkpoint_pb2,
    checkpoint_pb2_grpc,
    rollout_pb2,
    rollout_pb2_grpc,
    training_pb2,
    training_pb2_grpc,
)
from liir_common.rpc.server import Server
from liir_common.rpc.tokens import Role
from tests.grpcurl import needs_grpcurl

ROOT = Path(__file__).parents[2]
DENIED, UNKNOWN = grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.UNAUTHENTICATED
REACHED = "Method not implemented!"
"""What the generated servicers say when a call has come through; no test here needs more than that."""
# Which of actor, evaluator, reader and operator may call a method.
ACCESS = {
    "/liir.v1.RolloutService/Play": "x--x",
    "/liir.v1.CheckpointService/ListCheckpoints": "-xxx",
    "/liir.v1.CheckpointService/GetCheckpoint": "-xxx",
    "/liir.v1.CheckpointService/WatchCheckpoints": "-xxx",
    "/liir.v1.CheckpointService/ListEvaluations": "-xxx",
    "/liir.v1.CheckpointService/ReportEvaluation": "-x-x",
    "/liir.v1.TrainingService/GetRun": "xxxx",
    "/liir.v1.TrainingService/GetStatus": "--xx",
    "/liir.v1.TrainingService/Stop": "---x",
    "/liir.v1.TrainingService/NoSuchMethod": "----",
    "/other.Service/Method": "----",
}
HEALTH = "/grpc.health.v1.Health/Check"


def security(folder: Path, **files: str) -> SecurityConfig:
    """The learner's section, as `liir certs` prints it, with other files of `folder` if named."""
    named = [f"security.{key}='{folder / name if name else ''}'" for key, name in files.items()]
    return load(None, [f"security={folder / 'learner'}", *named]).security


@contextmanager
def serving(settings: SecurityConfig) -> Iterator[str]:
    """A server with all services, in a thread of its own; yields its address."""
    started: dict[str, Any] = {}
    ready = threading.Event()

    async def serve() -> None:
        server = Server("127.0.0.1", 0, settings)
        rollout_pb2_grpc.add_RolloutServiceServicer_to_server(
            rollout_pb2_grpc.RolloutServiceServicer(), server.grpc
        )
        checkpoint_pb2_grpc.add_CheckpointServiceServicer_to_server(
            checkpoint_pb2_grpc.CheckpointServiceServicer(), server.grpc
        )
        training_pb2_grpc.add_TrainingServiceServicer_to_server(
            training_pb2_grpc.TrainingServiceServicer(), server.grpc
        )
        await server.start()
        ended = asyncio.Event()
        started.update(port=server.port, end=ended.set, loop=asyncio.get_running_loop())
        ready.set()
        await ended.wait()
        await server.stop(0)

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    assert ready.wait(10)
    try:
        yield f"127.0.0.1:{started['port']}"
    finally:
        started["loop"].call_soon_threadsafe(started["end"])
        thread.join()


@pytest.fixture(scope="module")
def learner(certs: Path) -> Iterator[str]:
    with serving(security(certs)) as address:
        yield address


def ask(address: str, method: str, settings: SecurityConfig, role: Role = Role.READER) -> tuple[Any, str]:
    """Status code and details of a call with an empty request."""
    with channel.connect(address, 10, settings, role) as connection:
        return ask_over(connection, method)


def ask_over(connection: grpc.Channel, method: str, metadata: Any = None) -> tuple[Any, str]:
    try:
        list(connection.stream_stream(method)(iter([b""]), timeout=10, metadata=metadata))
    except grpc.RpcError as error:
        return error.code(), error.details()
    return grpc.StatusCode.OK, ""


@pytest.mark.parametrize(("index", "role"), list(enumerate(Role)))
def test_each_role_reaches_its_methods_and_no_other(
    learner: str, certs: Path, index: int, role: Role
) -> None:
    with channel.connect(learner, 10, SecurityConfig.of(certs / role), role) as connection:
        for method, access in ACCESS.items():
            code, details = ask_over(connection, method)
            if access[index] == "x":
                assert REACHED in details, (method, code, details)
            else:
                assert code == DENIED, (method, code, details)
                assert f"role {role} may not call this" in details
        assert ask_over(connection, HEALTH)[0] == grpc.StatusCode.OK
        for version in ("v1alpha", "v1"):
            reflected = connection.stream_stream(
                f"/grpc.reflection.{version}.ServerReflection/ServerReflectionInfo",
                reflection_pb2.ServerReflectionRequest.SerializeToString,
                reflection_pb2.ServerReflectionResponse.FromString,
            )(iter([reflection_pb2.ServerReflectionRequest(list_services="")]), timeout=10)
            assert len(next(reflected).list_services_response.service) == 5


def test_every_method_that_is_served_has_its_line_in_the_table() -> None:
    modules = (rollout_pb2, checkpoint_pb2, training_pb2, health_pb2, reflection_pb2)
    services = [s for module in modules for s in module.DESCRIPTOR.services_by_name.values()]
    served = {f"/{service.full_name}/{method.name}" for service in services for method in service.methods}
    # The package grpcio-reflection has v1alpha alone, whose messages v1 shares.
    served.add("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo")
    assert served == set(tokens.METHODS) | tokens.PUBLIC
    assert not set(tokens.METHODS) & tokens.PUBLIC


@pytest.mark.parametrize("host", ["", "bad host", "learner:50051", "a..b", "https://learner"])
def test_what_is_no_host_gets_no_certificate(tmp_path: Path, host: str) -> None:
    with pytest.raises(ConfigError, match="wanted a host's name or IP address without a port, got"):
        make_certs(tmp_path, [host])
    assert not [*tmp_path.iterdir()]


def test_a_reader_can_list_get_and_watch_and_nothing_else() -> None:
    ours = {method for method in tokens.METHODS if method.startswith("/liir.")}
    reads = {method for method in ours if re.match("List|Get|Watch", method.rpartition("/")[2])}
    assert {method for method in ours if Role.READER in tokens.METHODS[method]} == reads
    assert len(reads) == 6


def shell(commands: str, folder: Path) -> str:
    """All that documented commands print in a folder."""
    done = subprocess.run(
        ["sh", "-c", commands],
        cwd=folder,
        env={"PATH": os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=60,
    )
    return done.stdout


@needs_grpcurl
def test_grpcurl_is_let_in_as_documented_and_not_with_less(learner: str, certs: Path) -> None:
    block = re.search(r"```\n(TOKEN=.*?)```", (ROOT / "docs/api.md").read_text(), re.DOTALL)
    assert block
    commands = block[1].replace("learner.example:50051", learner)
    status, certificate, header = "liir.v1.TrainingService/GetStatus", r"-cert \S+ -key \S+", '-H ".*?"'
    assert REACHED in shell(commands, certs)
    assert "liir.v1.CheckpointService" in shell(commands.replace(status, "list"), certs).split()
    assert "got none" in shell(re.sub(header, "", commands), certs)
    uncertified = re.sub(certificate, "-connect-timeout 2", commands)
    assert "Failed to dial" in shell(uncertified, certs)


def test_without_a_token_only_health_answers(learner: str, certs: Path) -> None:
    with channel.connect(learner, 10, security(certs, tokens="")) as connection:
        for method in ACCESS:
            code, details = ask_over(connection, method)
            assert (code, "got none" in details) == (UNKNOWN, True), (method, code, details)
        assert ask_over(connection, HEALTH)[0] == grpc.StatusCode.OK
        for header in ("Bearer", "Bearer ", "Basic abc", f"Bearer {'x' * 43}", "Bearer " + "y" * 4000):
            code, details = ask_over(connection, next(iter(ACCESS)), [("authorization", header)])
            assert code == UNKNOWN, (header, details)
            assert "xxx" not in details


def test_an_expired_token_is_refused_with_its_date(tmp_path: Path, certs: Path) -> None:
    folder = tmp_path / "certs"
    shutil.copytree(certs, folder)
    (folder / "learner" / "tokens").write_text(
        f"reader {'a' * 40} 2020-02-29\nactor {'b' * 40} 2999-01-01T10:00+02:00 # new\n"
    )
    status = "/liir.v1.TrainingService/GetStatus"
    with serving(security(folder)) as address:
        code, details = ask(address, status, security(folder))
        assert (code, "reader, expired at 2020-02-29 00:00 UTC" in details) == (UNKNOWN, True)
        assert REACHED in ask(address, "/liir.v1.TrainingService/GetRun", security(folder), Role.ACTOR)[1]


def test_the_wrong_certificates_are_explained(learner: str, certs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    shutil.copytree(certs, folder)
    make_certs(folder / "other")
    pair = {"cert": "other/reader/cert.pem", "key": "other/reader/key.pem"}
    wrong = {
        "another CA": ({"ca": "other/ca.pem"}, "CERTIFICATE_VERIFY_FAILED"),
        "no client certificate": ({"cert": "", "key": "", "client_ca": ""}, "security.ca"),
        "one of another CA": (pair, "security.ca"),
        "plaintext": (None, "security.ca"),
    }
    for case, (files, message) in wrong.items():
        settings = PLAINTEXT if files is None else security(folder, **files)
        with pytest.raises(UnreachableError) as caught:
            channel.connect(learner, 2, settings)
        assert message in str(caught.value), case


async def bind(host: str, settings: SecurityConfig, insecure: bool = False) -> None:
    server = Server(host, 0, settings, insecure)
    await server.stop(0)


@pytest.mark.parametrize(
    ("files", "missing"),
    [
        ({"tokens": ""}, "without tokens"),
        ({"tokens": "", "cert": "", "key": "", "client_ca": ""}, "without TLS (security.cert) and tokens"),
        ({"cert": "", "key": "", "client_ca": ""}, "no security.cert; a token never travels in plaintext"),
    ],
)
@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "learner.example"])
def test_off_loopback_both_are_needed(certs: Path, host: str, files: dict[str, str], missing: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(missing)):
        asyncio.run(bind(host, security(certs, **files)))


def test_off_loopback_with_both_or_when_told_so(certs: Path) -> None:
    asyncio.run(bind("0.0.0.0", security(certs)))
    asyncio.run(bind("0.0.0.0", PLAINTEXT, insecure=True))
    asyncio.run(bind("127.0.0.1", PLAINTEXT))


def test_a_client_never_sends_a_token_in_plaintext(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(tokens.VARIABLE, f"reader {'a' * 40}")
    with pytest.raises(ConfigError, match=r"no security\.ca; a token never travels in plaintext"):
        CheckpointClient("127.0.0.1:1")


def test_tokens_may_come_from_the_environment(
    learner: str, certs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(tokens.VARIABLE, (certs / "learner" / "tokens").read_text())
    settings = security(certs, tokens="")
    assert REACHED in ask(learner, "/liir.v1.TrainingService/Stop", settings, Role.OPERATOR)[1]


def test_tokens_rotate_without_a_restart(tmp_path: Path, certs: Path) -> None:
    folder = tmp_path / "certs"
    shutil.copytree(certs, folder)
    file, method = folder / "learner" / "tokens", "/liir.v1.TrainingService/GetStatus"
    (folder / "client").write_text(file.read_text())
    with (
        serving(security(folder)) as address,
        channel.connect(address, 10, security(folder, tokens="client")) as connection,
    ):
        assert REACHED in ask_over(connection, method)[1]
        replace(file, f"reader {'n' * 40}\n")
        assert ask_over(connection, method)[0] == UNKNOWN
        replace(folder / "client", f"reader {'n' * 40}\n")
        assert REACHED in ask_over(connection, method)[1]
        replace(file, "nonsense\n")
        assert REACHED in ask_over(connection, method)[1]


def replace(file: Path, text: str) -> None:
    new = file.with_suffix(".new")
    new.write_text(text)
    new.replace(file)


def test_certificates_rotate_without_a_restart(tmp_path: Path, certs: Path) -> None:
    folder = tmp_path / "certs"
    shutil.copytree(certs, folder)
    with serving(security(folder, client_ca="")) as address:
        host, port = address.split(":")
        before = ssl.get_server_certificate((host, int(port)))
        assert before.strip() == (certs / "learner" / "cert.pem").read_text().strip()
        make_certs(folder)
        for name in ("ca.pem", "learner/tokens", "reader/tokens", "reader/ca.pem"):
            assert (folder / name).read_text() == (certs / name).read_text()
        after = ssl.get_server_certificate((host, int(port)))
        assert after.strip() == (folder / "learner" / "cert.pem").read_text().strip() != before.strip()
        # Between the two new files, and after a failed rotation: the last pair that was one.
        (folder / "learner" / "key.pem").write_text((certs / "learner" / "key.pem").read_text())
        assert ssl.get_server_certificate((host, int(port))) == after
        (folder / "learner" / "cert.pem").unlink()
        assert ssl.get_server_certificate((host, int(port))) == after


def test_client_cas_rotate_without_a_restart(tmp_path: Path, certs: Path) -> None:
    folder, method = tmp_path / "certs", "/liir.v1.TrainingService/GetStatus"
    shutil.copytree(certs, folder)
    make_certs(folder / "other")
    (folder / "clients.pem").write_text((folder / "other" / "ca.pem").read_text())
    old = security(folder)
    new = security(folder, cert="other/reader/cert.pem", key="other/reader/key.pem")
    with serving(security(folder, client_ca="clients.pem")) as address:
        with pytest.raises(UnreachableError):
            channel.connect(address, 1, old)
        assert REACHED in ask(address, method, new)[1]
        replace(folder / "clients.pem", (folder / "ca.pem").read_text())
        assert REACHED in ask(address, method, old)[1]
        with pytest.raises(UnreachableError):
            channel.connect(address, 1, new)


def test_metrics_are_served_on_loopback_unless_asked() -> None:
    host = load().metrics.host
    port = metrics.serve(metrics.LEARNER, host, 0, "learner.metrics_port")
    socket.create_connection(("127.0.0.1", port), timeout=5).close()
    with pytest.raises(ConnectionRefusedError):  # an address of this machine, too
        socket.create_connection(("127.0.0.2", port), timeout=5)


def test_private_files_are_private(certs: Path) -> None:
    for file in filter(Path.is_file, certs.rglob("*")):
        private = file.name in ("tokens", "ray-token", "key.pem", "ca-key.pem")
        assert file.stat().st_mode & 0o777 == (0o600 if private else 0o644), file


def test_rays_token_is_kept_until_it_is_removed(tmp_path: Path) -> None:
    make_certs(tmp_path)
    assert len(token := (tmp_path / "actor" / "ray-token").read_text()) == 64
    make_certs(tmp_path)
    assert (tmp_path / "actor" / "ray-token").read_text() == token
    (tmp_path / "actor" / "ray-token").unlink()
    make_certs(tmp_path)
    assert (tmp_path / "actor" / "ray-token").read_text() != token


def test_a_role_is_handed_its_own_tokens(tmp_path: Path) -> None:
    make_certs(tmp_path)
    tokens_file = tmp_path / "learner" / "tokens"
    lines = tokens_file.read_text().splitlines()
    for line, role in zip(lines, Role, strict=True):
        assert (tmp_path / role / "tokens").read_text() == f"{line}\n"
    new = f"reader {'n' * 40} 2999-01-01 # for a while\n"
    tokens_file.write_text(new + "\n".join(lines))
    make_certs(tmp_path)
    assert (tmp_path / "reader" / "tokens").read_text() == f"{new}{lines[2]}\n"
    tokens_file.unlink()
    make_certs(tmp_path)
    assert not set(lines) & set(tokens_file.read_text().splitlines())
    assert (tmp_path / "actor" / "tokens").read_text() == tokens_file.read_text().splitlines(True)[0]
    tokens_file.write_text("reader short\n")
    with pytest.raises(ConfigError, match="tokens, line 1: wanted"):
        make_certs(tmp_path)


@pytest.mark.parametrize("name", ["cert", "key", "client_ca", "tokens"])
def test_a_missing_file_is_named(certs: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=rf"security\.{name}, .*missing: No such file"):
        asyncio.run(bind("127.0.0.1", security(certs, **{name: "missing"})))
    with pytest.raises(ConfigError, match=r"security\.ca, .*missing: No such file"):
        channel.connect("127.0.0.1:1", 1, security(certs, ca="missing"))


@pytest.mark.parametrize(
    "line",
    ["king SECRET", "reader", "reader short", "reader SECRET tomorrow", "reader SECRET 2027-01-01 more"],
)
def test_a_bad_line_is_named_and_not_quoted(line: str) -> None:
    secret = "s" * 40
    with pytest.raises(ConfigError) as caught:
        tokens.parse(f"# comment\n\n{line.replace('SECRET', secret)}\n", "tokens")
    assert "tokens, line 3" in str(caught.value)
    assert secret not in str(caught.value)


def test_no_secret_shows_in_a_repr_or_a_configuration_error(certs: Path) -> None:
    secret = "s" * 40
    (token,) = tokens.parse(f"reader {secret}", "tokens")
    assert secret not in repr(token)
    for setting in (f"security.tokens=[{secret}]", f"security={secret}", f"security.token={secret}"):
        with pytest.raises(ConfigError) as caught:
            config.load(None, [setting])
        assert secret not in str(caught.value)


def test_half_a_pair_is_a_mistake() -> None:
    with pytest.raises(ConfigError, match="cert and key belong together"):
        config.load(None, ["security.cert=a"])
    with pytest.raises(ConfigError, match="takes a cert and key of its own"):
        config.load(None, ["security.client_ca=a"])
