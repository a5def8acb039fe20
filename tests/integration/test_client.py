"""The client of checkpoints asks a real service again, for the next page and for the rest of a watch."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from liir_common import client
from liir_common.client import CheckpointClient
from tests.e2e.service import wait_for
from tests.integration.test_download import Store
from tests.integration.test_learner import evaluation_of


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "run")


@pytest.mark.parametrize("number", [4, 5])
def test_pages_follow_each_other_without_gap_or_overlap(
    store: Store, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """The last one is full, or is not."""
    monkeypatch.setattr(client, "_PAGE", 2)
    episodes = [100 * (index + 1) for index in range(number)]
    for episode in episodes[1:]:
        store.publish(episode, seed=episode)
    with store.served() as address, CheckpointClient(address) as reader:
        frozen = list(reader.list())
        assert [one.episode for one in frozen] == episodes
        assert list(reader.list(after_episode=100)) == frozen[1:]
        tests = [evaluation_of(one, wins=2) for one in frozen]
        assert all(map(reader.report, tests))
        assert list(reader.evaluations()) == tests
        assert list(reader.evaluations(after_episode=200)) == tests[2:]


def test_a_watch_that_asks_anew_loses_and_repeats_nothing_and_ends_with_the_run(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "_WATCH_S", 0.5)
    with (
        store.served() as address,
        ThreadPoolExecutor(1) as pool,
        CheckpointClient(address) as reader,
    ):
        watched = pool.submit(lambda: [frozen.episode for frozen in reader.watch(after_episode=50)])
        for episode in (200, 300):
            wait_until_asked_anew(store)
            store.publish(episode, seed=episode)
        wait_until_asked_anew(store)
        asyncio.run_coroutine_threadsafe(store.service.end(run_complete=True), store.loop).result(10)
        assert watched.result(30) == [100, 200, 300]
    assert store.service.watched_after[0] == 50
    assert store.service.watched_after == sorted(store.service.watched_after)


def wait_until_asked_anew(store: Store) -> None:
    """Twice: the first of them may have been on its way."""
    asked = len(store.service.watched_after)
    wait_for(lambda: len(store.service.watched_after) >= asked + 2, "a watch that asks anew", 30)
