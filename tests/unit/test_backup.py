"""A run that is copied while it goes on, at the worst moments."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from typing import BinaryIO

import pytest

from liir_common.backup import back_up
from liir_common.errors import ConfigError
from liir_common.files import read_table
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
from tests.unit.test_trainer import REPLAY, Played, left_behind

STEPS = 40
SETTINGS = ("training.checkpoint_interval=4", "training.save_interval=1", "algorithm=iql", *REPLAY)
CHECKPOINTS_LEFT = 14
"""So that those which the copied state counts are deleted while the checkpoints are copied."""


class Live:
    """A run that makes a step, saves, tests and deletes with everything that is archived."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.played = Played(path, STEPS, *SETTINGS)
        for opening, weights in list(self.played.trainer._openings):
            self.played._play(opening, weights)
        for _ in range(5):
            self.step()
        addfile = tarfile.TarFile.addfile

        def step_first(tar: tarfile.TarFile, member: tarfile.TarInfo, file: BinaryIO | None = None) -> None:
            self.step()
            addfile(tar, member, file)

        monkeypatch.setattr(tarfile.TarFile, "addfile", step_first)

    def step(self) -> None:
        if self.played.trainer.complete:
            return
        self.played.trainer._step()
        store = self.played.run.checkpoints
        for manifest in store.manifests[:-CHECKPOINTS_LEFT]:
            stats = checkpoint_pb2.EpisodeStats(episodes=1)
            tested = checkpoint_pb2.Evaluation(episode=manifest.episode, greedy=stats, sampled=stats)
            self.played.run.evaluations.add(tested, manifest)
            store.delete(manifest.episode)


def test_a_copy_of_a_run_that_goes_on_is_resumed_as_if_nothing_had_been(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Played(tmp_path / "whole", STEPS, *SETTINGS).train()
    archive = io.BytesIO()
    with monkeypatch.context() as patch:
        live = Live(tmp_path / "run", patch)
        begin = live.played.trainer.next_batch
        back_up(live.played.run.path, archive)
        assert live.played.trainer.next_batch > begin + 15, "else nothing happened meanwhile"
    archive.seek(0)
    with tarfile.open(fileobj=archive) as tar:
        tar.extractall(tmp_path / "restored", filter="data")

    copy = Played(tmp_path / "restored" / "run", STEPS, *SETTINGS)
    assert copy.trainer.next_batch == begin
    deleted = set(copy.run.checkpoints._deleted)
    assert deleted
    assert not [episode for episode in deleted if episode not in copy.run.evaluations]
    copy.train()
    rows, wanted = (left_behind(played.run.path)[1] for played in (copy, whole))
    assert rows == wanted
    assert deleted | copy.digests().keys() == whole.digests().keys()
    assert copy.digests().items() <= whole.digests().items()


def test_a_row_that_is_being_written_is_left_out(tmp_path: Path) -> None:
    run = Played(tmp_path / "run", 2, *SETTINGS).train().run
    with (run.path / "metrics.csv").open("a") as file:
        file.write("3,")
    archive = io.BytesIO()
    back_up(run.path, archive)
    archive.seek(0)
    with tarfile.open(fileobj=archive) as tar:
        tar.extractall(tmp_path / "restored", filter="data")
    copy = tmp_path / "restored" / "run" / "metrics.csv"
    assert copy.read_text().endswith("\n")
    assert [row["learner_step"] for row in read_table(copy)] == ["1", "2"]


def test_what_is_no_run_is_not_copied(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no run at .*; name the folder"):
        back_up(tmp_path, io.BytesIO())
