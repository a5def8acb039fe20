"""`liir …`: every command; what is heavy is imported inside the command that needs it."""

from __future__ import annotations

import importlib
import json
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from liir_common import options
from liir_common.errors import ConfigError, UnreachableError, exit_on_error

if TYPE_CHECKING:
    from liir_common.client import CheckpointClient

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)
checkpoints = typer.Typer(no_args_is_help=True, help="Frozen checkpoints of a running learner.")
figure = typer.Typer(no_args_is_help=True, help="Draw the paper's figures from trained runs.")
bench = typer.Typer(no_args_is_help=True, help="Measure speed; medians of CPU time on this machine.")
app.add_typer(checkpoints, name="checkpoints")
app.add_typer(figure, name="figure")
app.add_typer(bench, name="bench")

Map = Annotated[str, typer.Option("--map", help="Battle map.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.")]
Trained = Annotated[Path, typer.Option("--run-dir", help="Run directory to read.")]
Checkpoint = Annotated[int | None, typer.Option("--checkpoint", help="Its episode; the newest if absent.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
_PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def main() -> None:
    """Entry point of the `liir` command."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
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
    from liir_common import launch, logs

    logs.configure("train")
    launch.train("liir train", launch.local, config, settings or (), run_dir, resume)


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
def status(
    learner: options.Learner, config: options.ConfigFile = None, settings: options.Settings = None
) -> None:
    """Say how far a run is, as JSON."""
    from google.protobuf.json_format import MessageToJson

    from liir_common.client import TrainingClient, refusals_explained

    security = options.load_security(config, settings)
    with TrainingClient(learner, 10, security) as client, refusals_explained():
        print(MessageToJson(client.status()))


@app.command()
def health(
    learner: options.Learner, config: options.ConfigFile = None, settings: options.Settings = None
) -> None:
    """Exit with 0 if a learner serves, with 3 if it does not; for health checks."""
    from liir_common.client import TrainingClient
    from liir_common.rpc.tokens import Role

    security = options.load_security(config, settings)
    with TrainingClient(learner, 3, security, Role.READER) as client:
        if not client.serving():
            raise UnreachableError(f"the learner at {learner} is leaving")


@app.command()
def stop(
    learner: options.Learner,
    reason: str = "asked on the command line",
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """Ask a learner to finish its step, save and end."""
    from liir_common.client import TrainingClient, refusals_explained
    from liir_common.rpc.tokens import Role

    security = options.load_security(config, settings)
    with TrainingClient(learner, 10, security, Role.OPERATOR) as client, refusals_explained():
        client.stop(reason)


OnMap = Annotated[str, typer.Option("--map", help="End with an error if the run is not on this map.")]


@contextmanager
def _checkpoints(
    learner: str, map_name: str, config: Path | None, settings: list[str] | None
) -> Iterator[CheckpointClient]:
    """A client of the learner, which trains on the map if one is named."""
    from liir_common.client import CheckpointClient, learners_config, refusals_explained
    from liir_common.rpc.tokens import Role

    security = options.load_security(config, settings)
    if map_name:
        label = learners_config(learner, (), security, Role.READER).env.label
        if label != map_name:
            raise ConfigError(f"wanted a run on {map_name}; the learner at {learner} trains on {label}")
    with CheckpointClient(learner, 10, security) as client, refusals_explained():
        yield client


@checkpoints.command("list")
def list_checkpoints(
    learner: options.Learner,
    map_name: OnMap = "",
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """One line per checkpoint: episode, environment steps, policy version, size, SHA-256."""
    with _checkpoints(learner, map_name, config, settings) as client:
        for frozen in client.list():
            print(_line(frozen))


@checkpoints.command("watch")
def watch_checkpoints(
    learner: options.Learner,
    after: int = 0,
    map_name: OnMap = "",
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """The same lines as they come, until the run is complete."""
    with _checkpoints(learner, map_name, config, settings) as client:
        for frozen in client.watch(after):
            print(_line(frozen), flush=True)


@checkpoints.command("get")
def get_checkpoint(
    episode: Annotated[int, typer.Argument(min=1)],
    learner: options.Learner,
    output: Output = Path(),
    map_name: OnMap = "",
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """Download a checkpoint: its weights (safetensors) and its manifest (JSON), checked; goes on if cut."""
    with _checkpoints(learner, map_name, config, settings) as client:
        print(client.save(episode, output))


@checkpoints.command("best")
def best_checkpoint(
    learner: options.Learner,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder to download it into.")] = None,
    map_name: OnMap = "",
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """The line of the checkpoint with most wins in its tests so far, and what it won."""
    with _checkpoints(learner, map_name, config, settings) as client:
        tested = client.best()
        wins = ", ".join(
            f"{mode} {stats.wins}/{stats.episodes}"
            for mode, stats in (("greedy", tested.greedy), ("sampled", tested.sampled))
        )
        print(f"{_line(client.find(tested.episode))}  won {wins}; return {tested.greedy.return_mean:.2f}")
        if output is not None:
            print(client.save(tested.episode, output))


def _line(frozen: Any) -> str:
    return (
        f"{frozen.episode:>9} {frozen.env_steps:>10} {frozen.policy_version:>7} "
        f"{frozen.size_bytes:>8} {frozen.sha256}"
    )


@app.command("export")
def export_policy(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint file, its manifest beside it.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.")] = Path("policy.onnx"),
) -> None:
    """Write a checkpoint's policy as an ONNX graph: one decision of a batch of teams."""
    from liir_common.export import to_onnx
    from liir_common.files import write_atomic
    from liir_common.replay.load import load_checkpoint

    if not output.parent.is_dir():
        raise ConfigError(f"{output.parent} is no folder; make it first")
    write_atomic(output, to_onnx(*load_checkpoint(checkpoint)))
    print(output)


@app.command()
def certs(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.")] = Path("certs"),
    hosts: Annotated[
        list[str] | None, typer.Option("--host", help="Name or address of the learner beside localhost.")
    ] = None,
) -> None:
    """Make a development CA and each role's certificate and token; again, renew the certificates."""
    from liir_common.certs import make_certs
    from liir_common.rpc.tokens import Role

    make_certs(output, hosts or ())
    print(f"security: {output}/learner")
    print(
        f"# clients elsewhere have the folder of their role: {', '.join(f'{output}/{role}' for role in Role)}"
    )


@app.command()
def report(
    run_dirs: list[Path],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for runs.csv, curves.csv and one curve.")
    ] = None,
) -> None:
    """Write summary.json and winrate.png of each run again; with -o, gather the runs as results."""
    from liir_common.report import print_summary, write_report, write_results

    for run_dir in run_dirs:
        if not (run_dir / "run.json").exists():
            raise ConfigError(f"{run_dir} holds no run")
        print_summary(run_dir, write_report(run_dir))
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
    sampled: Annotated[bool, typer.Option("--sampled", help="Draw actions, as sampled tests do.")] = False,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=".html to explore; .gif or .mp4 to watch.")
    ] = Path("battle.html"),
) -> None:
    """Show one battle of a frozen policy, with its probabilities and the intrinsic reward it learned."""
    from liir_common.replay.load import find_checkpoint, load_checkpoint
    from liir_common.replay.record import record
    from liir_common.replay.write import check_output, write

    check_output(output)
    manifest, tensors = load_checkpoint(find_checkpoint(checkpoint, run_dir, best))
    recording = record(manifest, tensors, seed, sampled, map_name)
    write(recording, output)
    trajectory = recording.trajectory
    result = "won" if trajectory.info["won"] else "not won"
    print(f"{output}: {recording.map_name}, {result} after {trajectory.length} steps")


@app.command()
def sweep(
    file: Annotated[Path, typer.Argument(help="YAML file with base, maps, methods and seeds.")],
    methods: Annotated[str, typer.Option(help="Only these, separated by commas.")] = "",
    maps: Annotated[str, typer.Option(help="Only these, separated by commas.")] = "",
    seeds: Annotated[str, typer.Option(help="These instead of the file's, separated by commas.")] = "",
    settings: options.Settings = None,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at once.")] = 1,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder of the runs; runs/FILE if absent.")
    ] = None,
) -> None:
    """Train methods on maps with seeds; the same command again completes the sweep."""
    from liir_common.sweep import plan

    runs = plan(file, _names(methods), _names(maps), _numbers(seeds), settings or ())
    _sweep(runs, output or Path("runs") / file.stem, jobs)


def _sweep(runs: Any, folder: Path, jobs: int) -> None:
    """Run the runs and end the process with the first exit code that is not 0."""
    from liir_common.sweep import Sweep

    outcomes = Sweep(runs, folder).run(jobs)
    for outcome in outcomes:
        print(f"{outcome.status:9} {outcome.name}" + (f"  {outcome.log}" if outcome.failed else ""))
    print(f"{sum(not o.failed for o in outcomes)} of {len(runs)} runs complete; {folder / 'results.csv'}")
    codes = [outcome.exit_code for outcome in outcomes if outcome.failed]
    if codes or len(outcomes) < len(runs):
        raise SystemExit(next(filter(None, codes), 1))


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _numbers(text: str) -> list[int]:
    try:
        return [int(name) for name in _names(text)]
    except ValueError:
        raise ConfigError(f"wanted whole numbers separated by commas, got {text!r}") from None


@figure.command("2")
def figure_2(
    file: Annotated[Path, typer.Argument(help="The sweep that trains the runs.")] = Path(
        "configs/figure2.yaml"
    ),
    seeds: Annotated[str, typer.Option(help="These instead of the file's, separated by commas.")] = "",
    settings: options.Settings = None,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at once.")] = 1,
    output: Output = Path("runs/figure2"),
) -> None:
    """r_in of good and bad actions in 1D Pursuit; trains what is not trained yet."""
    from liir_common.figures.pursuit import write_figure
    from liir_common.sweep import plan

    runs = plan(file, seeds=_numbers(seeds), settings=settings or ())
    _sweep(runs, output, jobs)
    for method, found in write_figure(runs, output, output)["methods"].items():
        for policy, auc in found["auc"].items():
            print(f"{method:10} AUC on actions of the {policy:8} policy: " + _of(auc))
    print(output / "figure2.png")


def _of(figures: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.3f}" for name, value in figures.items())


@figure.command("3")
def figure_3(
    sources: Annotated[list[Path], typer.Argument(help="Results files of sweeps, or run directories.")],
    output: Output = Path(),
) -> None:
    """Win rate against environment steps, a panel per map, and the table of final and best win rates."""
    from liir_common.figures.curves import markdown, write_figure
    from liir_common.results import read_curves

    print(markdown(write_figure(read_curves(sources), output)), end="")
    print(output / "figure3.png")


def _battle_figure(
    name: str, run_dir: Path, checkpoint: int | None, episode: int, marks: str, sampled: bool, output: Path
) -> None:
    from liir_common.figures.intrinsic import write_figure
    from liir_common.figures.run import load

    mode = "sampled" if sampled else "greedy"
    figures = write_figure(load(run_dir, checkpoint), name, output, episode, mode, _numbers(marks))
    for step, why in figures["marks"].items():
        print(f"step {step}: {why}")
    print(output / f"{name}.png")


Episode = Annotated[int, typer.Option(min=0, help="Number of the test battle.")]
Marks = Annotated[str, typer.Option(help="Steps to show, separated by commas; by rule if absent.")]
Sampled = Annotated[bool, typer.Option("--sampled", help="Draw actions from the policy; the best if absent.")]


@figure.command("4")
def figure_4(
    run_dir: Trained,
    checkpoint: Checkpoint = None,
    episode: Episode = 0,
    marks: Marks = "",
    sampled: Sampled = False,
    output: Output = Path(),
) -> None:
    """Each agent's r_in along a test battle (the paper's is on 3m)."""
    _battle_figure("figure4", run_dir, checkpoint, episode, marks, sampled, output)


@figure.command("5")
def figure_5(
    run_dir: Trained,
    checkpoint: Checkpoint = None,
    episode: Episode = 0,
    marks: Marks = "",
    sampled: Sampled = False,
    output: Output = Path(),
) -> None:
    """The same as figure 4 (the paper's is on 2s3z)."""
    _battle_figure("figure5", run_dir, checkpoint, episode, marks, sampled, output)


@figure.command("cosine")
def figure_cosine(
    run_dir: Trained,
    checkpoint: Checkpoint = None,
    episodes: Annotated[int, typer.Option(min=1)] = 100,
    sampled: Sampled = False,
    output: Output = Path(),
) -> None:
    """Cosine similarity of health and r_in of attacks at health below half (section 5.2.3)."""
    from liir_common.figures.cosine import describe, write_figure
    from liir_common.figures.run import load

    mode = "sampled" if sampled else "greedy"
    print(describe(write_figure(load(run_dir, checkpoint), output, episodes, mode)), end="")


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
    _print_result(bench_learner(chosen.algorithm, env_spec(chosen.env), steps=steps), as_json)


@bench.command("wire")
def bench_wire_command(
    map_name: Map = "3m", streams: Annotated[int, typer.Option(min=1)] = 4, as_json: Json = False
) -> None:
    """Episodes from local streams into the learner, without playing or learning."""
    bench_wire = importlib.import_module("services.learner.bench_wire").bench_wire
    _print_result(bench_wire(map_name, streams), as_json)


@bench.command("policy")
def bench_policy_command(
    map_name: Map = "3m", streams: Annotated[int, typer.Option(min=1)] = 32, as_json: Json = False
) -> None:
    """How soon a new policy is with all actors."""
    bench_policy = importlib.import_module("services.learner.bench_wire").bench_policy
    _print_result(bench_policy(map_name, streams), as_json)


@bench.command("beside")
def bench_beside_command(
    map_name: Map = "3m",
    rate: Annotated[float, typer.Option(min=1, help="Episodes per second.")] = 300.0,
    as_json: Json = False,
) -> None:
    """What learner steps lose to episodes that come in meanwhile."""
    bench_beside = importlib.import_module("services.learner.bench_wire").bench_beside
    _print_result(bench_beside(map_name, rate), as_json)


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


@app.command()
def maps(as_json: Json = False) -> None:
    """List the battle maps: who fights whom, the limit in steps, and what no source settles."""
    from liir_common.battle.scenarios import SCENARIOS, describe

    rows = [describe(scenario) for scenario in SCENARIOS.values()]
    if as_json:
        print(json.dumps(rows))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("map", "agents", "enemies", "actions", "limit", "terrain", "uncertain")
    for row in rows:
        sides = [_roll(row["agents"]), _roll(row["enemies"])]
        table.add_row(
            row["map"], *sides, str(row["n_actions"]), str(row["limit"]), row["terrain"], row["uncertain"]
        )
    Console().print(table)


def _roll(units: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in units.items())


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
