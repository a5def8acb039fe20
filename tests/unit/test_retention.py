"""Which checkpoints may go."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from functools import partial

import pytest

from liir_common import config
from liir_common.client import Merit
from services.learner.retention import superseded
from tests.unit.test_checkpoint import make_manifest

EPISODES = range(100, 1100, 100)


def merits(episodes: Sequence[int], wins: Mapping[int, int]) -> dict[int, Merit]:
    """Of the tested ones of the episodes, which won so many games."""
    return {episode: (wins[episode], episode) for episode in episodes if episode in wins}


def kept(*settings: str, wins: dict[int, int] | None = None) -> list[int]:
    """What stays of ten checkpoints, all tested unless `wins` says which and how well."""
    tests = dict.fromkeys(EPISODES, 0) if wins is None else wins
    manifests = [make_manifest(episode) for episode in EPISODES]
    gone = superseded(manifests, partial(merits, wins=tests), config.load(None, settings))
    return [episode for episode in EPISODES if episode not in gone]


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


def test_the_best_so_far_is_there_after_every_step() -> None:
    """Deleting step by step, as a run does, never loses what the rule keeps at the end."""
    results = random.Random(1)
    resolved = config.load(None, ["checkpoints.keep_newest=2", "checkpoints.keep_best=2"])
    there, wins = [], {}
    for episode in range(100, 5100, 100):
        there.append(make_manifest(episode))
        wins[episode] = results.randrange(21)
        gone = superseded(there, partial(merits, wins=wins), resolved)
        there = [manifest for manifest in there if manifest.episode not in gone]
        ranked = sorted(wins, key=lambda e: (wins[e], e))
        assert {manifest.episode for manifest in there} == {*ranked[-2:], *list(wins)[-2:]}
