"""`liir actors`: the actor driver and its fleet."""

import signal
import sys

import ray

from liir_common import config, logs, metrics, options
from liir_common.client import TrainingClient
from liir_common.errors import exit_on_error
from liir_common.rollout.play import warm_up
from services.actor.driver import Fleet, start_ray


def actors(learner: options.Learner, settings: options.Settings = None) -> None:
    """Play for a learner with N Ray actors; what to play comes from the learner."""
    logs.configure("actors")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with exit_on_error():
        with TrainingClient(learner) as client:
            tree = client.config().tree()
        resolved = config.from_tree(config.merge(tree, config.parse_settings(settings or ())))
        metrics.serve(resolved.actors.metrics_port, "actors.metrics_port")
        # Compiled once here; every actor finds the result in the cache.
        warm_up(resolved.env)
        start_ray(resolved.actors)
        try:
            Fleet(learner, resolved).run()
        finally:
            ray.shutdown()


if __name__ == "__main__":
    options.run(actors)
