"""`liir …`: every command; what is heavy is imported inside the command that needs it."""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from liir_common import options
from liir_common.errors import ConfigError, exit_on_error

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)
checkpoints = typer.Typer(no_args_is_help=True, help="Frozen checkpoints of a running learner.")
bench = typer.Typer(no_args_is_help=True, help="Measure speed; medians of CPU time on this machine.")
app.add_typer(checkpoints, name="checkpoints")
app.add_typer(bench, name="bench")

Map = Annotated[str, typer.Option("--map", help="Battle map.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
_PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def main() -> None:
    """Entry point of the `liir` command."""
    with exit_on_error():
        app()


@app.command()
def train(
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
) -> None:
    """Train on this machine: a learner, Ray actors and an evaluator, until the run is complete."""
    from liir_common import logs
    from liir_common.launch import Launcher

    logs.configure("train")
    path = run_dir or (_newest_run() if resume else None)
    resolved = options.load_run_config(config, settings, path, resume)
    path = path or Path("runs") / _run_name(resolved.env.map, resolved.algorithm.name, resolved.seed)
    arguments = [] if config is None or resume else ["--config", str(config)]
    arguments += [part for setting in settings or () for part in ("--set", setting)]
    launcher = Launcher(path, arguments, resume)
    summary = launcher.run(resolved.evaluation.enabled)
    _print_summary(path, summary)
    if launcher.stop_signal:
        print(f"stopped early; go on with: liir train --resume --run-dir {path}", file=sys.stderr)
        raise SystemExit(128 + launcher.stop_signal)


def _run_name(map_name: str, algorithm: str, seed: int) -> str:
    return f"{map_name}-{algorithm}-seed{seed}-{time.strftime('%Y%m%d-%H%M%S')}"


def _newest_run() -> Path:
    runs = sorted(Path("runs").glob("*/run.json"), key=lambda path: path.stat().st_mtime)
    if not runs:
        raise ConfigError("there is no run under runs/ to resume; name one with --run-dir")
    return runs[-1].parent


def _print_summary(run_dir: Path, summary: Any) -> None:
    from dataclasses import asdict

    print(f"\n{run_dir}")
    for name, value in asdict(summary).items():
        print(f"  {name.replace('_', ' '):30} {'–' if value is None else value}")
    if summary.evaluations:
        print(f"  curve: {run_dir / 'winrate.png'}")


def _run_service(name: str, context: typer.Context) -> None:
    import runpy

    sys.argv = [f"liir {context.command.name}", *context.args]
    # By name, not by import: the common package must not depend on the services.
    runpy.run_module(f"services.{name}", run_name="__main__")


@app.command(context_settings=_PASS_ON)
def learner(context: typer.Context) -> None:
    """Run the learner alone."""
    _run_service("learner", context)


@app.command(context_settings=_PASS_ON)
def actors(context: typer.Context) -> None:
    """Run the actor driver and its Ray actors alone."""
    _run_service("actor", context)


@app.command(context_settings=_PASS_ON)
def evaluator(context: typer.Context) -> None:
    """Run the evaluator alone."""
    _run_service("evaluator", context)


@app.command()
def status(learner: options.Learner) -> None:
    """Say how far a run is, as JSON."""
    from google.protobuf.json_format import MessageToJson

    from liir_common.client import TrainingClient

    with TrainingClient(learner, timeout_s=10) as client:
        print(MessageToJson(client.status()))


@app.command()
def stop(learner: options.Learner, reason: str = "asked on the command line") -> None:
    """Ask a learner to finish its step, save and end."""
    from liir_common.client import TrainingClient

    with TrainingClient(learner, timeout_s=10) as client:
        client.stop(reason)


@checkpoints.command("list")
def list_checkpoints(learner: options.Learner) -> None:
    """One line per checkpoint: episode, environment steps, policy version, size, SHA-256."""
    from liir_common.client import CheckpointClient

    with CheckpointClient(learner, timeout_s=10) as client:
        for frozen in client.list():
            print(_line(frozen))


@checkpoints.command("watch")
def watch_checkpoints(learner: options.Learner, after: int = 0) -> None:
    """The same lines as they come, until the run is complete."""
    from liir_common.client import CheckpointClient

    with CheckpointClient(learner, timeout_s=10) as client:
        for frozen in client.watch(after):
            print(_line(frozen), flush=True)


@checkpoints.command("get")
def get_checkpoint(
    episode: int,
    learner: options.Learner,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.")] = Path(),
) -> None:
    """Download a checkpoint: its weights (safetensors) and its manifest (JSON), checked."""
    from liir_common.client import CheckpointClient
    from liir_common.files import write_atomic

    with CheckpointClient(learner, timeout_s=10) as client:
        manifest, data = client.download(episode)
    output.mkdir(parents=True, exist_ok=True)
    stem = output / f"checkpoint-{episode:09d}"
    write_atomic(stem.with_suffix(".safetensors"), data)
    write_atomic(stem.with_suffix(".json"), manifest.to_json().encode())
    print(stem.with_suffix(".safetensors"))


def _line(frozen: Any) -> str:
    return (
        f"{frozen.episode:>9} {frozen.env_steps:>10} {frozen.policy_version:>7} "
        f"{frozen.size_bytes:>8} {frozen.sha256}"
    )


@app.command()
def report(
    run_dirs: list[Path],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for runs.csv, curves.csv and one curve.")
    ] = None,
) -> None:
    """Write summary.json and winrate.png of each run again; with -o, gather the runs as results."""
    from liir_common.report import write_report, write_results

    for run_dir in run_dirs:
        if not (run_dir / "run.json").exists():
            raise ConfigError(f"{run_dir} holds no run")
        _print_summary(run_dir, write_report(run_dir))
    if output is not None:
        write_results(run_dirs, output)


@app.command()
def replay(
    checkpoint: Annotated[
        Path | None, typer.Option("--checkpoint", help="Checkpoint file, its manifest beside it.")
    ] = None,
    run_dir: Annotated[
        Path | None, typer.Option("--run-dir", help="Run directory; its latest checkpoint plays.")
    ] = None,
    best: Annotated[bool, typer.Option("--best", help="With --run-dir: the one with most wins.")] = False,
    map_name: Annotated[
        str | None, typer.Option("--map", help="Battle map; that of the training if absent.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the battle.")] = 0,
    sampled: Annotated[bool, typer.Option("--sampled", help="Draw actions from the policy.")] = False,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=".html to explore; .gif or .mp4 to watch.")
    ] = Path("battle.html"),
) -> None:
    """Show one battle of a frozen policy, with its probabilities and the intrinsic reward it learned."""
    from liir_common.replay.load import find_checkpoint, load_checkpoint
    from liir_common.replay.record import record
    from liir_common.replay.write import check_output, write
    from liir_common.types import Exploration

    check_output(output)
    manifest, tensors = load_checkpoint(find_checkpoint(checkpoint, run_dir, best))
    exploration = Exploration.SOFTMAX_FLOOR if sampled else Exploration.GREEDY
    recording = record(manifest, tensors, seed, exploration, map_name)
    write(recording, output)
    trajectory = recording.trajectory
    result = "won" if trajectory.info["won"] else "not won"
    print(f"{output}: {recording.map_name}, {result} after {trajectory.length} steps")


@app.command()
def calibrate(
    map_name: Annotated[
        str | None, typer.Option("--map", help="One map; all with targets if absent.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1)] = 2000,
    as_json: Json = False,
) -> None:
    """Compare the simulator with what is published about SMAC v1 on StarCraft II."""
    from dataclasses import asdict

    from liir_common.battle.calibrate import TARGETS, format_rows
    from liir_common.battle.calibrate import calibrate as measure

    try:
        tables = {name: measure(name, episodes) for name in ([map_name] if map_name else TARGETS)}
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if as_json:
        rows = {
            name: [
                asdict(row.target) | {"measured": row.measured, "difference": row.difference} for row in table
            ]
            for name, table in tables.items()
        }
        print(json.dumps(rows))
    else:
        print("\n".join(format_rows(name, table) for name, table in tables.items()))


@bench.command("sim")
def bench_sim_command(map_name: Map = "3m", as_json: Json = False) -> None:
    """The simulator alone: uniformly random actions, with observations, states, masks and resets."""
    from liir_common.battle.bench import bench_sim

    _print_result(bench_sim(map_name), as_json)


@bench.command("rollout")
def bench_rollout_command(map_name: Map = "3m", as_json: Json = False) -> None:
    """Whole episodes: simulator, policy and sampling."""
    from liir_common.config import EnvConfig
    from liir_common.rollout.bench import bench_rollout

    _print_result(bench_rollout(EnvConfig(map=map_name)), as_json)


@bench.command("learner")
def bench_learner_command(
    map_name: Map = "3m",
    algorithm: Annotated[str, typer.Option(help="liir or central_v.")] = "liir",
    steps: Annotated[int, typer.Option(min=2, help="Mean length of the episodes.")] = 25,
    settings: options.Settings = None,
    as_json: Json = False,
) -> None:
    """Learner steps on synthetic batches, against the time of their matrix products alone."""
    from liir_common import config
    from liir_common.rollout.play import env_spec

    chosen = config.load(None, [f"env.map={map_name}", f"algorithm.name={algorithm}", *(settings or ())])
    bench_learner = importlib.import_module("services.learner.bench").bench_learner
    _print_result(bench_learner(chosen.algorithm, env_spec(chosen.env), steps=steps), as_json)


@bench.command("wire")
def bench_wire_command(
    map_name: Map = "3m", streams: Annotated[int, typer.Option(min=1)] = 4, as_json: Json = False
) -> None:
    """Episodes from local streams into the learner, without playing or learning."""
    bench_wire = importlib.import_module("services.learner.bench_wire").bench_wire
    _print_result(bench_wire(map_name, streams), as_json)


@bench.command("train")
def bench_train_command(
    map_name: Map = "3m",
    env_steps: Annotated[int, typer.Option(min=1000)] = 300_000,
    settings: options.Settings = None,
    as_json: Json = False,
) -> None:
    """The whole service, from the command to the last step."""
    from liir_common.bench import bench_train

    _print_result(bench_train(map_name, env_steps, settings or ()), as_json)


def _print_result(result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        if isinstance(value, dict):
            for key, inner in value.items():
                _print_result({f"{name} {key} {k}": v for k, v in inner.items()}, as_json=False)
        else:
            print(f"{name:32} {value:,.4g}" if isinstance(value, float) else f"{name:32} {value}")


if __name__ == "__main__":
    main()
