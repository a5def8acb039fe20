"""`liir evaluator`: the evaluator process."""

import signal
import sys

from liir_common import logs, metrics, options
from liir_common.client import learners_config
from liir_common.errors import exit_on_error
from liir_common.rollout.play import make_player
from liir_common.rpc.tokens import Role
from services.evaluator.evaluator import Evaluator


def evaluator(
    learner: options.Learner, config: options.ConfigFile = None, settings: options.Settings = None
) -> None:
    """Test every checkpoint that a learner freezes; what to play comes from the learner."""
    logs.configure("evaluator")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with exit_on_error():
        security = options.load_security(config, settings)
        resolved = learners_config(learner, settings or (), security, Role.EVALUATOR)
        metrics.serve(
            metrics.EVALUATOR,
            resolved.metrics.host,
            resolved.evaluation.metrics_port,
            "evaluation.metrics_port",
        )
        player = make_player(resolved.env, resolved.algorithm.policy_hidden)
        Evaluator(learner, resolved, player, settings or ()).run()


if __name__ == "__main__":
    options.run(evaluator)
