"""`liir bench`: how fast everything is."""

from __future__ import annotations

import importlib
from typing import Annotated

import typer

from liir_common import options
from liir_common.cli.shared import Json, Map, print_result

bench = typer.Typer(no_args_is_help=True, help="Measure speed on this machine; medians.")


@bench.callback()
def _log_to_stderr() -> None:
    """What is measured logs; stdout is for the result."""
    from liir_common import logs

    logs.configure("bench")


@bench.command("sim")
def bench_sim_command(
    map_name: Map = "3m",
    compile_too: Annotated[
        bool, typer.Option("--compile", help="Also how long compiling takes, and loading what is compiled.")
    ] = False,
    as_json: Json = False,
) -> None:
    """The simulator alone: uniformly random actions, with observations, states, masks and resets."""
    from liir_common.battle.bench import bench_compile, bench_sim

    print_result(bench_sim(map_name) | (bench_compile(map_name) if compile_too else {}), as_json)


@bench.command("rollout")
def bench_rollout_command(map_name: Map = "3m", as_json: Json = False) -> None:
    """Whole episodes: simulator, policy and sampling."""
    from liir_common.config import EnvConfig
    from liir_common.rollout.bench import bench_rollout

    print_result(bench_rollout(EnvConfig(map=map_name)), as_json)


@bench.command("learner")
def bench_learner_command(
    map_name: Map = "3m",
    algorithm: Annotated[str, typer.Option(help="Name of the method.")] = "liir",
    steps: Annotated[int, typer.Option(min=2, help="Mean length of the episodes.")] = 25,
    settings: options.Settings = None,
    as_json: Json = False,
) -> None:
    """Learner steps on synthetic batches, against the time of their matrix products alone."""
    from liir_common import config
    from liir_common.rollout.play import env_spec

    chosen = config.load(None, [f"env.map={map_name}", f"algorithm.name={algorithm}", *(settings or ())])
    bench_learner = importlib.import_module("services.learner.bench").bench_learner
    print_result(bench_learner(chosen.algorithm, env_spec(chosen.env), steps=steps), as_json)


@bench.command("wire")
def bench_wire_command(
    map_name: Map = "3m", streams: Annotated[int, typer.Option(min=1)] = 4, as_json: Json = False
) -> None:
    """Episodes from local streams into the learner, without playing or learning."""
    bench_wire = importlib.import_module("services.learner.bench_wire").bench_wire
    print_result(bench_wire(map_name, streams), as_json)


@bench.command("policy")
def bench_policy_command(
    map_name: Map = "3m", streams: Annotated[int, typer.Option(min=1)] = 32, as_json: Json = False
) -> None:
    """How soon a new policy is with all actors."""
    bench_policy = importlib.import_module("services.learner.bench_wire").bench_policy
    print_result(bench_policy(map_name, streams), as_json)


@bench.command("beside")
def bench_beside_command(
    map_name: Map = "3m",
    rate: Annotated[float, typer.Option(min=1, help="Episodes per second.")] = 300.0,
    as_json: Json = False,
) -> None:
    """What learner steps lose to episodes that come in meanwhile."""
    bench_beside = importlib.import_module("services.learner.bench_wire").bench_beside
    print_result(bench_beside(map_name, rate), as_json)


@bench.command("train")
def bench_train_command(
    map_name: Map = "3m",
    env_steps: Annotated[int, typer.Option(min=1000)] = 300_000,
    settings: options.Settings = None,
    as_json: Json = False,
) -> None:
    """The whole service, from the command to the last step."""
    from liir_common.bench import bench_train

    print_result(bench_train(map_name, env_steps, settings or ()), as_json)


@bench.command("start")
def bench_start_command(
    map_name: Map = "3m", settings: options.Settings = None, as_json: Json = False
) -> None:
    """The whole service, from the command until all actors (`actors.count`) are there."""
    from liir_common.bench import bench_start

    print_result(bench_start(map_name, settings or ()), as_json)


@bench.command("death")
def bench_death_command(
    map_name: Map = "3m",
    deaths: Annotated[int, typer.Option(min=1)] = 5,
    settings: options.Settings = None,
    as_json: Json = False,
) -> None:
    """From an actor's death in a running training until the tickets that it held are played again."""
    from liir_common.bench import bench_death

    print_result(bench_death(map_name, deaths, settings or ()), as_json)


@bench.command("resume")
def bench_resume_command(
    map_name: Map = "3m",
    episodes: Annotated[int, typer.Option(min=1, help="Size of the replay, full when resumed.")] = 5000,
    repeats: Annotated[int, typer.Option(min=1, help="How often to resume.")] = 3,
    settings: options.Settings = None,
    as_json: Json = False,
) -> None:
    """From `liir train --resume` to the first learner step, with a replay to load."""
    from liir_common.bench import bench_resume

    print_result(bench_resume(map_name, episodes, repeats, settings or ()), as_json)
