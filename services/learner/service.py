"""The learner process: gRPC on the event loop, the training loop in a thread, one graceful way to end."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

import structlog

from liir_common import metrics
from liir_common.config import Config
from liir_common.errors import storage_explained
from liir_common.rpc.gen.liir.v1 import (
    checkpoint_pb2_grpc,
    rollout_pb2_grpc,
    training_pb2,
    training_pb2_grpc,
)
from liir_common.rpc.server import Server
from liir_common.types import EnvSpec, Weights
from services.learner.checkpoint_service import CheckpointService
from services.learner.compute import Compute
from services.learner.intake import Opening
from services.learner.memory import keep_memory
from services.learner.rollout_service import RolloutService
from services.learner.run_directory import RunDirectory
from services.learner.trainer import Trainer
from services.learner.training_service import TrainingService

if TYPE_CHECKING:  # or torch would come along
    from services.learner.algorithms import Algorithm

log = structlog.get_logger()

_DRAIN_GRACE_S = 5.0
_STOP_GRACE_S = 2.0


async def serve(config: Config, run: RunDirectory, spec: EnvSpec) -> None:
    """Train until the run is complete and its checkpoints are tested, or until asked to stop.

    With `learner.stay` only the latter ends it.
    """
    keep_memory()
    server = Server(
        config.learner.host, config.learner.port, config.security, insecure=config.learner.insecure
    )
    with (
        Compute(spec, config) as algorithm,
        metrics.process_exposed(metrics.LEARNER, "compute", algorithm.pid),
    ):
        counts = algorithm.parameter_counts()
        log.info("parameters", **counts)
        with storage_explained(run.path):
            run.write_parameters(counts)
        await _train(run, algorithm, server)


async def _train(run: RunDirectory, algorithm: Algorithm, server: Server) -> None:
    config, loop = run.config, asyncio.get_running_loop()
    on_loop = _OnLoop(loop)

    def publish(opening: Opening, weights: Weights) -> None:
        on_loop(lambda: rollouts.publish(opening, weights))

    def frozen() -> None:
        on_loop(checkpoints.changed)

    with storage_explained(run.path):
        trainer = Trainer(run, algorithm, publish, frozen)
    metrics.BATCHES_WAITING.set_function(trainer.batches.qsize)
    rollouts = RolloutService(config, run.spec, trainer.next_batch, trainer.batches)
    checkpoints = CheckpointService(run)
    stopping = asyncio.Event()

    def stop(reason: str) -> None:
        log.info("stopping", reason=reason)
        stopping.set()
        trainer.stop()

    training = TrainingService(run, trainer.progress, rollouts, checkpoints, stop)
    rollout_pb2_grpc.add_RolloutServiceServicer_to_server(rollouts, server.grpc)
    checkpoint_pb2_grpc.add_CheckpointServiceServicer_to_server(checkpoints, server.grpc)
    training_pb2_grpc.add_TrainingServiceServicer_to_server(training, server.grpc)
    for signum in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(signum, stop, signum.name)

    metrics_port = metrics.serve(
        metrics.LEARNER, config.metrics.host, config.learner.metrics_port, "learner.metrics_port"
    )
    await server.start()
    with storage_explained(run.path):
        run.write_endpoints(
            {"address": server.local_address, "metrics": f"{config.metrics.host}:{metrics_port}"}
        )
    log.info("serving", address=f"{config.learner.host}:{server.port}", run=str(run.path))
    expiry = asyncio.create_task(rollouts.expire_tickets())
    learning = asyncio.create_task(asyncio.to_thread(trainer.run))
    try:
        await _first_of(learning, expiry, on_loop.failure)
        if trainer.complete and config.evaluation.enabled and not stopping.is_set():
            trainer.progress.phase = training_pb2.PHASE_EVALUATING
            await _first_of(checkpoints.wait_all_evaluated(), stopping.wait(), expiry, on_loop.failure)
        if trainer.complete and config.learner.stay:
            trainer.progress.phase = training_pb2.PHASE_COMPLETE
            await _first_of(stopping.wait(), expiry, on_loop.failure)
    finally:
        trainer.stop()
        expiry.cancel()
        await asyncio.wait([learning])  # which saves the state, with the algorithm that is still there
        # One that stays is missed when it goes: its peers wait for it to come back.
        over = trainer.complete and not config.learner.stay
        await _leave(server, trainer, rollouts, checkpoints, over)


class _OnLoop:
    """Work that another thread leaves to the event loop without waiting for it."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.failure: asyncio.Future[None] = loop.create_future()
        """Ends with the first exception of such work, which nobody else would notice."""

    def __call__(self, work: Callable[[], Awaitable[None] | None]) -> None:
        asyncio.run_coroutine_threadsafe(self._run(work), self._loop)

    async def _run(self, work: Callable[[], Awaitable[None] | None]) -> None:
        try:
            if (rest := work()) is not None:
                await rest
        except Exception as error:
            if not self.failure.done():
                self.failure.set_exception(error)


async def _leave(
    server: Server, trainer: Trainer, rollouts: RolloutService, checkpoints: CheckpointService, over: bool
) -> None:
    """Say goodbye in the order that lets every peer end cleanly, for good if it is `over`."""
    trainer.progress.phase = training_pb2.PHASE_STOPPING
    await server.not_serving()
    await rollouts.drain("the learner ends", over, _DRAIN_GRACE_S)
    await checkpoints.end(over)
    await server.stop(_STOP_GRACE_S)
    log.info("ended", run_complete=trainer.complete, learner_step=trainer.progress.counters.learner_step)


async def _first_of(*awaitables: Awaitable[object]) -> None:
    """Wait for the first to end, and raise what it raised."""
    tasks = [asyncio.ensure_future(awaitable) for awaitable in awaitables]
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()
