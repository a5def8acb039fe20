"""The training loop: batches in, learner steps, policies and checkpoints out. Runs in a thread of its own."""

from __future__ import annotations

import hashlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import structlog

from liir_common import metrics
from liir_common.build import git_commit
from liir_common.checkpoint import Manifest, pack
from liir_common.errors import CorruptError, DiskFullError, DivergedError, storage_explained
from liir_common.rpc.gen.liir.v1 import training_pb2
from liir_common.types import Array, Batch, Trajectory, Weights
from services.learner.intake import Opening
from services.learner.run_directory import Counters, RunDirectory

if TYPE_CHECKING:  # or torch would come along, which is for the process that computes
    from services.learner.algorithms import Algorithm

log = structlog.get_logger()

_ROOM_POLL_S = 2.0

Batches = queue.SimpleQueue[list[Trajectory] | None]
"""Complete batches in order; None wakes a trainer that was told to stop."""


@dataclass
class Progress:
    """What the trainer is doing; written by its thread, read by any."""

    phase: training_pb2.Phase = training_pb2.PHASE_COLLECTING
    counters: Counters = field(default_factory=Counters)
    newest: Mapping[str, float] = field(default_factory=dict)
    """Metrics of the newest learner step."""
    recent: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=50))
    """(monotonic time, environment steps) of the last learner steps."""

    @property
    def env_steps_per_second(self) -> float:
        """Rate over the last learner steps, and over the time that the next is late."""
        if len(self.recent) < 2:
            return 0.0
        (t0, n0), (t1, n1) = self.recent[0], self.recent[-1]
        usual = (t1 - t0) / (len(self.recent) - 1)
        late = max(0.0, time.monotonic() - t1 - usual)
        return (n1 - n0) / (t1 - t0 + late)


class Trainer:
    """Makes learner steps until the run has its environment steps, or until told to stop."""

    def __init__(
        self,
        run: RunDirectory,
        algorithm: Algorithm,
        publish: Callable[[Opening, Weights], None],
        frozen: Callable[[], None],
    ) -> None:
        """Go on where the run directory's state stands.

        `publish` is called for each batch that may be played, `frozen` after each new checkpoint.
        """
        self.run_directory = run
        self.config = run.config
        self.algorithm = algorithm
        self.batches: Batches = queue.SimpleQueue()
        self.progress = Progress()
        self._publish = publish
        self._frozen = frozen
        self._stopping = threading.Event()
        self._origin: dict[str, Any] = {
            "run_id": run.run_id,
            "git_commit": git_commit(),
            "env_spec": asdict(run.spec),
            "config": run.config.shared_tree(),
        }
        """What all manifests say alike, in memory once."""
        self._openings: deque[tuple[Opening, Weights]] = deque()
        self._restore()

    @property
    def complete(self) -> bool:
        """Whether the run has all its environment steps."""
        return self._completes(self.progress.counters)

    def _completes(self, counters: Counters) -> bool:
        return counters.env_steps >= self.config.training.total_env_steps

    @property
    def next_batch(self) -> int:
        """The batch that the next learner step takes."""
        return self.progress.counters.learner_step

    def stop(self) -> None:
        """End after the learner step under way."""
        self._stopping.set()
        self.batches.put(None)

    def run(self) -> None:
        """Train; the state is saved when this returns.

        Raises:
            DivergedError: learning has diverged.
            StorageError: the run directory cannot be written to; while it is only full, this waits for room
                until told to stop.
        """
        for opening, weights in () if self.complete else self._openings:
            self._publish(opening, weights)
        while not (self._stopping.is_set() or self.complete) and self._step():
            pass
        self._save()

    def _step(self) -> bool:
        progress = self.progress
        progress.phase = training_pb2.PHASE_COLLECTING
        with _timed("collect") as collect:
            trajectories = self.batches.get()
        if trajectories is None:
            return False
        progress.phase = training_pb2.PHASE_UPDATING
        opening, _ = self._openings.popleft()
        with _timed("update") as update:
            batch = Batch.from_trajectories(trajectories, opening.epsilon)
            before = progress.counters
            after = Counters(
                before.learner_step + 1,
                before.env_steps + batch.env_steps,
                before.episodes + len(trajectories),
            )
            try:
                figures = self.algorithm.update(batch, partial(self._open, after))
            except FloatingPointError as error:
                raise DivergedError(f"{error}; begin another run with lower learning rates") from None
        progress.counters = after
        with _timed("record"):
            seconds = {"collect_s": collect.seconds, "update_s": update.seconds}
            self._record(opening, trajectories, figures | seconds)
            self._freeze(before.episodes)
            if progress.counters.learner_step % self.config.training.save_interval == 0:
                self._save()
        return True

    def _open(self, counters: Counters, weights: Weights) -> None:
        """Let the actors play a batch with `weights`, the policy of the step that ends at `counters`.

        If the run is complete then, the opening is kept only, so that a run resumed with more steps goes on
        as if never ended.
        """
        epsilon = self.config.algorithm.exploration.epsilon(counters.env_steps)
        batch = counters.learner_step + self.config.training.lag
        opening = Opening(batch, counters.learner_step, epsilon)
        self._openings.append((opening, weights))
        if not self._completes(counters):
            self._publish(opening, weights)

    def _record(self, opening: Opening, trajectories: list[Trajectory], figures: Mapping[str, float]) -> None:
        counters, progress = self.progress.counters, self.progress
        episode_figures = {
            "return_mean": float(np.mean([t.reward.sum() for t in trajectories])),
            "length_mean": float(np.mean([t.length for t in trajectories])),
            **{
                f"{key}_mean": float(np.mean([t.info[key] for t in trajectories]))
                for key in trajectories[0].info
            },
        }
        policy = {
            "policy_lag": counters.learner_step - 1 - opening.policy_version,
            "epsilon": opening.epsilon,
        }
        progress.newest = {**episode_figures, **policy, **figures}
        progress.recent.append((time.monotonic(), counters.env_steps))
        # Together with their number and order, which the batch checks, these say which episodes it had.
        episodes = {"first_episode": trajectories[0].episode_id, "last_episode": trajectories[-1].episode_id}
        row = {**asdict(counters), **episodes, "time": time.time(), **progress.newest}
        self._store(lambda: self.run_directory.metrics.append(row))
        steps = sum(t.length for t in trajectories)
        metrics.ENV_STEPS.labels(self.config.env.label).inc(steps)
        metrics.EPISODES.labels(self.config.env.label).inc(len(trajectories))
        self._show_progress()
        metrics.EPISODE_RETURN.set(episode_figures["return_mean"])
        metrics.EPISODE_LENGTH.set(episode_figures["length_mean"])
        metrics.POLICY_LAG.set(policy["policy_lag"])
        for name, value in figures.items():
            metrics.TRAINING_METRIC.labels(name).set(value)

    def _freeze(self, episodes_before: int) -> None:
        """One checkpoint for every multiple of the interval that this step's episodes crossed."""
        interval, counters = self.config.training.checkpoint_interval, self.progress.counters
        first = (episodes_before // interval + 1) * interval
        for episode in range(first, counters.episodes + 1, interval):
            weights = {f"policy.{name}": array for name, array in self.algorithm.policy().items()}
            intrinsic = {f"intrinsic.{name}": array for name, array in self.algorithm.intrinsic().items()}
            data = pack(weights | intrinsic)
            manifest = Manifest(
                episode=episode,
                policy_version=counters.learner_step,
                env_steps=counters.env_steps,
                created=time.time(),
                sha256=hashlib.sha256(data).hexdigest(),
                size_bytes=len(data),
                **self._origin,
            )
            self._store(partial(self.run_directory.checkpoints.publish, manifest, data))
            self._show_progress()
            self._frozen()

    def _show_progress(self) -> None:
        """Set the gauges that go on where they were when a run is resumed."""
        counters, store = self.progress.counters, self.run_directory.checkpoints
        metrics.LEARNER_STEP.set(counters.learner_step)
        metrics.RUN_ENV_STEPS.set(counters.env_steps)
        metrics.RUN_ENV_STEPS_WANTED.set(self.config.training.total_env_steps)
        metrics.CHECKPOINTS.set(store.frozen)
        metrics.EVALUATION_ENABLED.set(self.config.evaluation.enabled)
        if store.manifests:
            metrics.CHECKPOINT_TIME.set(store.manifests[-1].created)

    def _save(self) -> None:
        """Keep everything the next learner step depends on."""
        self._save_replay()
        arrays: dict[str, Array] = {f"algorithm.{name}": a for name, a in self.algorithm.state().items()}
        for opening, weights in self._openings:
            arrays |= {f"opening.{opening.batch}.{name}": array for name, array in weights.items()}
        notes = {"openings": [asdict(opening) for opening, _ in self._openings]}
        self._store(lambda: self.run_directory.save_state(self.progress.counters, arrays, notes))

    def _save_replay(self) -> None:
        """Append the new episodes, before the state that counts them; drop those that no kept state needs."""
        replay, store = self.algorithm.replay, self.run_directory.replay
        if replay is None:
            return
        first = max(store.stop, replay.first)
        self._store(lambda: store.append(first, replay.frames(first)))
        oldest = self.run_directory.oldest_state_step * self.config.training.batch_episodes
        store.prune(oldest - self.config.algorithm.replay.episodes)

    def _store(self, write: Callable[[], object]) -> None:
        """Write to the run directory, once there is room.

        Raises:
            StorageError: it cannot be written to, or is full and the trainer was told to stop.
        """
        while True:
            try:
                with storage_explained(self.run_directory.path):
                    write()
            except DiskFullError as error:
                if self._stopping.is_set():
                    raise
                metrics.DISK_FULL.set(1)
                log.error(
                    "the run waits for room on its disk", reason=str(error), **asdict(self.progress.counters)
                )
                self._stopping.wait(_ROOM_POLL_S)
            else:
                metrics.DISK_FULL.set(0)
                return

    def _restore_replay(self, total: int) -> None:
        if self.algorithm.replay is not None:
            first = max(0, total - self.config.algorithm.replay.episodes)
            for start, frames in self.run_directory.replay.load(first, total):
                self.algorithm.replay.extend(start, frames)

    def _restore(self) -> None:
        saved = self.run_directory.load_state()
        counters = Counters() if saved is None else saved[0]
        self._restore_replay(counters.episodes)
        if saved is None:
            for batch in range(self.config.training.lag + 1):
                epsilon = self.config.algorithm.exploration.epsilon(0)
                self._openings.append((Opening(batch, 0, epsilon), self.algorithm.policy()))
        else:
            _, arrays, notes = saved
            interval = self.config.training.checkpoint_interval
            # Nobody comes to these again, so one that is lost would be a gap that nobody notices.
            self.run_directory.checkpoints.check_all(range(interval, counters.episodes + 1, interval))
            try:
                self.algorithm.load_state(_section(arrays, "algorithm."))
            except ValueError as error:
                raise CorruptError(
                    f"the state of step {counters.learner_step} fits no {self.config.algorithm.name} of this "
                    f"build: {error}; resume with the build that wrote it"
                ) from None
            for fields in notes["openings"]:
                weights = _section(arrays, f"opening.{fields['batch']}.")
                self._openings.append((Opening(**fields), weights))
            log.info("resumed", **asdict(counters))
        self.progress.counters = counters
        self.run_directory.metrics.keep("learner_step", counters.learner_step)
        self._show_progress()


def _section(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}


@dataclass
class _Timer:
    seconds: float = 0.0


@contextmanager
def _timed(phase: str) -> Iterator[_Timer]:
    timer = _Timer()
    begin = time.perf_counter()
    yield timer
    timer.seconds = time.perf_counter() - begin
    metrics.PHASE_SECONDS.labels(phase).observe(timer.seconds)
