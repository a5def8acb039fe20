"""The run itself: what it is, how far it is, and a way to end it."""

from __future__ import annotations

import json
from collections.abc import Callable

import grpc

from liir_common.build import build
from liir_common.rpc.gen.liir.v1 import training_pb2, training_pb2_grpc
from services.learner.checkpoint_service import CheckpointService
from services.learner.rollout_service import RolloutService
from services.learner.run_directory import RunDirectory
from services.learner.trainer import Progress


class TrainingService(training_pb2_grpc.TrainingServiceServicer):
    """Reads what the others know."""

    def __init__(
        self,
        run: RunDirectory,
        progress: Progress,
        rollouts: RolloutService,
        checkpoints: CheckpointService,
        stop: Callable[[str], None],
    ) -> None:
        """Answer for `run`; `stop` begins a graceful end."""
        self._run = run
        self._progress = progress
        self._rollouts = rollouts
        self._checkpoints = checkpoints
        self._stop = stop

    async def GetRun(
        self, request: training_pb2.GetRunRequest, context: grpc.aio.ServicerContext
    ) -> training_pb2.GetRunResponse:
        """What never changes during a run."""
        return training_pb2.GetRunResponse(
            run_id=self._run.run_id,
            config_json=json.dumps(self._run.config.shared_tree()),
            env_spec_hash=self._run.spec.hash,
            build=build(),
        )

    async def GetStatus(
        self, request: training_pb2.GetStatusRequest, context: grpc.aio.ServicerContext
    ) -> training_pb2.GetStatusResponse:
        """How far the run is."""
        progress = self._progress
        return training_pb2.GetStatusResponse(
            phase=progress.phase,
            learner_step=progress.counters.learner_step,
            env_steps=progress.counters.env_steps,
            total_env_steps=self._run.config.training.total_env_steps,
            episodes=progress.counters.episodes,
            actors=self._rollouts.actors,
            tickets_outstanding=self._rollouts.outstanding,
            checkpoints=self._run.checkpoints.frozen,
            evaluations=len(self._checkpoints.evaluations),
            env_steps_per_second=progress.env_steps_per_second,
            metrics=progress.newest,
        )

    async def Stop(
        self, request: training_pb2.StopRequest, context: grpc.aio.ServicerContext
    ) -> training_pb2.StopResponse:
        """Begin a graceful end and return at once."""
        self._stop(request.reason or "asked over gRPC")
        return training_pb2.StopResponse()
