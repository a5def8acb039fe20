"""A run whose disk is full: it waits, says so, and goes on; or ends when asked and is resumed."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.e2e import service
from tests.e2e.test_run import assert_same, scrape

pytestmark = pytest.mark.faults


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run with room for everything."""
    run_dir = tmp_path_factory.mktemp("undisturbed") / "run"
    service.train(run_dir)
    return run_dir


@contextmanager
def full(disk: Path) -> Iterator[None]:
    """No byte is left on the disk, for as long as the block lasts."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(65536)):
            pass
    yield
    filler.unlink()


def waits_for_room(run_dir: Path) -> bool:
    return scrape(run_dir / "logs" / "learner.log")["liir_disk_full"] == 1


def test_a_full_disk_pauses_the_run(undisturbed: Path, small_disk: Path) -> None:
    run_dir = small_disk / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        with full(small_disk):
            service.wait_for(lambda: waits_for_room(run_dir), "the run's waiting")
            with service.client(run_dir) as training:
                step = training.status().learner_step
                assert training.serving()
                assert training.status().learner_step == step
        service.finish(process)
    assert_same(run_dir, undisturbed)


def test_a_run_stopped_on_a_full_disk_ends_with_code_six_and_is_resumed(
    undisturbed: Path, small_disk: Path
) -> None:
    run_dir = small_disk / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        with full(small_disk):
            service.wait_for(lambda: waits_for_room(run_dir), "the run's waiting")
            process.send_signal(signal.SIGTERM)
            output = service.finish(process, code=6)
            assert "code 6 (A run directory, or other output, cannot be written to)" in output
            assert "No space left on device" in service.finish(
                service.start("learner", "--resume", "--run-dir", str(run_dir), "--set", "learner.port=0"),
                code=6,
            )
    service.train(run_dir, options=["--resume"])
    assert_same(run_dir, undisturbed)
