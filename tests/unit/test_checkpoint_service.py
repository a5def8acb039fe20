"""Reports and lists of evaluations, without a wire: what is known of checkpoints long deleted."""

from __future__ import annotations

import asyncio
import errno
from pathlib import Path

import grpc
import pytest

from liir_common import config
from liir_common.files import Table
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
from liir_common.rpc.refused import Refused
from services.learner.checkpoint_service import CheckpointService
from services.learner.run_directory import RunDirectory
from tests.samples import SPEC
from tests.unit.test_checkpoint import DATA, make_manifest

INFO = dict.fromkeys(SPEC.info_keys, 1 / 3)


def evaluation(episode: int, wins: int = 1) -> checkpoint_pb2.Evaluation:
    manifest = make_manifest(episode)
    stats = checkpoint_pb2.EpisodeStats(episodes=20, wins=wins, return_mean=0.1, info_means=INFO)
    return checkpoint_pb2.Evaluation(
        episode=episode, sha256=manifest.sha256, env_steps=manifest.env_steps, greedy=stats, sampled=stats
    )


class Served:
    """A run that keeps the newest and the best checkpoint, without a server."""

    def __init__(self, path: Path, *settings: str) -> None:
        resolved = config.load(None, settings or ["checkpoints.keep_newest=1"])
        self.run = RunDirectory(path, resolved, SPEC)
        self.service = CheckpointService(self.run)

    def freeze(self, *episodes: int) -> None:
        for episode in episodes:
            self.run.checkpoints.publish(make_manifest(episode), DATA)
            asyncio.run(self.service.changed())

    def report(self, evaluation: checkpoint_pb2.Evaluation) -> bool:
        """Whether it was the first."""
        request = checkpoint_pb2.ReportEvaluationRequest(evaluation=evaluation)
        return not asyncio.run(self.service.ReportEvaluation(request, None)).duplicate

    def listed(self, after: int = 0, limit: int = 0) -> list[checkpoint_pb2.Evaluation]:
        request = checkpoint_pb2.ListEvaluationsRequest(after_episode=after, limit=limit)
        return list(asyncio.run(self.service.ListEvaluations(request, None)).evaluations)

    @property
    def there(self) -> list[int]:
        return [manifest.episode for manifest in self.run.checkpoints.manifests]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run"


def test_a_report_of_a_deleted_checkpoint_is_a_duplicate_or_wrong(path: Path) -> None:
    served = Served(path)
    served.freeze(100, 200, 300)
    for episode, wins in ((100, 3), (300, 5), (200, 4)):  # as when the second had to be restored
        assert served.report(evaluation(episode, wins))
    for known in (served, Served(path)):
        assert known.there == [300]
        assert known.listed() == [evaluation(100, 3), evaluation(200, 4), evaluation(300, 5)]
        assert known.listed(after=100, limit=1) == [evaluation(200, 4)]
        assert known.listed(after=300) == []
        assert not known.report(evaluation(200, wins=20))
        wrong = evaluation(200)
        wrong.sha256 = "0"
        with pytest.raises(ValueError, match="evaluation: wanted one of SHA-256"):
            known.report(wrong)
        with pytest.raises(Refused, match="no checkpoint of episode 250"):
            known.report(evaluation(250))
        assert known.listed(after=100) == [evaluation(200, 4), evaluation(300, 5)]


def test_a_resumed_run_keeps_the_best_of_what_it_tested_before(path: Path) -> None:
    served = Served(path)
    served.freeze(100, 200, 300)
    for episode, wins in ((100, 3), (200, 9), (300, 5)):
        assert served.report(evaluation(episode, wins))
    assert served.there == [200, 300]
    resumed = Served(path)
    assert resumed.service.all_evaluated
    resumed.freeze(400)
    assert not resumed.service.all_evaluated
    assert resumed.there == [200, 400]
    assert resumed.report(evaluation(400, wins=9))
    assert resumed.there == [400], "of equals the newer"


def test_a_checkpoint_that_was_tested_before_it_was_frozen_anew_has_its_test(path: Path) -> None:
    """Its files were lost, and a resumed run made them again."""
    served = Served(path, "checkpoints.keep_newest=2")
    served.freeze(100)
    assert served.report(evaluation(100))
    for file in (path / "checkpoints").iterdir():
        file.unlink()
    resumed = Served(path, "checkpoints.keep_newest=2")
    assert resumed.there == []
    resumed.freeze(100)
    assert resumed.there == [100]
    assert resumed.service.all_evaluated


def test_evaluations_that_cannot_be_read_for_now_are_asked_for_again(path: Path) -> None:
    served = Served(path)
    served.freeze(100)
    assert served.report(evaluation(100))
    table = path / "evaluations.csv"
    table.rename(path / "away")
    for ask in (served.listed, lambda: served.report(evaluation(100))):
        with pytest.raises(Refused, match=r"evaluations\.csv cannot be read .*No such file") as caught:
            ask()
        assert caught.value.code == grpc.StatusCode.UNAVAILABLE
    (path / "away").rename(table)
    assert served.listed() == [evaluation(100)]
    assert not served.report(evaluation(100))


def test_who_waits_for_the_last_test_hears_of_it_from_its_second_report(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one was stored, and then the disk could not be read."""

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    async def report_twice() -> None:
        waiting = asyncio.create_task(served.service.wait_all_evaluated())
        await asyncio.sleep(0)
        request = checkpoint_pb2.ReportEvaluationRequest(evaluation=evaluation(100))
        with monkeypatch.context() as patch:
            patch.setattr(Table, "read_at", fail)
            with pytest.raises(Refused, match="Input/output"):
                await served.service.ReportEvaluation(request, None)
        assert (await served.service.ReportEvaluation(request, None)).duplicate
        await asyncio.wait_for(waiting, 10)

    served = Served(path)
    served.freeze(100)
    asyncio.run(report_twice())
