"""Every Prometheus metric of the service, defined once; a process exposes those it sets.

Counters of actors reach the learner as deltas on their streams and are exposed there.
"""

import structlog
from prometheus_client import Counter, Gauge, Histogram, start_http_server

from liir_common.errors import ConfigError

log = structlog.get_logger()

_FAST = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)

# Learner: what was trained.
ENV_STEPS = Counter("liir_env_steps_total", "Environment steps consumed by the learner", ["map"])
EPISODES = Counter("liir_episodes_total", "Training episodes consumed by the learner", ["map"])
RUN_ENV_STEPS = Gauge("liir_run_env_steps", "Environment steps of the run, resumed or not")
RUN_ENV_STEPS_WANTED = Gauge("liir_run_wanted_env_steps", "Environment steps that complete the run")
LEARNER_STEP = Gauge("liir_learner_step", "Learner steps made, which is the policy version")
EPISODE_RETURN = Gauge("liir_episode_return", "Mean extrinsic return of the newest batch")
EPISODE_LENGTH = Gauge("liir_episode_length_steps", "Mean length of the newest batch's episodes, steps")
TRAINING_METRIC = Gauge("liir_training_metric", "Figure of the newest update (metrics.csv)", ["name"])

# Learner: where the time goes.
PHASE_SECONDS = Histogram(
    "liir_learner_phase_seconds", "Seconds of one learner step's phases", ["phase"], buckets=_FAST
)
POLICY_LAG = Gauge("liir_policy_lag_versions", "Versions between the newest policy and the batch's")
ACTORS = Gauge("liir_actors_connected", "Actor streams open")
BATCHES_WAITING = Gauge("liir_batches_waiting", "Complete batches that wait for the learner")
TICKETS = Gauge("liir_tickets_outstanding", "Tickets given out and not yet played")
TICKETS_REISSUED = Counter("liir_tickets_reissued_total", "Tickets given to another actor", ["reason"])
DUPLICATES = Counter("liir_duplicate_trajectories_total", "Trajectories that had come before")
RECEIVED_BYTES = Counter("liir_trajectory_bytes_total", "Bytes of trajectories received")
ACTOR_PLAY_SECONDS = Counter("liir_actor_play_seconds_total", "Seconds all actors spent playing")
ACTOR_WAIT_SECONDS = Counter("liir_actor_wait_seconds_total", "Seconds all actors waited for tickets")
RPC_ERRORS = Counter("liir_rpc_errors_total", "Calls refused, by status code", ["method", "code"])

# Learner: checkpoints and their tests.
CHECKPOINTS = Gauge("liir_checkpoints", "Checkpoints frozen")
CHECKPOINT_TIME = Gauge("liir_checkpoint_timestamp_seconds", "Unix time of the newest checkpoint")
EVALUATIONS = Gauge("liir_evaluations", "Checkpoints tested")
WIN_RATE = Gauge("liir_win_rate", "Wins / episodes of the newest test, 0 to 1", ["map", "actions"])
EVALUATION_RETURN = Gauge(
    "liir_evaluation_return", "Mean extrinsic return of the newest test", ["map", "actions"]
)
EVALUATED_ENV_STEPS = Gauge("liir_evaluated_env_steps", "Environment steps of the checkpoint tested last")

# Actor driver.
ACTORS_ALIVE = Gauge("liir_driver_actors_alive", "Ray actors running")
ACTORS_WANTED = Gauge("liir_driver_actors_wanted", "Ray actors that should run")
ACTOR_RESTARTS = Counter("liir_driver_actor_restarts_total", "Ray actors started anew after a death")

# Evaluator.
EVALUATION_SECONDS = Histogram(
    "liir_evaluation_seconds", "Seconds to test one checkpoint", buckets=(0.01, 0.05, 0.1, 0.5, 1, 5, 30, 120)
)
EVALUATION_EPISODES = Counter("liir_evaluation_episodes_total", "Test episodes played", ["actions"])
EVALUATED_EPISODE = Gauge("liir_evaluator_position_episode", "Episode of the checkpoint tested last")


for _reason in ("left", "timeout"):  # a rate wants the zero before the first
    TICKETS_REISSUED.labels(_reason)


def serve(host: str, port: int, setting: str) -> int:
    """Expose this process's metrics on /metrics; returns the bound port (0 asks for a free one).

    Raises:
        ConfigError: the port is taken, or the address is not this machine's; `setting` is the port's key.
    """
    try:
        server, _ = start_http_server(port, addr=host)
    except OSError as error:
        raise ConfigError(
            f"cannot serve metrics on {host}:{port}: {error.strerror}; choose another port with "
            f"--set {setting}=N (0 takes a free one), or another address with --set metrics.host=ADDRESS"
        ) from None
    log.info("serving metrics", url=f"http://{host}:{server.server_port}/metrics")
    return int(server.server_port)
