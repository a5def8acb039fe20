"""The replay: every bit of the newest episodes, in memory and on disk, each written once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from liir_common.errors import CorruptError
from liir_common.types import Batch
from services.learner.algorithms.replay import Replay
from services.learner.replay_store import ReplayStore
from tests.samples import SPEC, make_trajectory

LENGTHS = (6, 9, 1, 4)


def batch_of(first: int) -> Batch:
    """Unequal lengths; the one of nine steps runs into the limit."""
    episodes = [make_trajectory(first + i, length=length) for i, length in enumerate(LENGTHS)]
    return Batch.from_trajectories(episodes, epsilon=0.3)


def loaded(store: ReplayStore, first: int, stop: int) -> list[bytes]:
    """What comes of it, each part from where the one before ended."""
    at, frames = first, []
    for start, part in store.load(first, stop):
        assert start == at
        frames += part
        at += len(part)
    return frames


def test_a_sample_has_every_bit_of_the_episodes() -> None:
    replay = Replay(SPEC, capacity=10)
    replay.add(batch_of(0))
    replay.add(batch_of(4))
    sample, wanted = replay.sample([4, 5, 6, 7]), batch_of(4)
    for field in fields(Batch):
        if field.name not in ("epsilon", "log_mu", "policy_version"):
            got, want = getattr(sample, field.name), getattr(wanted, field.name)
            assert (got.dtype, got.shape, got.tobytes()) == (want.dtype, want.shape, want.tobytes()), field
    short = replay.sample([2, 7])
    assert short.reward.shape == (2, 4)
    assert np.array_equal(short.reward[1], wanted.reward[3, :4])


def test_the_newest_episodes_are_kept() -> None:
    replay = Replay(SPEC, capacity=6)
    for first in (0, 4, 8):
        replay.add(batch_of(first))
    assert (len(replay), replay.first, replay.total) == (6, 6, 12)
    assert replay.sample([0]).filled.sum() == LENGTHS[2]
    assert np.array_equal(replay.sample([2]).obs[0], batch_of(8).obs[0, : LENGTHS[0] + 1])


def test_restored_from_disk_it_is_the_same(tmp_path: Path) -> None:
    replay, store = Replay(SPEC, capacity=6), ReplayStore(tmp_path)
    for first in (0, 4, 8):
        replay.add(batch_of(first))
        start = max(store.stop, replay.first)
        store.append(start, replay.frames(start))
    assert [path.stem[:26] for path in sorted(tmp_path.iterdir())] == [
        "replay-000000000-000000004",
        "replay-000000004-000000008",
        "replay-000000008-000000012",
    ]
    other = Replay(SPEC, capacity=6)
    for first, frames in ReplayStore(tmp_path).load(6, 12):
        other.extend(first, frames)
    assert (other.first, other.total) == (6, 12)
    assert other.frames(6) == replay.frames(6)


def test_episodes_that_do_not_come_next_take_the_place_of_all() -> None:
    replay = Replay(SPEC, capacity=6)
    replay.extend(3, [b"x", b"y"])
    replay.extend(5, [b"z"])
    assert (replay.first, replay.total, replay.frames(3)) == (3, 6, [b"x", b"y", b"z"])
    replay.extend(1, [b"a"])
    assert (replay.first, replay.total, replay.frames(1)) == (1, 2, [b"a"])


def test_episodes_that_no_state_knows_are_forgotten(tmp_path: Path) -> None:
    store = ReplayStore(tmp_path)
    store.append(0, [b"a", b"bb"])
    store.append(2, [b"later"])
    assert loaded(ReplayStore(tmp_path), 0, 2) == [b"a", b"bb"]
    assert store.stop == 2
    store.append(2, [b"again"])
    assert loaded(ReplayStore(tmp_path), 1, 3) == [b"bb", b"again"]


def test_pruning_keeps_what_is_still_wanted(tmp_path: Path) -> None:
    store = ReplayStore(tmp_path)
    for first in (0, 2, 4):
        store.append(first, [b"x", b"y"])
    store.prune(3)
    assert loaded(store, 3, 6) == [b"y", b"x", b"y"]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_that_was_written_before_there_were_digests_is_read(tmp_path: Path) -> None:
    store = ReplayStore(tmp_path)
    store.append(0, [b"x", b"y"])
    (path,) = tmp_path.iterdir()
    path.rename(tmp_path / "replay-000000000-000000002.safetensors")
    assert loaded(store, 0, 2) == [b"x", b"y"]


@pytest.mark.parametrize("damage", [lambda data: data[:-1], lambda data: data[:-1] + b"{"])
def test_a_missing_or_damaged_file_is_an_error_that_says_so(
    tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    store = ReplayStore(tmp_path)
    store.append(0, [b"x", b"y"])
    store.append(4, [b"z"])
    with pytest.raises(CorruptError, match="2 episodes of the replay, from 2 on, are missing"):
        loaded(store, 0, 5)
    (path,) = tmp_path.glob("replay-000000004-*")
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CorruptError, match=r"replay-000000004.* cannot be read"):
        loaded(store, 4, 5)
