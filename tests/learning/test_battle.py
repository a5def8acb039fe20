"""LIIR learns 3m by the trainer, the tickets and the compiled episodes that a run uses, in one process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from liir_common import config, seeds
from liir_common.rollout.play import make_player
from liir_common.types import Ticket, Weights
from services.learner.algorithms import make_algorithm
from services.learner.intake import Opening
from services.learner.run_directory import RunDirectory
from services.learner.trainer import Trainer

SETTINGS = [
    "preset=strong",
    "env.map=3m",
    "algorithm.entropy=0.03",
    "algorithm.exploration.steps=10000",
    "training.total_env_steps=40000",
    "learner.threads=1",
    "evaluation.enabled=false",
    "seed=3",
]


def test_liir_learns_3m(tmp_path: Path) -> None:
    """Mean return of a batch: 1.2 at the start, 3.8 with ε left at .5, and 8.9 to 11.3 for seeds 3 to 6."""
    settings = config.load(None, SETTINGS)
    player = make_player(settings.env, settings.algorithm.policy_hidden)
    run = RunDirectory(tmp_path, settings, player.spec)
    seed = seeds.derive(settings.seed, seeds.LEARNER)
    algorithm = make_algorithm(player.spec, settings.algorithm, seed, torch.device("cpu"))
    size, choice = settings.training.batch_episodes, settings.algorithm.behaviour

    def play(opening: Opening, weights: Weights) -> None:
        player.load(weights)
        episodes = range(opening.batch * size, (opening.batch + 1) * size)
        trainer.batches.put(
            [
                player.play(
                    Ticket.for_training(settings.seed, i, opening.policy_version, choice, opening.epsilon)
                )
                for i in episodes
            ]
        )

    trainer = Trainer(run, algorithm, play, lambda: None)
    trainer.run()
    returns = [float(row["return_mean"]) for row in run.metrics.read()]
    assert returns[0] < 2
    assert np.mean(returns[-8:]) > 7
