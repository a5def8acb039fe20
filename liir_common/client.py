"""Clients of a learner: checkpoints, evaluations and the run itself. Needs neither torch nor Ray."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import grpc
import numpy as np
from grpc_health.v1 import health_pb2, health_pb2_grpc
from numpy.typing import NDArray

from liir_common.checkpoint import Manifest, unpack
from liir_common.config import PLAINTEXT, Config, SecurityConfig, from_tree, merge, parse_settings
from liir_common.errors import LiirError, MissingError, RefusedError, UnreachableError
from liir_common.rpc.channel import DEADLINE_S, connect
from liir_common.rpc.gen.liir.v1 import (
    checkpoint_pb2,
    checkpoint_pb2_grpc,
    training_pb2,
    training_pb2_grpc,
)
from liir_common.rpc.tokens import Role

AWAY = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED)
"""Codes that tell of the connection, not of the call: to try again may help."""
_PAGE = 1000
_DOWNLOAD_TRIES = 5
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
        """Manifest and weights file of one checkpoint; a broken download goes on where it broke.

        Raises:
            MissingError: there is no such checkpoint, or it was deleted.
            LiirError: the learner's copy is damaged.
            UnreachableError: the connection kept breaking.
            CorruptError: the bytes that came do not have the manifest's digest.
        """
        data = bytearray()
        for _ in range(_DOWNLOAD_TRIES):
            try:
                manifest = self._download_rest(episode, data)
            except grpc.RpcError as error:
                if error.code() not in AWAY:
                    kind = MissingError if error.code() == grpc.StatusCode.NOT_FOUND else LiirError
                    raise kind(f"checkpoint {episode}: {error.details()}") from None
                continue
            unpack(bytes(data), manifest.sha256)
            return manifest, bytes(data)
        raise UnreachableError(f"checkpoint {episode}: the download broke {_DOWNLOAD_TRIES} times")

    def get(self, episode: int) -> tuple[Manifest, dict[str, NDArray[np.float32]]]:
        """Manifest and tensors of one checkpoint; raises what `download` raises."""
        manifest, data = self.download(episode)
        return manifest, unpack(data, manifest.sha256)

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

    def _download_rest(self, episode: int, data: bytearray) -> Manifest:
        """Append what is missing to `data`."""
        request = checkpoint_pb2.GetCheckpointRequest(episode=episode, offset=len(data))
        responses = self._stub.GetCheckpoint(request, timeout=DEADLINE_S)
        manifest = Manifest.from_json(next(responses).header.manifest_json)
        for response in responses:
            data += response.chunk
        return manifest


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

    def config(self) -> Config:
        """The run's resolved configuration; `security` is each process's own and not part of it."""
        run = self._stub.GetRun(training_pb2.GetRunRequest(), timeout=DEADLINE_S)
        return from_tree(json.loads(run.config_json))

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
        tree = client.config().tree()
    own = parse_settings(settings) | {"security": security.model_dump()}
    return from_tree(merge(tree, own))
