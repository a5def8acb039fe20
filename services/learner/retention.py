"""Which checkpoints have had their time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from liir_common.checkpoint import Manifest
from liir_common.client import merit
from liir_common.config import Config
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2


def superseded(
    manifests: Sequence[Manifest], evaluations: Mapping[int, checkpoint_pb2.Evaluation], config: Config
) -> list[int]:
    """Episodes of the checkpoints that no rule of `config.checkpoints` keeps.

    `manifests` are those there, oldest first. One without its evaluation stays, unless the run has none.
    """
    rules = config.checkpoints
    if not rules.keep_newest:
        return []
    episodes = [manifest.episode for manifest in manifests]
    tested = [episode for episode in episodes if episode in evaluations]
    kept = set(episodes[-rules.keep_newest :])
    if rules.keep_every:
        step = rules.keep_every * config.training.checkpoint_interval
        kept |= {episode for episode in episodes if episode % step == 0}
    kept |= set(sorted(tested, key=lambda episode: merit(evaluations[episode]))[::-1][: rules.keep_best])
    may_go = tested if config.evaluation.enabled else episodes
    return [episode for episode in may_go if episode not in kept]
