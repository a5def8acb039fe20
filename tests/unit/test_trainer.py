"""The training loop without a network: batches from a queue, checkpoints and states on disk."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from liir_common import config, files, launch, metrics
from liir_common.build import git_commit
from liir_common.checkpoint import CheckpointStore, pack, section, unpack
from liir_common.errors import CorruptError, DivergedError
from liir_common.types import Batch, Weights
from services.learner.algorithms import make_algorithm
from services.learner.intake import Opening
from services.learner.run_directory import RunDirectory
from services.learner.trainer import Progress, Trainer
from tests.samples import SPEC, make_trajectory

BATCH = 4
REPLAY = [
    "algorithm.replay.episodes=10",
    "algorithm.replay.batch_episodes=5",
    "algorithm.replay.episodes_per_update=3",
]
STEPS = 6
"""Environment steps of each sample episode."""


class Played:
    """A trainer on `path` whose batches are played, by somebody fast, the moment they are opened."""

    def __init__(self, path: Path, learner_steps: int, *settings: str) -> None:
        resolved = config.load(
            None,
            [
                f"training.batch_episodes={BATCH}",
                f"training.total_env_steps={learner_steps * BATCH * STEPS}",
                "learner.threads=1",
                "algorithm.policy_hidden=8",
                *settings,
            ],
        )
        self.openings: list[Opening] = []
        self.published: list[tuple[int, bytes]] = []
        """Version and policy of each opening."""
        self.run = RunDirectory(path, resolved, SPEC)
        algorithm = make_algorithm(SPEC, resolved.algorithm, 1, torch.device("cpu"))
        self.trainer = Trainer(self.run, algorithm, self._play, lambda: None)

    def _play(self, opening: Opening, weights: Weights) -> None:
        self.openings.append(opening)
        self.published.append((opening.policy_version, pack(weights)))
        first = opening.batch * BATCH
        self.trainer.batches.put(
            [make_trajectory(first + i, opening.policy_version, STEPS) for i in range(BATCH)]
        )

    def train(self) -> Played:
        self.trainer.run()
        return self

    def digests(self) -> dict[int, str]:
        return {manifest.episode: manifest.sha256 for manifest in self.run.checkpoints.manifests}

    def policies(self) -> dict[int, bytes]:
        """The policy of each version that was frozen."""
        store = self.run.checkpoints
        frozen = {m.policy_version: unpack(store.read(m), m.sha256) for m in store.manifests}
        return {version: pack(section(tensors, "policy")) for version, tensors in frozen.items()}


@pytest.mark.parametrize(("interval", "frozen"), [(3, [3, 6, 9, 12]), (1, list(range(1, 13))), (5, [5, 10])])
def test_every_multiple_of_the_interval_is_frozen(tmp_path: Path, interval: int, frozen: list[int]) -> None:
    played = Played(tmp_path, 3, f"training.checkpoint_interval={interval}").train()
    assert list(played.digests()) == frozen
    for manifest in played.run.checkpoints.manifests:
        assert manifest.policy_version == -(-manifest.episode // BATCH)
        assert manifest.env_steps == manifest.policy_version * BATCH * STEPS
        assert manifest.git_commit == git_commit() != ""


@pytest.mark.parametrize("lag", [0, 1])
def test_batches_are_played_by_the_version_that_the_lag_says(tmp_path: Path, lag: int) -> None:
    played = Played(tmp_path, 5, f"training.lag={lag}").train()
    assert [opening.batch for opening in played.openings] == list(range(5 + lag))
    assert [o.policy_version for o in played.openings] == [max(0, b - lag) for b in range(5 + lag)]
    lags = [int(row["policy_lag"]) for row in played.run.metrics.read()]
    assert lags == [min(step, lag) for step in range(5)]


@pytest.mark.parametrize("lag", [0, 1])
def test_a_batch_has_the_epsilon_of_the_steps_that_its_version_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lag: int
) -> None:
    # The last versions are past the end of the schedule.
    played = Played(tmp_path, 6, f"training.lag={lag}", "algorithm.exploration.steps=80")
    update, used = played.trainer.algorithm.update, []

    def watched(batch: Batch, policy_ready: Callable[[Weights], None]) -> dict[str, float]:
        used.append(batch.epsilon)
        return update(batch, policy_ready)

    monkeypatch.setattr(played.trainer.algorithm, "update", watched)
    played.train()
    epsilon = played.run.config.algorithm.exploration.epsilon
    wanted = [epsilon(opening.policy_version * BATCH * STEPS) for opening in played.openings]
    assert [opening.epsilon for opening in played.openings] == wanted
    assert used == wanted[:6]
    assert len(set(used)) > 3


@pytest.mark.parametrize("lag", [0, 1])
def test_the_actors_get_the_weights_of_the_version_that_they_are_told(tmp_path: Path, lag: int) -> None:
    settings = (f"training.lag={lag}", f"training.checkpoint_interval={BATCH}")
    first = Played(tmp_path, 3, *settings)
    initial = pack(first.trainer.algorithm.policy())
    first.train()
    resumed = Played(tmp_path, 6, *settings).train()
    versions = {0: initial} | resumed.policies()
    assert len(set(versions.values())) == 7
    published = first.published + resumed.published
    told = [version for version, _ in published]
    assert set(told) == set(range(6))
    assert published == [(version, versions[version]) for version in told]


@pytest.mark.parametrize("lag", [0, 1])
@pytest.mark.parametrize(
    "method",
    [
        ["liir"],
        ["liir", "algorithm.outer_samples=fresh"],
        ["central_v"],
        ["iac"],
        ["coma"],
        ["iql", *REPLAY],
        ["vdn", *REPLAY],
        ["qmix", *REPLAY],
    ],
    ids=" ".join,
)
def test_training_in_two_parts_is_training_in_one(tmp_path: Path, lag: int, method: list[str]) -> None:
    settings = (
        f"training.lag={lag}",
        f"algorithm={method[0]}",
        *method[1:],
        "training.checkpoint_interval=4",
    )
    whole = Played(tmp_path / "whole", 6, *settings).train()
    Played(tmp_path / "parts", 3, *settings).train()
    parts = Played(tmp_path / "parts", 6, *settings).train()
    assert parts.digests() == whole.digests() != {}
    steps = [row["learner_step"] for row in parts.run.metrics.read()]
    assert steps == ["1", "2", "3", "4", "5", "6"]


@pytest.mark.parametrize("method", [["algorithm=liir"], ["algorithm=qmix", *REPLAY]], ids=" ".join)
def test_a_crash_costs_the_steps_since_the_last_save_and_changes_nothing(
    tmp_path: Path, method: list[str]
) -> None:
    settings = ("training.checkpoint_interval=4", "training.save_interval=2", *method)
    whole = Played(tmp_path / "whole", 6, *settings).train()
    crashed = Played(tmp_path / "crashed", 6, *settings)
    for opening, weights in list(crashed.trainer._openings):
        crashed._play(opening, weights)
    for _ in range(5):  # dies after the fifth step, without a goodbye
        crashed.trainer._step()
    resumed = Played(tmp_path / "crashed", 6, *settings)
    assert resumed.trainer.next_batch == 4
    assert len(resumed.run.metrics.read()) == 4
    assert resumed.train().digests() == whole.digests()


def test_learning_that_diverged_is_an_error_that_nobody_tries_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = Played(tmp_path, 3)

    def diverge(batch: Batch, policy_ready: object) -> dict[str, float]:
        raise FloatingPointError("learning has diverged, not finite: {'value_loss': nan}")

    monkeypatch.setattr(played.trainer.algorithm, "update", diverge)
    with pytest.raises(DivergedError, match=r"value_loss.*begin another run") as raised:
        played.train()
    assert raised.value.exit_code in launch._IN_VAIN


class Died(Exception):
    """What a process that is gone would not raise."""


class Writes:
    """Counts what goes to disk, and may let the process die in front of one write."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, dies_before: int | None = None) -> None:
        """Watch every way to a file that a learner step has; the first write is number 0."""
        self.count = 0
        self._dies_before = dies_before
        for name in ("_replaced", "_append_whole"):
            monkeypatch.setattr(files, name, self._watched(getattr(files, name)))

    def _watched(self, write: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*arguments: Any, **options: Any) -> Any:
            if self.count == self._dies_before:
                raise Died
            self.count += 1
            return write(*arguments, **options)

        return watched


CRASHING = ("training.checkpoint_interval=4", "training.save_interval=2", "algorithm=qmix", *REPLAY)
WRITES = 19
"""Of four such steps: a row, weights and a manifest each; a header of metrics.csv for the first, and for the
second another, as only then the replay has enough to learn from; a replay and a state for every second; and a
state at the end."""


def left_behind(path: Path) -> tuple[dict[int, bytes], list[dict[str, str]]]:
    """What whoever opens the run directory finds: all checkpoints' weights, and the rows without times."""
    store = CheckpointStore(str(path / "checkpoints"))
    rows = files.read_table(path / "metrics.csv")
    for row in rows:
        for column in ("time", "collect_s", "update_s"):
            del row[column]
    return {manifest.episode: store.read(manifest) for manifest in store.manifests}, rows


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("undisturbed")
    played = Played(path, 4, *CRASHING)
    with pytest.MonkeyPatch.context() as monkeypatch:
        writes = Writes(monkeypatch)
        played.train()
    assert writes.count == WRITES, "each of them wants its crash below"
    return path


@pytest.mark.parametrize("write", range(WRITES))
def test_a_crash_in_front_of_any_write_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: Path, write: int
) -> None:
    crashed = Played(tmp_path, 4, *CRASHING)
    with monkeypatch.context() as patch:
        Writes(patch, dies_before=write)
        with pytest.raises(Died):
            crashed.train()
    Played(tmp_path, 4, *CRASHING).train()
    assert left_behind(tmp_path) == left_behind(undisturbed)


def test_a_run_without_all_its_checkpoints_is_not_resumed_unless_told_to(tmp_path: Path) -> None:
    settings = ("training.checkpoint_interval=4", "training.save_interval=1")
    Played(tmp_path, 3, *settings).train()
    for path in (tmp_path / "checkpoints").glob("checkpoint-000000008.*"):
        path.unlink()
    with pytest.raises(CorruptError, match="1 checkpoints, from 8 on, are missing") as caught:
        Played(tmp_path, 4, *settings)
    advice = re.search(r"append a line (\S+) to (\S+)", str(caught.value))
    assert advice
    Path(advice[2]).write_text(advice[1])
    assert list(Played(tmp_path, 4, *settings).train().digests()) == [4, 12, 16]


def test_stop_ends_a_trainer_that_waits(tmp_path: Path) -> None:
    played = Played(tmp_path, 10**6)
    played.trainer.stop()
    played.train()
    assert played.trainer.next_batch == 0
    assert not played.trainer.complete


def test_the_replay_on_disk_is_what_the_kept_states_need(tmp_path: Path) -> None:
    """Two states are kept, of learner steps 10 and 12; the older one reaches back to episode 30."""
    Played(tmp_path, 12, "training.save_interval=2", "algorithm=qmix", *REPLAY).train()
    names = sorted(path.stem[:26] for path in (tmp_path / "state").glob("replay-*"))
    assert names == [
        "replay-000000024-000000032",
        "replay-000000032-000000040",
        "replay-000000040-000000048",
    ]
    (newest,) = (tmp_path / "state").glob("state-000000012-*")
    newest.write_bytes(b"damaged")
    again = Played(tmp_path, 12, "training.save_interval=2", "algorithm=qmix", *REPLAY)
    assert again.trainer.next_batch == 10
    assert again.trainer.algorithm.replay is not None
    assert (again.trainer.algorithm.replay.first, again.trainer.algorithm.replay.total) == (30, 40)


@pytest.mark.parametrize("enabled", [True, False])
def test_a_run_says_whether_its_checkpoints_are_to_be_tested(tmp_path: Path, enabled: bool) -> None:
    Played(tmp_path, 1, f"evaluation.enabled={enabled}")
    assert metrics.LEARNER.get_sample_value("liir_evaluation_enabled") == enabled


def test_a_state_that_does_not_fit_is_an_error_that_says_so(tmp_path: Path) -> None:
    Played(tmp_path, 2).train()
    with pytest.raises(CorruptError, match="the state of step 2 fits no liir of this build"):
        Played(tmp_path, 4, "algorithm.policy_hidden=9")


def test_the_rate_falls_when_nothing_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    progress = Progress()
    progress.recent.extend([(10.0, 0), (11.0, 100), (12.0, 200)])
    now = 12.9
    monkeypatch.setattr("services.learner.trainer.time.monotonic", lambda: now)
    assert progress.env_steps_per_second == 100  # the next is not late yet
    now = 15.0
    assert progress.env_steps_per_second == 200 / 4
