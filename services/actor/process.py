"""The process that Ray gives an actor, in which all waits for what its start costs."""

from __future__ import annotations

import gc
from typing import Any


class ActorProcess:
    """A `RolloutActor` as a Ray actor.

    Collecting garbage among the modules that it imports would be a seventh of the work of its start, and they
    stay for good: this class needs none of them, so that it can see to that first.
    """

    def __init__(self, *args: Any) -> None:
        """Take what `RolloutActor` takes."""
        gc.disable()
        from services.actor.rollout_actor import RolloutActor

        self._actor = RolloutActor(*args)
        gc.freeze()
        gc.enable()

    def ready(self) -> str:
        """As `RolloutActor.ready`."""
        return self._actor.ready()

    def run(self) -> None:
        """As `RolloutActor.run`."""
        self._actor.run()
