"""`liir actors`: what has happened by the time that its health is visible."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from liir_common import config
from services.actor import __main__ as command


def test_metrics_are_served_once_the_game_is_compiled_and_ray_is_joined(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Compose takes an answer at the metrics' port for health, and starts the evaluator then."""
    seen = Mock()
    seen.learners_config.return_value = config.load()
    for name in ("learners_config", "warm_up", "start_ray", "Fleet", "ray", "signal", "logs"):
        monkeypatch.setattr(command, name, getattr(seen, name))
    monkeypatch.setattr(command.metrics, "serve", seen.serve)
    command.actors("127.0.0.1:1")
    order = [name for name, _, _ in seen.mock_calls]
    assert (
        order.index("warm_up") < order.index("start_ray") < order.index("serve") < order.index("Fleet().run")
    )
