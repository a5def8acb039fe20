"""`liir evaluator`: the evaluator process."""

import signal
import sys

from liir_common import config, logs, metrics, options
from liir_common.client import TrainingClient
from liir_common.errors import exit_on_error
from liir_common.rollout.play import make_player
from services.evaluator.evaluator import Evaluator


def evaluator(learner: options.Learner, settings: options.Settings = None) -> None:
    """Test every checkpoint that a learner freezes; what to play comes from the learner."""
    logs.configure("evaluator")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with exit_on_error():
        with TrainingClient(learner) as client:
            tree = client.config().tree()
        resolved = config.from_tree(config.merge(tree, config.parse_settings(settings or ())))
        metrics.serve(resolved.evaluation.metrics_port, "evaluation.metrics_port")
        player = make_player(resolved.env, resolved.algorithm.policy_hidden)
        Evaluator(learner, resolved, player).run()


if __name__ == "__main__":
    options.run(evaluator)
