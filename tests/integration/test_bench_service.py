"""The benchmarks of the whole service run it and count what they say; how fast is not a test's business."""

from __future__ import annotations

import pytest

from liir_common.bench import bench_death, bench_resume, bench_start
from liir_common.errors import LiirError

SMALL = ("actors.count=2", "training.batch_episodes=8", "evaluation.enabled=false")


def test_all_actors_come() -> None:
    result = bench_start("3m", SMALL)
    assert result["actors"] == 2
    assert 0 < result["serving_s"] < result["first_actor_s"] < result["all_actors_s"]


def test_the_dead_actors_tickets_are_played_again() -> None:
    result = bench_death("3m", deaths=1, settings=SMALL)
    assert (result["actors"], result["deaths"]) == (2, 1)
    assert result["tickets"] >= 1
    assert 0 < result["noticed_s"] < result["played_again_s"] == result["slowest_s"]


def test_the_resumed_run_has_its_replay() -> None:
    result = bench_resume("3m", episodes=40, repeats=1, settings=SMALL)
    assert (result["replay_episodes"], result["resumes"]) == (40, 1)
    assert 0 < result["first_learner_step_s"] == result["slowest_s"]


def test_a_training_that_cannot_begin_says_why() -> None:
    with pytest.raises(LiirError, match=r"ended with code 2:\n.*no_such_map"):
        bench_resume("no_such_map", episodes=40, repeats=1)
