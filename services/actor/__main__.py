"""`liir actors`: the actor driver and its fleet."""

import signal
import sys

import ray

from liir_common import logs, metrics, options
from liir_common.client import learners_config
from liir_common.errors import exit_on_error
from liir_common.rollout.play import warm_up
from liir_common.rpc.tokens import Role
from services.actor.driver import Fleet, start_ray


def actors(
    learner: options.Learner, config: options.ConfigFile = None, settings: options.Settings = None
) -> None:
    """Play for a learner with N Ray actors; what to play comes from the learner."""
    logs.configure("actors")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with exit_on_error():
        security = options.load_security(config, settings)
        resolved = learners_config(learner, settings or (), security, Role.ACTOR)
        # Compiled once here; every actor finds the result in the cache.
        warm_up(resolved.env)
        start_ray(resolved.actors)
        # From now on this container is healthy, and the evaluator may start, which compiles as much.
        metrics.serve(
            metrics.DRIVER, resolved.metrics.host, resolved.actors.metrics_port, "actors.metrics_port"
        )
        fleet = Fleet(learner, resolved)
        # Ray has put in a handler of its own, and an exception raised inside its calls is an error to it.
        signal.signal(signal.SIGTERM, lambda *_: fleet.stop())
        try:
            fleet.run()
        finally:
            ray.shutdown()


if __name__ == "__main__":
    options.run(actors)
