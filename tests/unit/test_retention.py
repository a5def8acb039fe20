"""Which checkpoints may go."""

from __future__ import annotations

import random
from collections.abc import Sequence
from unittest.mock import Mock

import pytest

from liir_common import config
from liir_common.checkpoint import Manifest
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
from services.learner.retention import Retention
from tests.unit.test_checkpoint import make_manifest

EPISODES = range(100, 1100, 100)


class Store:
    """Checkpoints that are there."""

    def __init__(self, episodes: Sequence[int] = ()) -> None:
        self.manifests: list[Manifest] = [make_manifest(episode) for episode in episodes]

    def __contains__(self, episode: int) -> bool:
        return episode in self.there

    @property
    def there(self) -> list[int]:
        return [manifest.episode for manifest in self.manifests]

    def delete(self, episode: int) -> None:
        del self.manifests[self.there.index(episode)]


class Won(dict[int, checkpoint_pb2.Evaluation]):
    """Those of the tested episodes, made from how many of 20 battles each won; counts what it is asked."""

    def __init__(self, wins: dict[int, int]) -> None:
        super().__init__()
        self.asked = 0
        for episode, won in wins.items():
            self.add(episode, won)

    def add(self, episode: int, won: int) -> None:
        self[episode] = checkpoint_pb2.Evaluation(episode=episode)
        for stats in (self[episode].greedy, self[episode].sampled):
            stats.episodes, stats.wins = 20, won

    def __contains__(self, episode: object) -> bool:
        self.asked += 1
        return super().__contains__(episode)


def retention(store: Store, tests: Won, *settings: str) -> Retention:
    return Retention(store, tests, config.load(None, settings))  # type: ignore[arg-type]


def kept(*settings: str, wins: dict[int, int] | None = None) -> list[int]:
    """What stays of ten checkpoints, all tested unless `wins` says which and how well."""
    store = Store(EPISODES)
    retention(store, Won(dict.fromkeys(EPISODES, 0) if wins is None else wins), *settings).apply()
    return store.there


def test_everything_stays_unless_a_number_is_given() -> None:
    assert kept() == kept("checkpoints.keep_every=3") == list(EPISODES)


@pytest.mark.parametrize(
    ("settings", "left"),
    [
        (["keep_newest=3"], [800, 900, 1000]),
        (["keep_newest=1", "keep_every=4"], [400, 800, 1000]),
        (["keep_newest=20"], list(EPISODES)),
    ],
)
def test_newest_and_every_so_manieth(settings: list[str], left: list[int]) -> None:
    assert kept(*(f"checkpoints.{setting}" for setting in settings)) == left


def test_the_best_stay_and_of_equals_the_newer() -> None:
    wins = dict.fromkeys(EPISODES, 5) | {300: 20, 500: 20, 700: 10}
    assert kept("checkpoints.keep_newest=1", wins=wins) == [500, 1000]
    assert kept("checkpoints.keep_newest=1", "checkpoints.keep_best=3", wins=wins) == [300, 500, 700, 1000]
    assert kept("checkpoints.keep_newest=1", "checkpoints.keep_best=0", wins=wins) == [1000]


def test_the_untested_stay_unless_nothing_is_tested() -> None:
    wins = {100: 3, 200: 1}
    assert kept("checkpoints.keep_newest=1", wins=wins) == [100, *range(300, 1100, 100)]
    assert kept("checkpoints.keep_newest=1", "evaluation.enabled=false", wins={}) == [1000]


@pytest.mark.parametrize("every", [0, 3])
def test_step_by_step_it_keeps_what_the_rules_say_of_all(every: int) -> None:
    """While tests come late and out of order, and the learner is resumed now and then."""
    results = random.Random(1)
    settings = [f"checkpoints.{rule}" for rule in ("keep_newest=2", "keep_best=2", f"keep_every={every}")]
    store, tests, waiting, wins = Store(), Won({}), [], {}
    rules = retention(store, tests, *settings)
    for episode in range(100, 10100, 100):
        store.manifests.append(make_manifest(episode))
        waiting.append(episode)
        while len(waiting) > 5 or (waiting and results.random() < 0.5):
            tested = waiting.pop(results.randrange(len(waiting)))
            wins[tested] = results.randrange(21)
            tests.add(tested, wins[tested])
        if results.random() < 0.1:
            rules = retention(store, tests, *settings)
        rules.apply()
        ranked = sorted(wins, key=lambda e: (wins[e], e))
        regular = range(100 * every, episode + 1, 100 * every) if every else ()
        assert set(store.there) == {*ranked[-2:], episode, episode - 100, *waiting, *regular} - {0}


@pytest.mark.parametrize("tested", [True, False])
def test_what_stays_for_good_is_not_gone_through_again(tested: bool) -> None:
    store, tests = Store(), Won({})
    settings = ("checkpoints.keep_newest=5", "checkpoints.keep_every=2", f"evaluation.enabled={tested}")
    rules = retention(store, tests, *settings)
    for episode in range(100, 200_100, 100):
        store.manifests.append(make_manifest(episode))
        if tested:
            tests.add(episode, 0)
        before = tests.asked
        rules.apply()
        assert tests.asked - before <= 10
    assert len(store.manifests) > 1000


def test_what_could_not_be_deleted_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(EPISODES)
    rules = retention(store, Won(dict.fromkeys(EPISODES, 0)), "checkpoints.keep_newest=3")
    with monkeypatch.context() as patch:
        patch.setattr(Store, "delete", Mock(side_effect=OSError("no room")))
        with pytest.raises(OSError, match="no room"):
            rules.apply()
    assert store.there == list(EPISODES)
    rules.apply()
    assert store.there == [800, 900, 1000]
