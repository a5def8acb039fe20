"""`liir sweep`, `figure`, `report` and `replay`: many runs, and what they learned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from liir_common import options
from liir_common.cli.shared import Output, by_map, names, numbers, written
from liir_common.errors import ConfigError

app = typer.Typer()
figure = typer.Typer(no_args_is_help=True, help="Draw the paper's figures from trained runs.")
app.add_typer(figure, name="figure")

Trained = Annotated[Path, typer.Option("--run-dir", help="Run directory to read.")]
Checkpoint = Annotated[int | None, typer.Option("--checkpoint", help="Its episode; the newest if absent.")]


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

    runs = plan(file, names(methods), names(maps), numbers(seeds), settings or ())
    _sweep(runs, output or Path("runs") / file.stem, jobs)


def _sweep(runs: Any, folder: Path, jobs: int) -> None:
    """Run the runs and end the process with the first exit code that is not 0."""
    from liir_common.sweep import Sweep

    with written(folder):
        outcomes = Sweep(runs, folder).run(jobs)
    for outcome in outcomes:
        print(f"{outcome.status:9} {outcome.name}" + (f"  {outcome.log}" if outcome.failed else ""))
    print(f"{sum(not o.failed for o in outcomes)} of {len(runs)} runs complete; {folder / 'results.csv'}")
    codes = [outcome.exit_code for outcome in outcomes if outcome.failed]
    if codes or len(outcomes) < len(runs):
        raise SystemExit(next(filter(None, codes), 1))


@app.command()
def report(
    run_dirs: list[Path],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for runs.csv, results.csv and their curves.")
    ] = None,
) -> None:
    """Write summary.json and winrate.png of each run again; with -o, gather the runs as results."""
    from liir_common.report import print_summary, write_report, write_results

    for run_dir in run_dirs:
        if not (run_dir / "run.json").exists():
            raise ConfigError(f"{run_dir} holds no run")
        print_summary(run_dir, write_report(run_dir))
    if output is not None:
        with written(output):
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
    with written(output):
        write(recording, output)
    trajectory = recording.trajectory
    result = "won" if trajectory.info["won"] else "not won"
    print(f"{output}: {recording.map_name}, {result} after {trajectory.length} steps")


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

    runs = plan(file, seeds=numbers(seeds), settings=settings or ())
    _sweep(runs, output, jobs)
    with written(output):
        methods = write_figure(runs, output, output)["methods"]
    for method, found in methods.items():
        for policy, auc in found["auc"].items():
            print(f"{method:10} AUC on actions of the {policy:8} policy: " + _of(auc))
    print(output / "figure2.png")


def _of(figures: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.3f}" for name, value in figures.items())


@figure.command("3")
def figure_3(
    sources: Annotated[list[Path], typer.Argument(help="Results files of sweeps, or run directories.")],
    lowest_from: Annotated[
        str,
        typer.Option(
            "--from", help="MAP=STEPS,…: tabulate also the lowest level from these environment steps on."
        ),
    ] = "",
    output: Output = Path(),
) -> None:
    """Win rate against environment steps, a panel per map, and tables of means over seeds and of runs."""
    from liir_common.figures.curves import write_figure
    from liir_common.results import read_curves

    steps = by_map(lowest_from)
    curves = read_curves(sources)
    if unknown := steps.keys() - {curve.map for curve in curves}:
        raise ConfigError(f"--from names {', '.join(sorted(unknown))}, of which there is no run")
    with written(output):
        print(write_figure(curves, output, steps), end="")
    print(output / "figure3.png")


def _battle_figure(
    name: str, run_dir: Path, checkpoint: int | None, episode: int, marks: str, sampled: bool, output: Path
) -> None:
    from liir_common.figures.intrinsic import write_figure
    from liir_common.figures.run import load

    mode = "sampled" if sampled else "greedy"
    run = load(run_dir, checkpoint)
    with written(output):
        figures = write_figure(run, name, output, episode, mode, numbers(marks))
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
    run = load(run_dir, checkpoint)
    with written(output):
        print(describe(write_figure(run, output, episodes, mode)), end="")
