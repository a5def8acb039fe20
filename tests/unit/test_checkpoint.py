"""Frozen checkpoints: immutable, digested, there completely or not at all."""

import os
import re
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from liir_common import checkpoint
from liir_common.checkpoint import CheckpointStore, Manifest
from liir_common.errors import CorruptError
from tests.traced import bytes_left

TENSORS = {"policy.fc1.bias": np.arange(4, dtype=np.float32), "intrinsic.w": np.ones((2, 3), np.float32)}
DATA = checkpoint.pack(TENSORS)


def make_manifest(episode: int, data: bytes = DATA) -> Manifest:
    return Manifest(
        episode=episode,
        policy_version=3,
        env_steps=1000,
        run_id="run",
        git_commit="abc",
        env_spec={"name": "sample"},
        config={"seed": 1},
        created=1.0,
        sha256=sha256(data).hexdigest(),
        size_bytes=len(data),
    )


@pytest.fixture
def store(tmp_path: Path) -> CheckpointStore:
    return CheckpointStore(str(tmp_path / "checkpoints"))


def test_equal_tensors_give_equal_bytes_in_any_order() -> None:
    assert checkpoint.pack(dict(reversed(TENSORS.items()))) == DATA


def test_published_checkpoints_are_found_by_a_new_store(store: CheckpointStore, tmp_path: Path) -> None:
    for episode in (100, 200):
        assert store.publish(make_manifest(episode), DATA)
    again = CheckpointStore(str(tmp_path / "checkpoints"))
    assert [manifest.episode for manifest in again.manifests] == [100, 200]
    manifest = again.find(200)
    assert manifest == make_manifest(200)
    tensors = checkpoint.unpack(again.read(manifest), manifest.sha256)
    assert np.array_equal(checkpoint.section(tensors, "policy")["fc1.bias"], TENSORS["policy.fc1.bias"])
    assert list(checkpoint.section(tensors, "intrinsic")) == ["w"]


def test_stores_beyond_the_local_disk_work_too() -> None:
    store = CheckpointStore("memory://run/checkpoints")
    store.publish(make_manifest(100), DATA)
    again = CheckpointStore("memory://run/checkpoints")
    assert again.read(again.find(100)) == DATA


def test_the_same_checkpoint_again_is_a_no_op_and_another_an_error(store: CheckpointStore) -> None:
    store.publish(make_manifest(100), DATA)
    assert not store.publish(replace(make_manifest(100), created=2.0), DATA)
    assert store.find(100).created == 1.0
    other = checkpoint.pack({"policy.fc1.bias": np.zeros(4, np.float32)})
    with pytest.raises(CorruptError, match="checkpoint 100 exists with SHA-256"):
        store.publish(make_manifest(100, other), other)


def test_a_damaged_weights_file_is_never_read(store: CheckpointStore, tmp_path: Path) -> None:
    store.publish(make_manifest(100), DATA)
    path = tmp_path / "checkpoints" / "checkpoint-000000100.safetensors"
    path.write_bytes(DATA[:-1] + b"\xff")
    with pytest.raises(CorruptError, match="wanted SHA-256"):
        store.read(store.find(100))


def test_a_damaged_manifest_is_named(store: CheckpointStore, tmp_path: Path) -> None:
    store.publish(make_manifest(100), DATA)
    path = tmp_path / "checkpoints" / "checkpoint-000000100.json"
    path.write_text("{")
    with pytest.raises(CorruptError, match=r"checkpoint-000000100\.json") as caught:
        CheckpointStore(str(path.parent))
    advice = re.search(r"remove it and append a line (\S+) to (\S+)", str(caught.value))
    assert advice
    path.unlink()
    Path(advice[2]).write_text(advice[1])
    again = CheckpointStore(str(path.parent))
    assert (again.manifests, again.frozen) == ([], 0)
    again.check_all([100])
    assert not again.publish(make_manifest(100), DATA), "a resumed run that comes to it does without it, too"


def test_weights_without_a_manifest_do_not_exist(store: CheckpointStore, tmp_path: Path) -> None:
    (tmp_path / "checkpoints" / "checkpoint-000000100.safetensors").write_bytes(DATA)
    assert CheckpointStore(str(tmp_path / "checkpoints")).manifests == []
    with pytest.raises(KeyError, match="no checkpoint of episode 100"):
        store.find(100)


def test_bytes_that_are_no_weights_file_are_refused() -> None:
    garbage = b"\x05\0\0\0\0\0\0\0hello"
    with pytest.raises(CorruptError, match="not a safetensors"):
        checkpoint.unpack(garbage, sha256(garbage).hexdigest())


def test_what_manifests_say_alike_is_in_memory_once(store: CheckpointStore, tmp_path: Path) -> None:
    for episode in (100, 200):
        store.publish(make_manifest(episode), DATA)
    store.publish(replace(make_manifest(300), config={"seed": 2}), DATA)
    first, second, third = CheckpointStore(str(tmp_path / "checkpoints")).manifests
    assert second.config is first.config
    assert third.env_spec is second.env_spec is first.env_spec
    assert third.config == {"seed": 2}


@pytest.mark.parametrize("kind", ["folder", "memory"])
def test_a_deleted_checkpoint_is_gone_and_its_number_taken(tmp_path: Path, kind: str) -> None:
    url = str(tmp_path) if kind == "folder" else f"memory://{tmp_path}"
    store = CheckpointStore(url)
    for episode in (100, 200, 300):
        store.publish(make_manifest(episode), DATA)
    there = store.manifests
    store.delete(200)
    assert [manifest.episode for manifest in there] == [100, 200, 300]
    for again in (store, CheckpointStore(url)):
        assert [manifest.episode for manifest in again.manifests] == [100, 300]
        assert again.frozen == 3
        with pytest.raises(KeyError, match="checkpoint 200 was deleted"):
            again.find(200)
        assert not again.publish(make_manifest(200), DATA)
        other = checkpoint.pack({"policy.fc1.bias": np.zeros(4, np.float32)})
        with pytest.raises(CorruptError, match="checkpoint 200 exists with SHA-256"):
            again.publish(make_manifest(200, other), other)
        assert [manifest.episode for manifest in again.manifests] == [100, 300]


def test_the_list_that_somebody_has_does_not_change(store: CheckpointStore) -> None:
    before = store.manifests
    for episode in (200, 100):
        store.publish(make_manifest(episode), DATA)
    assert before == []
    assert [manifest.episode for manifest in store.manifests] == [100, 200]


def test_deleted_checkpoints_are_known_in_whatever_order_they_went(tmp_path: Path) -> None:
    store = CheckpointStore(str(tmp_path))
    episodes = [300, 100, 1_000_000_000, 10_000_000_000, 200]
    data = {episode: checkpoint.pack({"x": np.full(1, episode, np.float32)}) for episode in episodes}
    for episode in episodes:
        store.publish(make_manifest(episode, data[episode]), data[episode])
    for episode in episodes:
        store.delete(episode)
    for again in (store, CheckpointStore(str(tmp_path))):
        assert again.frozen == 5
        for episode in episodes:
            with pytest.raises(KeyError, match=f"checkpoint {episode} was deleted"):
                again.find(episode)
            known = make_manifest(episode, data[episode])
            with pytest.raises(
                CorruptError, match=f"checkpoint {episode} exists with SHA-256 {known.sha256}"
            ):
                again.publish(make_manifest(episode), DATA)
            assert not again.publish(known, data[episode])
        for episode in (1, 150, 400, 10_000_000_001):
            with pytest.raises(KeyError, match=f"no checkpoint of episode {episode}"):
                again.find(episode)
    assert store.publish(make_manifest(400), DATA)


def test_of_a_deleted_checkpoint_a_number_is_in_memory(
    store: CheckpointStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "write_atomic", Path.write_bytes)
    monkeypatch.setattr(os, "fsync", lambda _: None)  # it need not be on disk

    def come_and_go(episodes: range) -> None:
        for episode in episodes:
            store.publish(make_manifest(episode), DATA)
            store.delete(episode)

    come_and_go(range(200))
    # So many that what else is kept, such as freed objects for the next ones, is little beside it.
    assert bytes_left(lambda: come_and_go(range(200, 4200))) / 4000 < 24


@pytest.mark.parametrize("left", [9, 4 + 64], ids=["in the digest", "before the end of the line"])
def test_whoever_dies_before_deleting_leaves_a_checkpoint_there(tmp_path: Path, left: int) -> None:
    """With part of a line in deleted.csv."""
    store = CheckpointStore(str(tmp_path))
    for episode in (100, 200, 300):
        store.publish(make_manifest(episode), DATA)
    store.delete(100)
    with (tmp_path / "deleted.csv").open("a") as file:
        file.write(f"200,{make_manifest(200).sha256}"[:left])
    again = CheckpointStore(str(tmp_path))
    assert [manifest.episode for manifest in again.manifests] == [200, 300]
    again.remove_leftovers()
    assert again.read(again.find(200)) == DATA
    for episode in (300, 200):
        again.delete(episode)
    again = CheckpointStore(str(tmp_path))
    assert (again.manifests, again.frozen) == ([], 3)
    for episode in (100, 200, 300):
        assert not again.publish(make_manifest(episode), DATA)


def test_a_file_that_was_put_back_is_there_and_can_go_again(tmp_path: Path) -> None:
    store = CheckpointStore(str(tmp_path))
    store.publish(make_manifest(100), DATA)
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}
    store.delete(100)
    for path, data in files.items():
        path.write_bytes(data)
    again = CheckpointStore(str(tmp_path))
    assert again.read(again.find(100)) == DATA
    again.remove_leftovers()
    again.delete(100)
    assert (again.frozen, CheckpointStore(str(tmp_path)).frozen) == (1, 1)


def test_whoever_dies_while_deleting_leaves_a_checkpoint_deleted(tmp_path: Path) -> None:
    """After the manifest is gone, and before the weights are."""
    store = CheckpointStore(str(tmp_path))
    store.publish(make_manifest(100), DATA)
    store.delete(100)
    weights = tmp_path / "checkpoint-000000100.safetensors"
    weights.write_bytes(DATA)
    again = CheckpointStore(str(tmp_path))
    assert again.manifests == []
    assert again.frozen == 1
    assert weights.exists(), "who only reads a store may not be able to write to it"
    again.remove_leftovers()
    assert not weights.exists()
