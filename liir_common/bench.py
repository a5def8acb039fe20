"""How fast the whole service starts, trains, recovers and resumes on this machine, and its memory."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import median
from typing import Any

import psutil

from liir_common import config
from liir_common.client import TrainingClient, refusals_explained
from liir_common.rpc.gen.liir.v1 import training_pb2
from liir_common.watched import Training, run_directory, training

_WARM_UP_STEPS = 50_000
_MEMORY_POLL_S = 1.0
_STALL_S = 1.0
"""A training in which nothing comes in for so long waits for what its stopped actor holds."""
_ENDLESS = "training.total_env_steps=1000000000"
_ACTOR = "ray::ActorProcess"


def bench_train(map_name: str, env_steps: int, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Run `liir train` from its start for `env_steps` steps beyond the warm-up, and measure from outside.

    The rate is the median over ten stretches of equal length after the first 50 000 environment steps.
    Memory is proportional set size (PSS), so that shared pages count once.

    Raises:
        LiirError: the training ended too early.
    """
    total = _WARM_UP_STEPS + env_steps
    chosen = (f"env.map={map_name}", f"training.total_env_steps={total}", *settings)
    with run_directory() as run_dir:
        with training(run_dir, *chosen) as run:
            memory = _memory(run, total)
            run.finish()
        rows = run.rows()
    return {
        "map": map_name,
        "env_steps_per_s": _rate(rows),
        "first_learner_step_s": float(rows[0]["time"]) - run.begin,
        "collect_ms": 1e3 * median(float(row["collect_s"]) for row in rows),
        "update_ms": 1e3 * median(float(row["update_s"]) for row in rows),
        "whole_run_s": time.time() - run.begin,
        "env_steps": total,
        **memory,
    }


def _memory(run: Training, total: int) -> dict[str, float]:
    """PSS of the learner's two processes and of the largest actor, MiB, read once past half of the run."""
    while not run.ended and run.newest("env_steps") <= total / 2:
        time.sleep(_MEMORY_POLL_S)
    actors = _pss_mib(run, _ACTOR)
    return {
        "learner_pss_mib": sum(_pss_mib(run, "services.learner")),
        "actor_pss_mib": max(actors, default=0.0),
        "actors": float(len(actors)),
    }


def _pss_mib(run: Training, command: str) -> list[float]:
    found = []
    for process in run.processes(command):
        try:
            found.append(process.memory_full_info().pss / 2**20)
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return found


def _rate(rows: list[dict[str, str]]) -> float:
    points = [(float(row["time"]), int(row["env_steps"])) for row in rows]
    points = [point for point in points if point[1] > _WARM_UP_STEPS]
    stretch = max(1, len(points) // 10)
    ends = list(zip(points[::stretch], points[stretch::stretch], strict=False))
    return median((n1 - n0) / (t1 - t0) for (t0, n0), (t1, n1) in ends)


def bench_start(map_name: str, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Run `liir train` until all its actors have joined, while it learns; by the times in the learner's log.

    Raises:
        LiirError: the training ended too early.
    """
    chosen = (f"env.map={map_name}", _ENDLESS, *settings)
    actors = config.load(None, chosen).actors.count
    with run_directory() as run_dir, training(run_dir, *chosen) as run:
        last = run.event("actor joined", actors=actors)
        return {
            "map": map_name,
            "actors": last["actors"],
            "serving_s": run.event("serving")["time"] - run.begin,
            "first_actor_s": run.event("actor joined")["time"] - run.begin,
            "all_actors_s": last["time"] - run.begin,
        }


@dataclass(frozen=True)
class _Death:
    """What came of an actor's death."""

    tickets: int
    """It held so many, which went to others."""
    noticed_s: float
    played_again_s: float


def bench_death(map_name: str, deaths: int, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Kill one actor of a running training after the other: how long until its tickets are played again.

    Each is stopped first, until the training waits for nothing but the tickets that it holds. The time is
    from its SIGKILL until the learner has the batch that they are part of; that they went to others, and how
    many, is in the learner's log. The fleet is complete again before the next one dies.

    Raises:
        LiirError: the training ended too early.
    """
    chosen = (f"env.map={map_name}", _ENDLESS, *settings)
    actors = config.load(None, chosen).actors.count
    seen: list[_Death] = []
    with run_directory() as run_dir, training(run_dir, *chosen) as run:
        run.event("serving")
        with TrainingClient(run.address) as client, refusals_explained():
            while len(seen) < deaths:
                run.wait(lambda: client.status().actors == actors)
                death = _kill_an_actor(run, client)
                if death.tickets:  # else the machine was so busy that the training waited for another one
                    seen.append(death)
    return {
        "map": map_name,
        "actors": actors,
        "deaths": len(seen),
        "tickets": sum(death.tickets for death in seen),
        "noticed_s": median(death.noticed_s for death in seen),
        "played_again_s": median(death.played_again_s for death in seen),
        "slowest_s": max(death.played_again_s for death in seen),
    }


def _kill_an_actor(run: Training, client: TrainingClient) -> _Death:
    victim = run.processes(_ACTOR)[0]
    victim.suspend()
    try:
        run.wait(lambda: _stalled(client))
    finally:
        killed = time.time()
        with suppress(psutil.NoSuchProcess):  # it went with a training that failed
            victim.kill()
    left = run.event("actor left", after=killed)
    step = run.step_after(killed)
    # A row is written when its update is over, which has nothing to do with the death.
    whole = float(step["time"]) - float(step["update_s"])
    return _Death(left["tickets_to_others"], left["time"] - killed, whole - killed)


def _stalled(client: TrainingClient) -> bool:
    """Whether the learner waits for a batch and nothing of it comes in."""
    before = client.status()
    time.sleep(_STALL_S)
    after = client.status()
    return (
        after.phase == training_pb2.PHASE_COLLECTING
        and after.learner_step == before.learner_step
        and after.tickets_outstanding == before.tickets_outstanding > 0
    )


def bench_resume(map_name: str, episodes: int, repeats: int, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Fill a QMIX replay of `episodes`, stop, and resume: from each command to its first learner step.

    A resumed run is asked to end after that step, and the next goes on from there.

    Raises:
        LiirError: a training ended too early.
    """
    method = ("algorithm.name=qmix", f"algorithm.replay.episodes={episodes}")
    seconds, restored = [], []
    with run_directory() as run_dir:
        with training(run_dir, f"env.map={map_name}", *method, _ENDLESS, *settings) as run:
            run.wait(lambda: run.newest("episodes") >= episodes)
        for _ in range(repeats):
            with training(run_dir) as run:
                seconds.append(float(run.step_after(run.begin)["time"]) - run.begin)
                restored.append(run.event("resumed")["episodes"])
    return {
        "map": map_name,
        "replay_episodes": min(episodes, *restored),
        "resumes": len(seconds),
        "first_learner_step_s": median(seconds),
        "slowest_s": max(seconds),
    }
