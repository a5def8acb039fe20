"""Downloads from a real checkpoint service over connections that break, and from damaged stores."""

from __future__ import annotations

import asyncio
import errno
import os
import re
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from liir_common import checkpoint, config
from liir_common.checkpoint import Manifest
from liir_common.client import CheckpointClient
from liir_common.config import PLAINTEXT
from liir_common.errors import CorruptError, DamagedError, UnreachableError
from liir_common.policy import Policy
from liir_common.rollout.play import env_spec
from liir_common.rollout.policy import random_weights
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2_grpc
from liir_common.rpc.server import Server
from services.learner.checkpoint_service import CheckpointService
from services.learner.run_directory import RunDirectory
from tests.e2e.service import wait_for

API = Path(__file__).parents[2] / "docs" / "api.md"
HIDDEN = 96
"""Wide enough for a file of several chunks."""
CHUNK = 64 * 1024


class Counted(CheckpointService):
    """Remembers from where downloads and watches were asked for, and answers slowly if told to."""

    pause_s = 0.0

    def __init__(self, run: RunDirectory) -> None:
        super().__init__(run)
        self.offsets: list[int] = []
        self.watched_after: list[int] = []

    async def WatchCheckpoints(self, request: Any, context: Any) -> AsyncIterator[Any]:
        self.watched_after.append(request.after_episode)
        async for response in super().WatchCheckpoints(request, context):
            yield response

    async def GetCheckpoint(self, request: Any, context: Any) -> AsyncIterator[Any]:
        self.offsets.append(request.offset)
        async for response in super().GetCheckpoint(request, context):
            yield response
            await asyncio.sleep(self.pause_s)


class Store:
    """A run with one checkpoint, served."""

    def __init__(self, path: Path) -> None:
        self.run_dir = path
        run_config = config.load(settings=["env.map=3m", f"algorithm.policy_hidden={HIDDEN}"])
        self.run = RunDirectory(path, run_config, env_spec(run_config.env))
        self.publish(100, seed=1)

    def publish(self, episode: int, seed: int) -> None:
        spec = self.run.spec
        tensors = {f"policy.{name}": a for name, a in random_weights(spec, HIDDEN, seed).items()}
        self.data = checkpoint.pack(tensors)
        self.manifest = Manifest(
            episode=episode,
            policy_version=3,
            env_steps=1000,
            run_id="run",
            git_commit="abc",
            env_spec=asdict(spec),
            config=self.run.config.tree(),
            created=1.0,
            sha256=sha256(self.data).hexdigest(),
            size_bytes=len(self.data),
        )
        self.run.checkpoints.publish(self.manifest, self.data)

    @contextmanager
    def served(self) -> Iterator[str]:
        """The address of a server in a thread of its own."""
        started: dict[str, Any] = {}
        ready = threading.Event()

        async def serve() -> None:
            server, ended = Server("127.0.0.1", 0, PLAINTEXT), asyncio.Event()
            self.service = Counted(self.run)
            checkpoint_pb2_grpc.add_CheckpointServiceServicer_to_server(self.service, server.grpc)
            await server.start()
            self.loop = asyncio.get_running_loop()
            started.update(port=server.port, end=ended.set)
            ready.set()
            await ended.wait()
            await server.stop(0)

        thread = threading.Thread(target=asyncio.run, args=(serve(),))
        thread.start()
        assert ready.wait(10)
        try:
            yield f"127.0.0.1:{started['port']}"
        finally:
            self.loop.call_soon_threadsafe(started["end"])
            thread.join()


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "run")


@contextmanager
def cutting(address: str, part: Path, limit: int, connections: int) -> Iterator[str]:
    """A way to `address` that hangs up after `limit` bytes of answers, and for good after `connections`.

    Every connection that is cut has made the file `part` longer: gRPC drops what a client has not asked for
    yet when the connection goes, so it is held until then.
    """
    host, port = address.split(":")
    listener = socket.create_server(("127.0.0.1", 0))

    def relay(client: socket.socket) -> None:
        begun = size(part)

        def hold() -> None:
            wait_for(lambda: size(part) > begun, "the arrival of a chunk")

        with client, socket.create_connection((host, int(port))) as server:
            back = threading.Thread(target=pump, args=(client, server), daemon=True)
            back.start()
            pump(server, client, limit, hold)
            back.join()

    def accept() -> None:
        with suppress(OSError):  # the test is over
            for _ in range(connections):
                relay(listener.accept()[0])
        listener.close()

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.close()


def size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def pump(
    source: socket.socket,
    sink: socket.socket,
    limit: float = float("inf"),
    hold: Callable[[], None] = lambda: None,
) -> None:
    """Pass on what comes until its end or `limit` bytes; then `hold`, hang up on `sink`, and drop the rest.

    A socket closed before all is read would make the other end throw away what it has received.
    """
    passed = 0
    with suppress(OSError):
        while passed < limit and (data := source.recv(4096)):
            sink.sendall(data)
            passed += len(data)
    if passed >= limit:
        hold()
    with suppress(OSError):
        sink.shutdown(socket.SHUT_WR)
    with suppress(OSError):
        while source.recv(4096):
            pass


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_download_goes_on_where_it_broke(store: Store, tmp_path: Path) -> None:
    part = tmp_path / "got" / f".{store.manifest.sha256}.part"
    with store.served() as address, cutting(address, part, limit=CHUNK + 20_000, connections=99) as shaky:
        with CheckpointClient(shaky) as client:
            path = client.save(100, tmp_path / "got")
        assert path.read_bytes() == store.data
        offsets = list(store.service.offsets)
        assert offsets[0] == 0
        assert len(set(offsets)) > 2
        assert offsets == sorted(offsets), "never from the start again"
    assert files(tmp_path / "got") == ["checkpoint-000000100.json", "checkpoint-000000100.safetensors"]
    Policy.load(path)


def test_another_process_goes_on_where_the_last_one_was_cut(store: Store, tmp_path: Path) -> None:
    part = tmp_path / "got" / f".{store.manifest.sha256}.part"
    with store.served() as address:
        with (
            cutting(address, part, limit=len(store.data) // 2, connections=1) as shaky,
            CheckpointClient(shaky) as client,
            pytest.raises(UnreachableError, match="the download broke 5 times"),
        ):
            client.save(100, tmp_path / "got")
        assert files(part.parent) == [part.name], "nothing that looks like a checkpoint"
        begun = size(part)
        assert 0 < begun < len(store.data)
        with CheckpointClient(address) as client:
            path = client.save(100, tmp_path / "got")
    assert store.service.offsets[-1] == begun
    assert path.read_bytes() == store.data
    assert not part.exists()


def test_a_damaged_part_is_thrown_away(store: Store, tmp_path: Path) -> None:
    folder = tmp_path / "got"
    folder.mkdir()
    (folder / f".{store.manifest.sha256}.part").write_bytes(bytes(1000))
    with store.served() as address, CheckpointClient(address) as client:
        with pytest.raises(CorruptError, match="wanted SHA-256"):
            client.save(100, folder)
        assert files(folder) == []
        assert client.save(100, folder).read_bytes() == store.data


def test_a_part_longer_than_the_checkpoint_is_thrown_away(store: Store, tmp_path: Path) -> None:
    part = tmp_path / f".{store.manifest.sha256}.part"
    part.write_bytes(store.data + b"more")
    with store.served() as address, CheckpointClient(address) as client:
        assert client.save(100, tmp_path).read_bytes() == store.data
    assert not part.exists()


def test_downloads_into_one_folder_wait_for_each_other(store: Store, tmp_path: Path) -> None:
    def save(address: str) -> bytes:
        with CheckpointClient(address) as client:
            return client.save(100, tmp_path / "got").read_bytes()

    with store.served() as address, ThreadPoolExecutor(3) as pool:
        store.service.pause_s = 0.05
        assert list(pool.map(save, [address] * 3)) == [store.data] * 3
    assert files(tmp_path / "got") == ["checkpoint-000000100.json", "checkpoint-000000100.safetensors"]


def test_what_another_run_left_is_replaced(store: Store, tmp_path: Path) -> None:
    other = Store(tmp_path / "other")
    other.publish(200, seed=2)
    with store.served() as address, CheckpointClient(address) as client:
        client.save(100, tmp_path / "got")
        store.publish(200, seed=3)
        client.save(200, tmp_path / "got")
    with other.served() as address, CheckpointClient(address) as client:
        assert client.save(200, tmp_path / "got").read_bytes() == other.data != store.data
    Policy.load(tmp_path / "got" / "checkpoint-000000200.safetensors")


def test_the_documented_client_works(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", API.read_text(), re.DOTALL | re.MULTILINE)
    (code,) = (block for block in blocks if "a learner runs at ADDRESS" in block)
    monkeypatch.chdir(tmp_path)
    with store.served() as address:
        scope: dict[str, Any] = {"ADDRESS": address}
        exec(code, scope)
    assert scope["path"].read_bytes() == store.data
    assert scope["policy"].manifest == Policy.load(scope["path"]).manifest


def test_a_digest_names_no_other_folder(store: Store, tmp_path: Path) -> None:
    store.publish(200, seed=2)
    manifests = store.run.checkpoints.manifests
    manifests[1] = replace(manifests[1], sha256="/../../evil")
    with (
        store.served() as address,
        CheckpointClient(address) as client,
        pytest.raises(CorruptError, match=r"wanted a SHA-256 in hex, got '/\.\./\.\./evil'"),
    ):
        client.save(200, tmp_path / "got")
    assert not list(tmp_path.rglob("*evil*"))


def test_a_file_that_cannot_be_read_for_now_is_asked_for_again(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, failures = store.run.checkpoints.read, [OSError(errno.EMFILE, "Too many open files")]

    def sometimes(manifest: Manifest) -> bytes:
        if failures:
            raise failures.pop()
        return read(manifest)

    monkeypatch.setattr(store.run.checkpoints, "read", sometimes)
    with store.served() as address, CheckpointClient(address) as client:
        assert client.save(100, tmp_path / "got").read_bytes() == store.data
        assert not store.service.all_evaluated, "it waits for its test"
    assert store.service.offsets == [0, 0]


def half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [half, flip, os.unlink])
def test_a_damaged_checkpoint_is_not_served(
    store: Store, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    damage(store.run_dir / "checkpoints" / "checkpoint-000000100.safetensors")
    with store.served() as address, CheckpointClient(address) as client:
        with pytest.raises(DamagedError, match=r"checkpoint 100: .*(corrupt|No such file)"):
            client.save(100, tmp_path / "got")
        with pytest.raises(DamagedError, match=r"checkpoint 100: .*(corrupt|No such file)"):
            client.get(100)
    assert store.service.offsets == [0, 0], "asked once each: to try again would not help"
    assert not list((tmp_path / "got").glob("checkpoint-*"))
