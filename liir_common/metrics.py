"""Every Prometheus metric of the service, defined once; a process exposes those of its registry.

Counters of actors reach the learner as deltas on their streams and are exposed there.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import structlog
from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
    start_http_server,
)
from prometheus_client.metrics_core import Metric

from liir_common.errors import ConfigError

log = structlog.get_logger()

# They are the times at which counters and histograms began, which nobody draws.
disable_created_metrics()  # type: ignore[no-untyped-call]


class ProcessMetrics(ProcessCollector):
    """Of the standard metrics of a process, those that the dashboard draws."""

    KEPT = ("cpu_seconds", "resident_memory_bytes", "open_fds")

    def collect(self) -> Iterator[Metric]:
        """Read them."""
        return (family for family in super().collect() if family.name.endswith(self.KEPT))


class ProcessRegistry(CollectorRegistry):
    """Metrics of one kind of process, and those that every process has, such as its memory."""

    def __init__(self) -> None:
        """Begin without the default registry's, which anybody's library may add to."""
        super().__init__()
        ProcessMetrics(registry=self)

    def counter(self, name: str, meaning: str, labels: Sequence[str] = ()) -> Counter:
        """A figure that only grows."""
        return Counter(name, meaning, labels, registry=self)

    def gauge(self, name: str, meaning: str, labels: Sequence[str] = ()) -> Gauge:
        """A figure that goes up and down."""
        return Gauge(name, meaning, labels, registry=self)

    def histogram(
        self, name: str, meaning: str, labels: Sequence[str] = (), *, buckets: Sequence[float]
    ) -> Histogram:
        """A distribution, counted up to each of `buckets`."""
        return Histogram(name, meaning, labels, registry=self, buckets=buckets)


LEARNER, DRIVER, EVALUATOR = ProcessRegistry(), ProcessRegistry(), ProcessRegistry()

_FAST = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)

# Learner: what was trained.
ENV_STEPS = LEARNER.counter("liir_env_steps_total", "Environment steps consumed by the learner", ["map"])
EPISODES = LEARNER.counter("liir_episodes_total", "Training episodes consumed by the learner", ["map"])
RUN_ENV_STEPS = LEARNER.gauge("liir_run_env_steps", "Environment steps of the run, resumed or not")
RUN_ENV_STEPS_WANTED = LEARNER.gauge("liir_run_wanted_env_steps", "Environment steps that complete the run")
LEARNER_STEP = LEARNER.gauge("liir_learner_step", "Learner steps made, which is the policy version")
EPISODE_RETURN = LEARNER.gauge("liir_episode_return", "Mean extrinsic return of the newest batch")
EPISODE_LENGTH = LEARNER.gauge(
    "liir_episode_length_steps", "Mean length of the newest batch's episodes, steps"
)
TRAINING_METRIC = LEARNER.gauge("liir_training_metric", "Figure of the newest update (metrics.csv)", ["name"])

# Learner: where the time goes.
PHASE_SECONDS = LEARNER.histogram(
    "liir_learner_phase_seconds", "Seconds of one learner step's phases", ["phase"], buckets=_FAST
)
POLICY_LAG = LEARNER.gauge("liir_policy_lag_versions", "Versions between the newest policy and the batch's")
ACTORS = LEARNER.gauge("liir_actors_connected", "Actor streams open")
BATCHES_WAITING = LEARNER.gauge("liir_batches_waiting", "Complete batches that wait for the learner")
TICKETS = LEARNER.gauge("liir_tickets_outstanding", "Tickets given out and not yet played")
TICKETS_REISSUED = LEARNER.counter(
    "liir_tickets_reissued_total", "Tickets given to another actor", ["reason"]
)
DUPLICATES = LEARNER.counter("liir_duplicate_trajectories_total", "Trajectories that had come before")
RECEIVED_BYTES = LEARNER.counter("liir_trajectory_bytes_total", "Bytes of trajectories received, unpacked")
ACTOR_PLAY_SECONDS = LEARNER.counter("liir_actor_play_seconds_total", "Seconds all actors spent playing")
ACTOR_WAIT_SECONDS = LEARNER.counter("liir_actor_wait_seconds_total", "Seconds all actors waited for tickets")
ACTOR_MEMORY = LEARNER.gauge("liir_actor_peak_memory_bytes", "Peak resident memory, connected actors' sum")
DISK_FULL = LEARNER.gauge("liir_disk_full", "1 while the run waits for room on its disk")
RPC_ERRORS = LEARNER.counter("liir_rpc_errors_total", "Calls that failed, by status code", ["method", "code"])

# Learner: checkpoints and their tests.
CHECKPOINTS = LEARNER.gauge("liir_checkpoints", "Checkpoints frozen")
CHECKPOINT_TIME = LEARNER.gauge("liir_checkpoint_timestamp_seconds", "Unix time of the newest checkpoint")
CHECKPOINTS_DELETED = LEARNER.gauge("liir_checkpoints_deleted", "Checkpoints deleted since, of those frozen")
CHECKPOINTS_DAMAGED = LEARNER.gauge("liir_checkpoints_damaged", "Checkpoints found damaged, and not tested")
EVALUATIONS = LEARNER.gauge("liir_evaluations", "Checkpoints tested")
EVALUATION_ENABLED = LEARNER.gauge("liir_evaluation_enabled", "1 if checkpoints are to be tested")
WIN_RATE = LEARNER.gauge("liir_win_rate", "Wins / episodes of the newest test, 0 to 1", ["map", "actions"])
EVALUATION_RETURN = LEARNER.gauge(
    "liir_evaluation_return", "Mean extrinsic return of the newest test", ["map", "actions"]
)
EVALUATED_ENV_STEPS = LEARNER.gauge(
    "liir_evaluated_env_steps", "Environment steps of the checkpoint tested last"
)

# Actor driver.
ACTORS_ALIVE = DRIVER.gauge("liir_driver_actors_alive", "Ray actors running")
ACTORS_WANTED = DRIVER.gauge("liir_driver_actors_wanted", "Ray actors that should run")
ACTOR_RESTARTS = DRIVER.counter("liir_driver_actor_restarts_total", "Ray actors started anew after a death")

# Evaluator.
EVALUATION_SECONDS = EVALUATOR.histogram(
    "liir_evaluation_seconds", "Seconds to test one checkpoint", buckets=(0.01, 0.05, 0.1, 0.5, 1, 5, 30, 120)
)
EVALUATION_EPISODES = EVALUATOR.counter("liir_evaluation_episodes_total", "Test episodes played", ["actions"])
EVALUATED_EPISODE = EVALUATOR.gauge(
    "liir_evaluator_position_episode", "Episode of the checkpoint tested last"
)


for _reason in ("left", "timeout"):  # a rate wants the zero before the first
    TICKETS_REISSUED.labels(_reason)


@contextmanager
def process_exposed(registry: CollectorRegistry, prefix: str, pid: int) -> Iterator[None]:
    """Expose the standard metrics of another process, too, as PREFIX_process_*."""
    collector = ProcessMetrics(prefix, lambda: pid, registry=registry)
    try:
        yield
    finally:
        registry.unregister(collector)


def serve(registry: CollectorRegistry, host: str, port: int, setting: str) -> int:
    """Expose a process's metrics on /metrics; returns the bound port (0 asks for a free one).

    Raises:
        ConfigError: the port is taken, or the address is not this machine's; `setting` is the port's key.
    """
    try:
        server, _ = start_http_server(port, addr=host, registry=registry)
    except OSError as error:
        raise ConfigError(
            f"cannot serve metrics on {host}:{port}: {error.strerror}; choose another port with "
            f"--set {setting}=N (0 takes a free one), or another address with --set metrics.host=ADDRESS"
        ) from None
    log.info("serving metrics", url=f"http://{host}:{server.server_port}/metrics")
    return int(server.server_port)
