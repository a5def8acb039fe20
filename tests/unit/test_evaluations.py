"""The tests of checkpoints: found again in order, whatever order they came in, and not kept in memory."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from liir_common.files import Table, read_table
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
from services.learner.evaluations import Evaluations
from tests.traced import bytes_left
from tests.unit.test_checkpoint import make_manifest
from tests.unit.test_files import files_of_at_most


def evaluation(episode: int, **more: float) -> checkpoint_pb2.Evaluation:
    """Figures that are no round numbers, and others for every episode."""
    random_number = random.Random(episode).random
    manifest = make_manifest(episode)
    found = checkpoint_pb2.Evaluation(episode=episode, sha256=manifest.sha256, env_steps=manifest.env_steps)
    for stats in (found.greedy, found.sampled):
        stats.episodes, stats.wins = 20, episode % 21
        stats.return_mean, stats.length_mean = -random_number() / 3, 100 * random_number()
        stats.info_means.update({"won": random_number(), **more})
    return found


def opened(path: Path) -> Evaluations:
    return Evaluations(Table(path), begin=0.0)


def add(evaluations: Evaluations, *added: checkpoint_pb2.Evaluation) -> None:
    for each in added:
        evaluations.add(each, make_manifest(each.episode))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "evaluations.csv"


def test_a_run_without_tests_has_none(path: Path) -> None:
    evaluations = opened(path)
    assert (len(evaluations), evaluations.newest, evaluations.after(0, 10)) == (0, None, [])
    assert 100 not in evaluations
    assert not path.exists()


def test_tests_are_found_in_the_order_of_their_checkpoints(path: Path) -> None:
    evaluations = opened(path)
    order = [100, 300, 400, 200, 1000, 50]
    add(evaluations, *map(evaluation, order))
    assert [int(row["episode"]) for row in read_table(path)] == order
    for known in (evaluations, opened(path)):
        assert len(known) == 6
        assert known.newest == evaluation(1000)
        assert known.after(0, 10) == [evaluation(episode) for episode in sorted(order)]
        assert known.after(100, 2) == [evaluation(200), evaluation(300)]
        assert known.after(99, 1) == [evaluation(100)]
        assert known.after(1000, 10) == known.after(2**64 - 1, 10) == []
        for episode in order:
            assert episode in known
            assert known[episode] == evaluation(episode)
        for episode in (0, 99, 101, 1001, 2**64 - 1):
            assert episode not in known


def test_a_row_with_new_columns_moves_the_others_and_loses_none(path: Path) -> None:
    """As a newer build may write them into the table of an older one."""
    evaluations = opened(path)
    add(evaluations, evaluation(200), evaluation(100))
    newer = evaluation(150, score=1 / 3)
    add(evaluations, newer)
    add(evaluations, evaluation(300))
    for known in (evaluations, opened(path)):
        assert known.after(0, 10) == [evaluation(100), newer, evaluation(200), evaluation(300)]
        assert known[200] == evaluation(200)


@pytest.mark.parametrize("room", ["neither", "columns"])
def test_a_test_without_room_leaves_all_as_it_was(path: Path, room: str) -> None:
    """With room for the new columns the rows have moved, although their own has not come."""
    evaluations = opened(path)
    add(evaluations, evaluation(200), evaluation(100))
    columns = len(",greedy_score_mean,sampled_score_mean" + 2 * ",,")
    newer = evaluation(150, score=1 / 3)
    with (
        files_of_at_most(path.stat().st_size + (columns if room == "columns" else 0)),
        pytest.raises(OSError, match="File too large"),
    ):
        add(evaluations, newer)
    assert (len(evaluations), 150 in evaluations) == (2, False)
    assert evaluations.after(0, 10) == [evaluation(100), evaluation(200)]
    add(evaluations, newer)
    assert evaluations.after(0, 10) == [evaluation(100), newer, evaluation(200)]


def test_a_half_written_test_is_none(path: Path) -> None:
    add(opened(path), evaluation(100), evaluation(200))
    path.write_bytes(path.read_bytes()[:-1])
    evaluations = opened(path)
    assert 200 not in evaluations
    add(evaluations, evaluation(200))
    assert opened(path).after(0, 10) == [evaluation(100), evaluation(200)]


def test_of_two_rows_for_one_checkpoint_the_last_counts(path: Path) -> None:
    add(opened(path), evaluation(100), evaluation(200))
    header, first, second = path.read_text().splitlines()
    path.write_text("\n".join([header, second.replace("200,", "100,", 1), second, first, ""]))
    evaluations = opened(path)
    assert len(evaluations) == 2
    assert evaluations.after(0, 10) == [evaluation(100), evaluation(200)]


def test_of_a_test_two_numbers_are_in_memory(path: Path) -> None:
    evaluations = opened(path)

    def test(episodes: range) -> None:
        for episode in episodes:
            add(evaluations, evaluation(episode))
            evaluations.after(episode - 2, 10)

    test(range(200))
    assert bytes_left(lambda: test(range(200, 1200))) / 1000 < 40
