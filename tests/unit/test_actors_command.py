"""`liir actors`: what has happened by the time that its health is visible, and what if it cannot be."""

from __future__ import annotations

import socket
import subprocess
import sys
from unittest.mock import Mock

import pytest

from liir_common import config
from liir_common.errors import ConfigError
from services.actor import __main__ as command

HANGING = """
import time, ray
from liir_common import config
from services.actor import driver
driver._RAY_START_S = 0.5
ray.init = lambda **_: time.sleep(600)
driver.start_ray(config.load().actors)
"""


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Stands for all that the command calls, and remembers the calls."""
    seen = Mock()
    seen.learners_config.return_value = config.load()
    for name in ("learners_config", "warm_up", "start_ray", "Fleet", "ray", "signal", "logs"):
        monkeypatch.setattr(command, name, getattr(seen, name))
    return seen


def test_metrics_are_served_once_the_game_is_compiled_and_ray_is_joined(
    seen: Mock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compose takes an answer at the metrics' port for health, and starts the evaluator then."""
    monkeypatch.setattr(command.metrics, "serve", seen.serve)
    command.actors("127.0.0.1:1")
    order = [name for name, _, _ in seen.mock_calls]
    assert (
        order.index("warm_up") < order.index("start_ray") < order.index("serve") < order.index("Fleet().run")
    )


def test_a_busy_metrics_port_is_an_error_that_names_its_key(
    seen: Mock, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        seen.learners_config.return_value = config.load(settings=[f"actors.metrics_port={port}"])
        with pytest.raises(SystemExit) as caught:
            command.actors("127.0.0.1:1")
    assert caught.value.code == ConfigError.exit_code
    assert "--set actors.metrics_port=N" in capfd.readouterr().err
    seen.Fleet.assert_not_called()


def test_ray_that_never_starts_ends_the_process_and_says_where() -> None:
    done = subprocess.run([sys.executable, "-c", HANGING], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "in start_ray" in done.stderr
