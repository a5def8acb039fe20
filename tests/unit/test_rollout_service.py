"""What the learner keeps for its actors."""

from __future__ import annotations

import queue

import numpy as np
import pytest

from liir_common import config
from services.learner.intake import Opening
from services.learner.rollout_service import RolloutService
from tests.samples import SPEC


@pytest.mark.parametrize("lag", [0, 1])
def test_policies_that_no_open_batch_is_played_by_are_forgotten(lag: int) -> None:
    """All others, lag + 1 at most, stay: an actor that comes late may get a ticket of any open batch."""
    service = RolloutService(config.load(None, [f"training.lag={lag}"]), SPEC, 0, queue.SimpleQueue())
    for batch in range(5):
        version = max(0, batch - lag)
        service.publish(Opening(batch, version, 0.0), {"fc1.bias": np.zeros(2, np.float32)})
        assert sorted(service._policies) == list(range(max(0, version - lag), version + 1))
