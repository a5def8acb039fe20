"""The evaluator: tests every frozen checkpoint, in order, exactly once."""

from __future__ import annotations

import time
from collections.abc import Sequence

import grpc
import numpy as np
import structlog

from liir_common import checkpoint, metrics, seeds
from liir_common.build import build
from liir_common.client import CheckpointClient, TrainingClient
from liir_common.config import Config
from liir_common.errors import DamagedError, MissingError, RefusedError, UnreachableError
from liir_common.rollout.player import Player
from liir_common.rpc.channel import AWAY, backoffs
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2
from liir_common.rpc.tokens import Role
from liir_common.types import Ticket, Weights

log = structlog.get_logger()


def evaluate(
    player: Player, weights: Weights, config: Config, episode: int, mode: str
) -> checkpoint_pb2.EpisodeStats:
    """Play the test episodes of one checkpoint with seeds that no training episode has.

    `mode` is "greedy" or "sampled", as `AlgorithmConfig.frozen_choice` has them.
    """
    player.load(weights)
    exploration, epsilon = config.algorithm.frozen_choice(sampled=mode == "sampled")
    episodes = config.evaluation.episodes
    played = [
        player.play(
            Ticket(index, 0, seeds.evaluation_seed(config.seed, episode, index), exploration, epsilon)
        )
        for index in range(episodes)
    ]
    metrics.EVALUATION_EPISODES.labels(mode).inc(episodes)
    return checkpoint_pb2.EpisodeStats(
        episodes=len(played),
        wins=sum(trajectory.info.get("won", 0.0) > 0 for trajectory in played),
        return_mean=float(np.mean([trajectory.reward.sum() for trajectory in played])),
        length_mean=float(np.mean([trajectory.length for trajectory in played])),
        info_means={key: float(np.mean([t.info[key] for t in played])) for key in played[0].info},
    )


class Evaluator:
    """Works through a learner's checkpoints and waits for more until the run is complete."""

    def __init__(self, address: str, config: Config, player: Player, settings: Sequence[str] = ()) -> None:
        """Test what the learner at `address` freezes, as its `config` says with these settings over it."""
        self._address = address
        self._config = config
        self._settings = settings
        self._player = player
        self._phase = ""
        """What it is doing, for the log."""

    def run(self) -> None:
        """Return when the run is complete and every checkpoint has its test.

        Raises:
            CorruptError: what came has not the manifest's digest, or is of another build's format.
            RefusedError: the learner refused a call, or plays another game; to try again would not help.
        """
        waits, security = backoffs(), self._config.security
        # The clients connect again by themselves.
        with (
            TrainingClient(self._address, security=security, role=Role.EVALUATOR) as training,
            CheckpointClient(self._address, security=security, role=Role.EVALUATOR) as client,
        ):
            while True:
                try:
                    self._check_game(training)
                    self._catch_up(client)
                    return
                except grpc.RpcError as error:
                    if error.code() not in AWAY:
                        raise RefusedError(f"{error.code().name}: {error.details()}") from None
                    self._log_away(error.details())
                except UnreachableError as error:
                    self._log_away(str(error))
                time.sleep(next(waits))

    def _log_away(self, reason: str | None) -> None:
        log.warning("the learner is away", address=self._address, phase=self._phase, reason=reason)

    def _check_game(self, training: TrainingClient) -> None:
        self._phase = "connecting"
        run = training.run()
        wanted = {"environment": run.env_spec_hash, "build": run.build}
        got = {"environment": self._player.spec.hash, "build": build()}
        if wanted != got:
            raise RefusedError(
                f"this evaluator would play other episodes: wanted {wanted}, got {got}; "
                "start it from the learner's build"
            )
        # The learner may have been resumed with other tests, or with none.
        self._config = training.config(self._settings, self._config.security)

    def _catch_up(self, client: CheckpointClient) -> None:
        self._phase = "asking what is tested"
        tested = {evaluation.episode for evaluation in client.evaluations()}
        self._phase = "waiting for checkpoints"
        for frozen in client.watch():
            if frozen.episode in tested or not self._config.evaluation.enabled:
                continue
            try:
                with metrics.EVALUATION_SECONDS.time():
                    evaluation = self._test(client, frozen)
                    self._phase = f"reporting checkpoint {frozen.episode}"
                    client.report(evaluation)
            except MissingError as error:
                # Only tested ones are ever deleted: another evaluator was quicker.
                log.info("not tested", episode=frozen.episode, reason=str(error))
            except DamagedError as error:
                log.error("not tested", episode=frozen.episode, reason=str(error))
            else:
                metrics.EVALUATED_EPISODE.set(frozen.episode)
            self._phase = "waiting for checkpoints"

    def _test(self, client: CheckpointClient, frozen: checkpoint_pb2.Checkpoint) -> checkpoint_pb2.Evaluation:
        self._phase = f"fetching checkpoint {frozen.episode}"
        _, tensors = client.get(frozen.episode)
        weights = checkpoint.section(tensors, "policy")
        stats = {
            mode: evaluate(self._player, weights, self._config, frozen.episode, mode)
            for mode in ("greedy", "sampled")
        }
        log.info(
            "tested", episode=frozen.episode, wins=stats["greedy"].wins, sampled_wins=stats["sampled"].wins
        )
        return checkpoint_pb2.Evaluation(
            episode=frozen.episode, sha256=frozen.sha256, env_steps=frozen.env_steps, **stats
        )
