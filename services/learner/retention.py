"""Which checkpoints have had their time."""

from __future__ import annotations

import bisect
import heapq

from liir_common.checkpoint import CheckpointStore
from liir_common.client import Merit, merit
from liir_common.config import Config
from services.learner.evaluations import Evaluations


class Retention:
    """Deletes the checkpoints that no rule of `config.checkpoints` keeps.

    In a run with tests the untested stay. Each is ranked once, when it is tested, and what `keep_every`
    keeps is not looked at again: a run of weeks keeps too many to go through whenever there is a new one.
    One that was lost and is frozen anew, older than the newest, counts from the learner's next start on.
    """

    def __init__(self, store: CheckpointStore, evaluations: Evaluations, config: Config) -> None:
        """Rule over `store`, whose tests are `evaluations`."""
        self._store = store
        self._evaluations = evaluations
        self._rules = config.checkpoints
        self._every = config.checkpoints.keep_every * config.training.checkpoint_interval
        self._tests = config.evaluation.enabled
        self._seen = 0
        """Episode of the newest checkpoint so far."""
        self._passing: list[int] = []
        """Those there that only their age or merit keeps, oldest first."""
        self._unranked: list[int] = []
        self._best: list[tuple[Merit, int]] = []

    def apply(self) -> None:
        """Delete what has had its time.

        Raises:
            OSError: a file cannot be read or deleted now; the next call tries again.
        """
        if not self._rules.keep_newest:
            return
        self._take_in_new()
        self._rank()
        kept = {manifest.episode for manifest in self._store.manifests[-self._rules.keep_newest :]}
        kept.update(episode for _, episode in self._best)
        self._passing = [episode for episode in self._passing if episode in self._store]
        for episode in self._passing:
            if episode not in kept and (not self._tests or episode in self._evaluations):
                self._store.delete(episode)

    def _take_in_new(self) -> None:
        manifests = self._store.manifests
        begin = bisect.bisect_right(manifests, self._seen, key=lambda manifest: manifest.episode)
        new = [manifest.episode for manifest in manifests[begin:]]
        self._passing += [episode for episode in new if not self._every or episode % self._every]
        if self._rules.keep_best:
            self._unranked += new
        self._seen = max([self._seen, *new])

    def _rank(self) -> None:
        tested = [episode for episode in self._unranked if episode in self._evaluations]
        merits = ((merit(self._evaluations[episode]), episode) for episode in tested)
        self._best = heapq.nlargest(self._rules.keep_best, [*self._best, *merits])
        self._unranked = [e for e in self._unranked if e not in self._evaluations] if self._tests else []
