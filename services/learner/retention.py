"""Which checkpoints have had their time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from liir_common.checkpoint import Manifest
from liir_common.client import Merit
from liir_common.config import Config


def superseded(
    manifests: Sequence[Manifest], merits_of: Callable[[Sequence[int]], Mapping[int, Merit]], config: Config
) -> list[int]:
    """Episodes of the checkpoints that no rule of `config.checkpoints` keeps.

    `manifests` are those there, oldest first; `merits_of` leaves out the untested. Those stay, unless the run
    tests nothing.
    """
    rules = config.checkpoints
    if not rules.keep_newest:
        return []
    episodes = [manifest.episode for manifest in manifests]
    merits = merits_of(episodes)
    kept = set(episodes[-rules.keep_newest :])
    if rules.keep_every:
        step = rules.keep_every * config.training.checkpoint_interval
        kept |= {episode for episode in episodes if episode % step == 0}
    kept |= set(sorted(merits, key=merits.__getitem__)[::-1][: rules.keep_best])
    may_go = merits if config.evaluation.enabled else episodes
    return [episode for episode in may_go if episode not in kept]
