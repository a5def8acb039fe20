"""Frozen checkpoints and their tests, served to evaluators and anybody else."""

from __future__ import annotations

import asyncio
import bisect
import math
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import contextmanager

import grpc
import structlog

from liir_common import metrics
from liir_common.checkpoint import Manifest
from liir_common.errors import CorruptError
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, checkpoint_pb2_grpc
from liir_common.rpc.refused import Refused
from services.learner.retention import Retention
from services.learner.run_directory import RunDirectory

log = structlog.get_logger()

_CHUNK_BYTES = 64 * 1024
_MAX_LIST = 1000


class CheckpointService(checkpoint_pb2_grpc.CheckpointServiceServicer):
    """Lives on the event loop; the run directory's tables are its own to write."""

    def __init__(self, run: RunDirectory) -> None:
        """Serve the checkpoints of `run`."""
        self._run = run
        self._changed = asyncio.Condition()
        self._ended = False
        self._complete = False
        self._damaged: set[int] = set()
        """Episodes of checkpoints whose files cannot be read, so that no test of them will ever come."""
        self.evaluations = run.evaluations
        self._retention = Retention(run.checkpoints, run.evaluations, run.config)
        self._show_evaluations()
        self._delete_superseded()  # a resumed run may have another rule

    @property
    def all_evaluated(self) -> bool:
        """Whether every checkpoint so far that can be read has its test."""
        episodes = (manifest.episode for manifest in self._run.checkpoints.manifests)
        return all(episode in self.evaluations or episode in self._damaged for episode in episodes)

    async def changed(self) -> None:
        """Wake the watchers: there is a new checkpoint or a new evaluation; older ones may go."""
        self._delete_superseded()
        async with self._changed:
            self._changed.notify_all()

    async def end(self, run_complete: bool) -> None:
        """Send the watchers home: once they have seen all of a complete run, else told that it is not."""
        self._ended, self._complete = True, run_complete
        await self.changed()

    async def wait_all_evaluated(self) -> None:
        """Return when every checkpoint has its test."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.all_evaluated)

    async def ListCheckpoints(
        self, request: checkpoint_pb2.ListCheckpointsRequest, context: grpc.aio.ServicerContext
    ) -> checkpoint_pb2.ListCheckpointsResponse:
        """Checkpoints after a position, oldest first."""
        found = self._after(request.after_episode, _limit(request.limit))
        return checkpoint_pb2.ListCheckpointsResponse(checkpoints=map(_to_message, found))

    async def GetCheckpoint(
        self, request: checkpoint_pb2.GetCheckpointRequest, context: grpc.aio.ServicerContext
    ) -> AsyncIterator[checkpoint_pb2.GetCheckpointResponse]:
        """A header, then the weights file from the asked offset on."""
        manifest = self._find(request.episode)
        with _passing(f"checkpoint {request.episode} cannot be read now"):
            try:
                data = self._run.checkpoints.read(manifest)
            except (CorruptError, FileNotFoundError) as error:
                await self._note_damage(request.episode)
                message = f"{error}; restore its file from a backup"
                raise Refused(grpc.StatusCode.DATA_LOSS, message) from None
        if request.offset > len(data):
            raise ValueError(f"offset: wanted 0..{len(data)}, got {request.offset}")
        header = checkpoint_pb2.CheckpointHeader(
            checkpoint=_to_message(manifest), manifest_json=manifest.to_json()
        )
        yield checkpoint_pb2.GetCheckpointResponse(header=header)
        for start in range(request.offset, len(data), _CHUNK_BYTES):
            yield checkpoint_pb2.GetCheckpointResponse(chunk=data[start : start + _CHUNK_BYTES])

    async def WatchCheckpoints(
        self, request: checkpoint_pb2.WatchCheckpointsRequest, context: grpc.aio.ServicerContext
    ) -> AsyncIterator[checkpoint_pb2.WatchCheckpointsResponse]:
        """Every checkpoint after a position, in order, until the run is complete."""
        seen = request.after_episode
        while True:
            # One at a time: while one is sent, others may come or be deleted.
            while found := self._after(seen, limit=1):
                yield checkpoint_pb2.WatchCheckpointsResponse(checkpoint=_to_message(found[0]))
                seen = found[0].episode
            if self._complete:
                return
            if self._ended:
                raise Refused(grpc.StatusCode.UNAVAILABLE, "the learner ends; watch again when it is back")
            async with self._changed:
                # The trainer publishes before it notifies, so this cannot sleep through a checkpoint.
                if not self._after(seen, limit=1) and not self._ended:
                    await self._changed.wait()

    async def ReportEvaluation(
        self, request: checkpoint_pb2.ReportEvaluationRequest, context: grpc.aio.ServicerContext
    ) -> checkpoint_pb2.ReportEvaluationResponse:
        """Store the test of a checkpoint, once."""
        evaluation = request.evaluation
        # The evaluator keeps trying, and until then the learner does not call the checkpoint tested.
        with _passing("evaluations.csv cannot be read or written now"):
            if evaluation.episode in self.evaluations:
                # Its checkpoint may be deleted by now.
                _check_digest(evaluation, self.evaluations[evaluation.episode].sha256)
                await self.changed()  # which the first report may not have come to
                return checkpoint_pb2.ReportEvaluationResponse(duplicate=True)
            manifest = self._find(evaluation.episode)
            _check(evaluation, manifest, self._run.spec.info_keys)
            self.evaluations.add(evaluation, manifest)
            self._damaged.discard(evaluation.episode)  # its file has been restored
            self._show_damage()
            self._show_evaluations()
            await self.changed()
        return checkpoint_pb2.ReportEvaluationResponse(duplicate=False)

    async def ListEvaluations(
        self, request: checkpoint_pb2.ListEvaluationsRequest, context: grpc.aio.ServicerContext
    ) -> checkpoint_pb2.ListEvaluationsResponse:
        """Evaluations after a position, oldest checkpoint first."""
        with _passing("evaluations.csv cannot be read now"):
            found = self.evaluations.after(request.after_episode, _limit(request.limit))
        return checkpoint_pb2.ListEvaluationsResponse(evaluations=found)

    async def _note_damage(self, episode: int) -> None:
        self._damaged.add(episode)
        self._show_damage()
        log.error("a checkpoint is damaged; it is neither served nor tested", episode=episode)
        await self.changed()

    def _show_damage(self) -> None:
        """Those that wait for their test in vain; what has had it lacks nothing but its file."""
        metrics.CHECKPOINTS_DAMAGED.set(sum(episode not in self.evaluations for episode in self._damaged))

    def _find(self, episode: int) -> Manifest:
        try:
            return self._run.checkpoints.find(episode)
        except KeyError as error:
            message = f"{error.args[0]}; ListCheckpoints says which there are"
            raise Refused(grpc.StatusCode.NOT_FOUND, message) from None

    def _after(self, episode: int, limit: int) -> list[Manifest]:
        manifests = self._run.checkpoints.manifests
        begin = bisect.bisect_right(manifests, episode, key=lambda manifest: manifest.episode)
        return manifests[begin : begin + limit]

    def _delete_superseded(self) -> None:
        store = self._run.checkpoints
        try:
            self._retention.apply()
        except OSError as error:  # with the next change they are tried again
            log.warning("checkpoints cannot be deleted now", reason=str(error))
        metrics.CHECKPOINTS_DELETED.set(store.frozen - len(store.manifests))

    def _show_evaluations(self) -> None:
        metrics.EVALUATIONS.set(len(self.evaluations))
        newest = self.evaluations.newest
        if newest is None:
            return
        metrics.EVALUATED_ENV_STEPS.set(newest.env_steps)
        for actions in ("greedy", "sampled"):
            stats = getattr(newest, actions)
            labels = (self._run.config.env.label, actions)
            metrics.WIN_RATE.labels(*labels).set(stats.wins / stats.episodes)
            metrics.EVALUATION_RETURN.labels(*labels).set(stats.return_mean)


@contextmanager
def _passing(trouble: str) -> Iterator[None]:
    """What the operating system refuses now, it may do later: the caller shall ask again."""
    try:
        yield
    except OSError as error:
        raise Refused(grpc.StatusCode.UNAVAILABLE, f"{trouble}: {error}") from None


def _limit(asked: int) -> int:
    return min(asked or _MAX_LIST, _MAX_LIST)


def _to_message(manifest: Manifest) -> checkpoint_pb2.Checkpoint:
    return checkpoint_pb2.Checkpoint(
        episode=manifest.episode,
        policy_version=manifest.policy_version,
        env_steps=manifest.env_steps,
        sha256=manifest.sha256,
        size_bytes=manifest.size_bytes,
    )


def _check_digest(evaluation: checkpoint_pb2.Evaluation, wanted: str) -> None:
    if evaluation.sha256 != wanted:
        raise ValueError(f"evaluation: wanted one of SHA-256 {wanted}, got {evaluation.sha256!r}")


def _check(evaluation: checkpoint_pb2.Evaluation, manifest: Manifest, info_keys: Sequence[str]) -> None:
    _check_digest(evaluation, manifest.sha256)
    for name in ("greedy", "sampled"):
        stats = getattr(evaluation, name)
        if not 0 <= stats.wins <= stats.episodes or stats.episodes == 0:
            raise ValueError(f"{name}: wanted 0 <= wins <= episodes > 0, got {stats.wins}/{stats.episodes}")
        # Each becomes a column of a table.
        if set(stats.info_means) != set(info_keys):
            raise ValueError(f"{name}: wanted info of {sorted(info_keys)}, got {sorted(stats.info_means)}")
        if not all(map(math.isfinite, (stats.return_mean, stats.length_mean, *stats.info_means.values()))):
            raise ValueError(f"{name}: wanted finite means, got NaN or infinity")
