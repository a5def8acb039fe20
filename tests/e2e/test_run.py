"""`liir train` as a user runs it: whatever dies on the way, the same checkpoints come out.

Every training here is real: learner, Ray actors and evaluator in processes of their own.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import yaml

from liir_common.replay.load import find_checkpoint
from tests.e2e import service
from tests.unit.test_metrics import check_described


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in which nothing went wrong."""
    run_dir = tmp_path_factory.mktemp("undisturbed") / "run"
    service.train(run_dir)
    return run_dir


def assert_under_way(run_dir: Path, undisturbed: Path) -> None:
    """What was just done to the run came before its last learner step; later, nothing would be tested."""
    step, last = service.learner_step(run_dir), service.learner_step(undisturbed)
    assert step < last, f"wanted a run under way, got one that is at learner step {step} of {last}"


def assert_same(run_dir: Path, undisturbed: Path) -> None:
    """Equal checkpoints, each tested once and with the same result; every episode consumed once."""
    assert service.digests(run_dir) == service.digests(undisturbed) != {}
    assert evaluations(run_dir) == evaluations(undisturbed)
    assert sorted(row["episode"] for row in evaluations(run_dir)) == sorted(
        map(str, service.digests(run_dir))
    )
    rows = list(csv.DictReader((run_dir / "metrics.csv").open()))
    assert [int(row["learner_step"]) for row in rows] == list(range(1, len(rows) + 1))
    assert [int(row["episodes"]) for row in rows] == [8 * step for step in range(1, len(rows) + 1)]
    batches = [(int(row["first_episode"]), int(row["last_episode"])) for row in rows]
    assert batches == [(8 * step, 8 * step + 7) for step in range(len(rows))]


def evaluations(run_dir: Path) -> list[dict[str, str]]:
    rows = list(csv.DictReader((run_dir / "evaluations.csv").open()))
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


def test_a_run_leaves_all_its_files(undisturbed: Path) -> None:
    config = yaml.safe_load((undisturbed / "config.yaml").read_text())
    assert config["training"]["batch_episodes"] == 8
    steps = list(csv.DictReader((undisturbed / "metrics.csv").open()))
    assert int(steps[-1]["env_steps"]) >= 6000 > int(steps[-2]["env_steps"])
    assert {"return_mean", "reward_ratio", "eta_gradient_norm", "policy_lag"} <= set(steps[0])
    assert {int(row["policy_lag"]) for row in steps} == {0}
    episodes = int(steps[-1]["episodes"])
    assert list(service.digests(undisturbed)) == list(range(20, episodes + 1, 20))
    summary = json.loads((undisturbed / "summary.json").read_text())
    assert summary["evaluations"] == len(service.digests(undisturbed))
    assert (undisturbed / "winrate.png").read_bytes().startswith(b"\x89PNG")
    for name in ("learner", "actors", "evaluator"):
        for line in (undisturbed / "logs" / f"{name}.log").read_text().splitlines():
            if line.startswith("{"):
                assert "event" in json.loads(line)


def test_five_actors_make_the_checkpoints_of_two(undisturbed: Path, tmp_path: Path) -> None:
    service.train(tmp_path / "run", "actors.count=5")
    assert_same(tmp_path / "run", undisturbed)


def test_lag_one_is_deterministic_and_lags(tmp_path: Path) -> None:
    for actors in (2, 5):
        service.train(tmp_path / str(actors), f"actors.count={actors}", "training.lag=1")
    assert service.digests(tmp_path / "2") == service.digests(tmp_path / "5") != {}
    rows = list(csv.DictReader((tmp_path / "2" / "metrics.csv").open()))
    assert [int(row["policy_lag"]) for row in rows] == [0] + [1] * (len(rows) - 1)


def kill_actor(process: subprocess.Popen[str], run_dir: Path) -> None:
    service.kill(service.descendants(process, "ray::ActorProcess")[0])


def kill_driver(process: subprocess.Popen[str], run_dir: Path) -> None:
    service.kill(service.descendants(process, "services.actor")[0])


def kill_learner(process: subprocess.Popen[str], run_dir: Path) -> None:
    service.kill(service.descendants(process, "services.learner --")[0])


def kill_compute(process: subprocess.Popen[str], run_dir: Path) -> None:
    service.kill(service.descendants(process, "services.learner.compute")[0])


def kill_evaluator(process: subprocess.Popen[str], run_dir: Path) -> None:
    service.kill(service.descendants(process, "services.evaluator")[0])


@pytest.mark.parametrize("kill", [kill_actor, kill_driver, kill_learner, kill_compute, kill_evaluator])
def test_a_death_changes_nothing(
    kill: Callable[[subprocess.Popen[str], Path], None], undisturbed: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        kill(process, run_dir)
        assert_under_way(run_dir, undisturbed)
        service.finish(process)
    assert_same(run_dir, undisturbed)


def merit(row: dict[str, str]) -> tuple[float, ...]:
    """What is greater for a better checkpoint, in the order that docs/operations.md gives."""
    figures = ("greedy_win_rate", "sampled_win_rate", "greedy_return_mean", "episode")
    return tuple(float(row[figure]) for figure in figures)


def test_old_checkpoints_go_and_nothing_else_changes(undisturbed: Path, tmp_path: Path) -> None:
    """The killed learner comes to some of the deleted ones again."""
    run_dir = tmp_path / "run"
    rules = ("checkpoints.keep_newest=2", "checkpoints.keep_every=4", "checkpoints.keep_best=1")
    with service.training(run_dir, *rules, "training.save_interval=10") as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 18, "the eighteenth learner step")
        kill_learner(process, run_dir)
        assert_under_way(run_dir, undisturbed)
        service.finish(process)
    assert evaluations(run_dir) == evaluations(undisturbed)
    everything = service.digests(undisturbed)
    tests = {int(row["episode"]): row for row in evaluations(run_dir)}
    best = max(tests, key=lambda episode: merit(tests[episode]))
    kept = {*list(everything)[-2:], *(episode for episode in everything if episode % 80 == 0), best}
    assert service.digests(run_dir) == {episode: everything[episode] for episode in sorted(kept)}
    assert find_checkpoint(None, run_dir, best=True).exists()


def test_an_actor_killed_in_the_middle_of_an_episode_changes_nothing(
    undisturbed: Path, tmp_path: Path
) -> None:
    """Both actors are stopped while they hold tickets, then killed before they can play them."""
    run_dir = tmp_path / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        victims = service.descendants(process, "ray::ActorProcess")
        assert len(victims) == 2
        for victim in victims:
            victim.suspend()
        with service.client(run_dir) as training:
            service.wait_for(lambda: training.status().tickets_outstanding > 0, "a ticket with an actor")
        for victim in victims:
            service.kill(victim)
        assert_under_way(run_dir, undisturbed)
        service.finish(process)
    assert_same(run_dir, undisturbed)


def test_ctrl_c_saves_and_resume_ends_as_if_never_stopped(undisturbed: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(signal.SIGINT)
        output = service.finish(process, code=128 + signal.SIGINT)
    assert f"liir train --resume --run-dir {run_dir}" in output
    _, left = psutil.wait_procs(children, timeout=10)
    assert not left
    assert len(service.digests(run_dir)) < len(service.digests(undisturbed))
    service.train(run_dir, options=["--resume"])
    assert_same(run_dir, undisturbed)


def test_more_steps_for_a_complete_run_continue_it(undisturbed: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    service.train(run_dir, "training.total_env_steps=3000")
    service.train(run_dir, options=["--resume"])
    assert_same(run_dir, undisturbed)


def test_resuming_a_complete_run_ends_well(undisturbed: Path) -> None:
    before = service.digests(undisturbed)
    service.train(undisturbed, options=["--resume"])
    assert service.digests(undisturbed) == before


@contextmanager
def trained_and_not_tested(run_dir: Path, checkpoints: int) -> Iterator[str]:
    """Learner and actors alone, to the end of training; yields the learner's address, then all must end."""
    learner = service.start("learner", "--run-dir", str(run_dir), *service.arguments([]))
    actors = None
    try:
        service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
        address = service.endpoints(run_dir)["address"]
        actors = service.start("actors", "--learner", address)
        with service.client(run_dir) as training:
            service.wait_for(lambda: training.status().checkpoints == checkpoints, "the last checkpoint")
            assert training.status().evaluations == 0
        yield address
        service.finish(learner)
        service.finish(actors)
    finally:
        for process in (learner, actors):
            if process is not None and process.poll() is None:
                process.kill()


def test_the_evaluator_may_be_away_and_catches_up(undisturbed: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with trained_and_not_tested(run_dir, len(service.digests(undisturbed))) as address:
        service.finish(service.start("evaluator", "--learner", address))
    assert_same(run_dir, undisturbed)


def test_a_damaged_checkpoint_is_not_tested_and_stops_nothing(undisturbed: Path, tmp_path: Path) -> None:
    run_dir, episodes = tmp_path / "run", list(service.digests(undisturbed))
    with trained_and_not_tested(run_dir, len(episodes)) as address:
        weights = run_dir / "checkpoints" / f"checkpoint-{episodes[1]:09d}.safetensors"
        data = bytearray(weights.read_bytes())
        data[-1] ^= 1
        weights.write_bytes(data)
        service.finish(service.start("evaluator", "--learner", address))
    tested = [int(row["episode"]) for row in csv.DictReader((run_dir / "evaluations.csv").open())]
    assert tested == [episode for episode in episodes if episode != episodes[1]]


def leave_driver(process: subprocess.Popen[str]) -> None:
    service.descendants(process, "services.actor")[0].terminate()


def leave_evaluator(process: subprocess.Popen[str]) -> None:
    service.descendants(process, "services.evaluator")[0].terminate()


@pytest.mark.parametrize("leave", [leave_driver, leave_evaluator])
def test_a_part_that_was_asked_to_end_is_started_again(
    leave: Callable[[subprocess.Popen[str]], None], undisturbed: Path, tmp_path: Path
) -> None:
    """They end with 0 then, as they do at the end of a run."""
    run_dir = tmp_path / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        leave(process)
        assert_under_way(run_dir, undisturbed)
        service.finish(process)
    assert_same(run_dir, undisturbed)


def test_the_actor_driver_ends_without_error_when_asked(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    learner = service.start("learner", "--run-dir", str(run_dir), *service.arguments([]))
    service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
    actors = service.start("actors", "--learner", service.endpoints(run_dir)["address"])
    try:
        service.wait_for(lambda: service.learner_step(run_dir) >= 1, "the first learner step")
        actors.terminate()
        assert "SIGTERM" not in service.finish(actors)
    finally:
        for process in (actors, learner):
            process.terminate()
            process.communicate(timeout=60)


LATE_SAMPLES = {
    "learner": "liir_actor_peak_memory_bytes",
    "actors": "liir_driver_actors_alive",
    "evaluator": 'liir_evaluation_episodes_total{actions="greedy"}',
}
"""What each process shows last."""


def test_metrics_of_all_three_processes(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with service.training(run_dir, "training.total_env_steps=1000000") as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 6, "the sixth learner step")
        # The learner adds up its actors' memory once a second; the others may be later than its steps.
        for name, sample in LATE_SAMPLES.items():
            log = run_dir / "logs" / f"{name}.log"
            service.wait_for(lambda log=log, sample=sample: scrape(log).get(sample, 0) > 0, sample)  # type: ignore[misc]
        pages = {name: scrape(run_dir / "logs" / f"{name}.log") for name in LATE_SAMPLES}
        for name in LATE_SAMPLES:
            check_described(name, service.page(metrics_url(run_dir / "logs" / f"{name}.log")))
        process.send_signal(signal.SIGTERM)
        service.finish(process, code=128 + signal.SIGTERM)
    assert pages["learner"]['liir_env_steps_total{map="3m"}'] > 0
    assert pages["learner"]["liir_learner_step"] >= 6
    assert pages["learner"]["liir_actors_connected"] == 2
    assert pages["learner"]["liir_actor_play_seconds_total"] > 0
    assert 2 * 50e6 < pages["learner"]["liir_actor_peak_memory_bytes"] < 2 * 1e9
    assert pages["actors"]["liir_driver_actors_alive"] == 2
    assert pages["evaluator"]['liir_evaluation_episodes_total{actions="greedy"}'] > 0


def test_nothing_is_open_to_other_machines_or_users(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with service.training(run_dir, "training.total_env_steps=1000000") as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 3, "the third learner step")
        below = psutil.Process(process.pid).children(recursive=True)
        listening = [
            (child.name(), connection.laddr.ip.removeprefix("::ffff:"))
            for child in below
            for connection in child.net_connections()
            if connection.status == psutil.CONN_LISTEN
        ]
        (raylet,) = service.descendants(process, "raylet/raylet")
        token = raylet.environ()["RAY_AUTH_TOKEN"], raylet.environ()["RAY_AUTH_MODE"]
    assert {"gcs_server", "raylet"} < {name for name, _ in listening}
    assert {address for _, address in listening} == {"127.0.0.1"}
    # On loopback there are other users, who are not to have Ray run code in this one's name.
    assert (len(token[0]), token[1]) == (64, "token")


def metrics_url(log: Path) -> str:
    """Of a process's /metrics page, as its log has it; empty before."""
    lines = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
    return next((line["url"] for line in lines if line["event"] == "serving metrics"), "")


def scrape(log: Path) -> dict[str, float]:
    """Samples of a process's /metrics page; none before there is one."""
    url = metrics_url(log)
    return service.samples(url) if url else {}


def test_learner_away_at_start_is_a_clear_error() -> None:
    for command in ("actors", "evaluator"):
        process = service.start(command, "--learner", "127.0.0.1:9")
        assert "no learner answered at 127.0.0.1:9" in service.finish(process, code=3)


def test_a_launcher_that_is_killed_leaves_no_process_and_loses_nothing(
    undisturbed: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    with service.training(run_dir) as process:
        service.wait_for(lambda: service.learner_step(run_dir) >= 5, "the fifth learner step")
        children = psutil.Process(process.pid).children(recursive=True)
        os.kill(process.pid, signal.SIGKILL)
        _, left = psutil.wait_procs(children, timeout=30)
        assert not left
    assert_under_way(run_dir, undisturbed)
    service.train(run_dir, options=["--resume"])
    assert_same(run_dir, undisturbed)
