"""Clients of a learner: checkpoints, evaluations and the run itself. Needs neither torch nor Ray."""

from __future__ import annotations

import io
import json
import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import grpc
import numpy as np
from grpc_health.v1 import health_pb2, health_pb2_grpc
from numpy.typing import NDArray

from liir_common.checkpoint import Manifest, unpack
from liir_common.config import PLAINTEXT, Config, SecurityConfig, from_tree, merge, parse_settings
from liir_common.errors import (
    CorruptError,
    DamagedError,
    LiirError,
    MissingError,
    RefusedError,
    UnreachableError,
)
from liir_common.files import appended_alone, write_atomic
from liir_common.rpc.channel import AWAY, DEADLINE_S, backoffs, connect
from liir_common.rpc.gen.liir.v1 import (
    checkpoint_pb2,
    checkpoint_pb2_grpc,
    training_pb2,
    training_pb2_grpc,
)
from liir_common.rpc.tokens import Role

_ERRORS = {grpc.StatusCode.NOT_FOUND: MissingError, grpc.StatusCode.DATA_LOSS: DamagedError}
Merit = tuple[float, ...]
_PAGE = 1000
_DOWNLOAD_TRIES = 5
"""In a row that brought nothing; then a download is given up."""
_WATCH_S = 20.0
"""After that a stream is asked for anew, from where it was: no silence is taken for a wait for ever."""


@contextmanager
def refusals_explained() -> Iterator[None]:
    """Turn a call's failure into an error that a person can act on.

    Raises:
        RefusedError: the learner refused the call, and would again.
        UnreachableError: the connection broke.
    """
    try:
        yield
    except grpc.RpcError as error:
        kind = UnreachableError if error.code() in AWAY else RefusedError
        raise kind(f"{error.code().name}: {error.details()}") from None


class CheckpointClient:
    """Lists, downloads and watches the checkpoints of one learner."""

    def __init__(
        self,
        address: str,
        timeout_s: float = 30.0,
        security: SecurityConfig = PLAINTEXT,
        role: Role = Role.READER,
    ) -> None:
        """Connect to the learner at HOST:PORT, with the token of `role` if there is one.

        Raises:
            ConfigError: a file of `security` cannot be used.
            UnreachableError: nobody answered within `timeout_s`.
        """
        self._channel = connect(address, timeout_s, security, role)
        self._stub = checkpoint_pb2_grpc.CheckpointServiceStub(self._channel)

    def __enter__(self) -> CheckpointClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave."""
        self._channel.close()

    def list(self, after_episode: int = 0) -> Iterator[checkpoint_pb2.Checkpoint]:
        """All checkpoints after a position, oldest first."""
        while True:
            request = checkpoint_pb2.ListCheckpointsRequest(after_episode=after_episode, limit=_PAGE)
            page = self._stub.ListCheckpoints(request, timeout=DEADLINE_S).checkpoints
            yield from page
            if len(page) < _PAGE:
                return
            after_episode = page[-1].episode

    def download(self, episode: int) -> tuple[Manifest, bytes]:
        """Manifest and weights file of one checkpoint; a download that breaks goes on where it broke.

        Raises:
            MissingError: there is no such checkpoint, or it was deleted.
            DamagedError: the learner's copy is damaged.
            RefusedError: the learner refused the call, and would again.
            UnreachableError: the connection kept breaking.
            CorruptError: the bytes that came do not have the manifest's digest.
        """
        file = io.BytesIO()
        manifest = self._fetch(episode, file)
        unpack(file.getvalue(), manifest.sha256)
        return manifest, file.getvalue()

    def save(self, episode: int, folder: Path) -> Path:
        """Download a checkpoint into `folder`, made if missing; returns the weights file.

        What was cut, this process included, goes on where it was cut; while another process downloads the
        same one to the same folder, this waits. A checkpoint is there when its manifest is, which is
        written last. Raises what `download` raises.
        """
        with refusals_explained():
            frozen = self.find(episode)
        if not re.fullmatch("[0-9a-f]{64}", frozen.sha256):
            raise CorruptError(f"checkpoint {episode}: wanted a SHA-256 in hex, got {frozen.sha256!r}")
        folder.mkdir(parents=True, exist_ok=True)
        # Named by the digest: what another checkpoint of that name left is never gone on with.
        part = folder / f".{frozen.sha256}.part"
        with appended_alone(part) as file:
            if file.tell() > frozen.size_bytes:
                file.seek(0)
                file.truncate()
            manifest = self._fetch(episode, file)
            file.flush()
            os.fsync(file.fileno())
            try:
                unpack(part.read_bytes(), manifest.sha256)
            except CorruptError:
                part.unlink()
                raise
            weights = folder / f"checkpoint-{episode:09d}.safetensors"
            part.replace(weights)
            write_atomic(weights.with_suffix(".json"), manifest.to_json().encode())
        return weights

    def get(self, episode: int) -> tuple[Manifest, dict[str, NDArray[np.float32]]]:
        """Manifest and tensors of one checkpoint; raises what `download` raises."""
        manifest, data = self.download(episode)
        return manifest, unpack(data, manifest.sha256)

    def find(self, episode: int) -> checkpoint_pb2.Checkpoint:
        """The checkpoint frozen after `episode` episodes.

        Raises:
            MissingError: there is none.
        """
        frozen = next(self.list(after_episode=max(0, episode - 1)), None)
        if frozen is None or frozen.episode != episode:
            raise MissingError(
                f"no checkpoint of episode {episode}; `liir checkpoints list` says which there are"
            )
        return frozen

    def best(self) -> checkpoint_pb2.Evaluation:
        """The best test: by greedy win rate, then sampled win rate, then greedy return, then youth.

        Raises:
            LiirError: no checkpoint has been tested yet.
        """
        there = {frozen.episode for frozen in self.list()}
        tested = (evaluation for evaluation in self.evaluations() if evaluation.episode in there)
        best = max(tested, key=merit, default=None)
        if best is None:
            raise LiirError("no checkpoint has been tested yet; wait for the evaluator")
        return best

    def watch(self, after_episode: int = 0) -> Iterator[checkpoint_pb2.Checkpoint]:
        """Every checkpoint after a position, in order, those to come included; ends with the run.

        Raises:
            grpc.RpcError: the connection broke; watch again from the last position seen.
        """
        while True:
            request = checkpoint_pb2.WatchCheckpointsRequest(after_episode=after_episode)
            try:
                for response in self._stub.WatchCheckpoints(request, timeout=_WATCH_S):
                    yield response.checkpoint
                    after_episode = response.checkpoint.episode
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.DEADLINE_EXCEEDED:
                    raise
            else:
                return

    def report(self, evaluation: checkpoint_pb2.Evaluation) -> bool:
        """Hand in the test of a checkpoint; false if it had one already."""
        request = checkpoint_pb2.ReportEvaluationRequest(evaluation=evaluation)
        return not self._stub.ReportEvaluation(request, timeout=DEADLINE_S).duplicate

    def evaluations(self, after_episode: int = 0) -> Iterator[checkpoint_pb2.Evaluation]:
        """All evaluations after a position, oldest checkpoint first."""
        while True:
            request = checkpoint_pb2.ListEvaluationsRequest(after_episode=after_episode, limit=_PAGE)
            page = self._stub.ListEvaluations(request, timeout=DEADLINE_S).evaluations
            yield from page
            if len(page) < _PAGE:
                return
            after_episode = page[-1].episode

    def _fetch(self, episode: int, file: BinaryIO) -> Manifest:
        """Append what is missing to `file`; raises what `download` raises, but checks no digest."""
        failures, waits = 0, backoffs()
        while failures < _DOWNLOAD_TRIES:
            begin = file.tell()
            try:
                return self._append_rest(episode, file)
            except grpc.RpcError as error:
                if error.code() not in AWAY:
                    kind = _ERRORS.get(error.code(), RefusedError)
                    raise kind(f"checkpoint {episode}: {error.details()}") from None
            if file.tell() > begin:
                failures, waits = 0, backoffs()
            failures += 1
            time.sleep(next(waits))
        raise UnreachableError(f"checkpoint {episode}: the download broke {failures} times; try again later")

    def _append_rest(self, episode: int, file: BinaryIO) -> Manifest:
        request = checkpoint_pb2.GetCheckpointRequest(episode=episode, offset=file.tell())
        responses = self._stub.GetCheckpoint(request, timeout=DEADLINE_S)
        manifest = Manifest.from_json(next(responses).header.manifest_json)
        for response in responses:
            file.write(response.chunk)
        return manifest


def merit(evaluation: checkpoint_pb2.Evaluation) -> Merit:
    """What is greater for a better checkpoint: greedy, then sampled win rate, greedy return, episode."""
    greedy, sampled = evaluation.greedy, evaluation.sampled
    rates = (tested.wins / tested.episodes for tested in (greedy, sampled))
    return *rates, greedy.return_mean, evaluation.episode


class TrainingClient:
    """Asks a learner about its run."""

    def __init__(
        self,
        address: str,
        timeout_s: float = 30.0,
        security: SecurityConfig = PLAINTEXT,
        role: Role = Role.READER,
    ) -> None:
        """Connect to the learner at HOST:PORT, with the token of `role` if there is one.

        Raises:
            ConfigError: a file of `security` cannot be used.
            UnreachableError: nobody answered within `timeout_s`.
        """
        self._channel = connect(address, timeout_s, security, role)
        self._stub = training_pb2_grpc.TrainingServiceStub(self._channel)

    def __enter__(self) -> TrainingClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave."""
        self._channel.close()

    def serving(self) -> bool:
        """Whether the learner calls itself healthy; false while it is leaving."""
        stub = health_pb2_grpc.HealthStub(self._channel)
        answer = stub.Check(health_pb2.HealthCheckRequest(), timeout=DEADLINE_S)  # type: ignore[attr-defined]
        return bool(answer.status == health_pb2.HealthCheckResponse.SERVING)

    def run(self) -> training_pb2.GetRunResponse:
        """What never changes during the run."""
        run: training_pb2.GetRunResponse = self._stub.GetRun(training_pb2.GetRunRequest(), timeout=DEADLINE_S)
        return run

    def config(self, settings: Sequence[str] = (), security: SecurityConfig = PLAINTEXT) -> Config:
        """The run's resolved configuration, the settings laid over it; `security` is each process's own.

        Raises:
            ConfigError: a setting cannot be used.
        """
        own = parse_settings(settings) | {"security": security.model_dump()}
        return from_tree(merge(json.loads(self.run().config_json), own))

    def status(self) -> training_pb2.GetStatusResponse:
        """How far the run is."""
        status: training_pb2.GetStatusResponse = self._stub.GetStatus(
            training_pb2.GetStatusRequest(), timeout=DEADLINE_S
        )
        return status

    def stop(self, reason: str) -> None:
        """Ask the learner to end gracefully; it does so after the learner step under way."""
        self._stub.Stop(training_pb2.StopRequest(reason=reason), timeout=DEADLINE_S)


def learners_config(address: str, settings: Sequence[str], security: SecurityConfig, role: Role) -> Config:
    """What the learner at HOST:PORT plays, with the settings laid over it and this process's own security.

    Raises:
        ConfigError: a setting or a file of `security` cannot be used.
        RefusedError: the learner does not let this process in.
        UnreachableError: the learner did not answer.
    """
    with TrainingClient(address, security=security, role=role) as client, refusals_explained():
        return client.config(settings, security)
