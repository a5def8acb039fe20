"""`liir checkpoints` and `liir export`: frozen policies, for others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from liir_common import options
from liir_common.cli.shared import Output, written
from liir_common.errors import ConfigError

if TYPE_CHECKING:
    from liir_common.client import CheckpointClient

app = typer.Typer()
checkpoints = typer.Typer(no_args_is_help=True, help="Frozen checkpoints of a running learner.")
app.add_typer(checkpoints, name="checkpoints")

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
    after: Annotated[int, typer.Option(min=0, help="Episode to go on after.")] = 0,
    map_name: OnMap = "",
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """The same lines as they come, until the learner is done: one that stays never is."""
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
    with _checkpoints(learner, map_name, config, settings) as client, written(output):
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
            with written(output):
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
    graph = to_onnx(*load_checkpoint(checkpoint))
    with written(output):
        write_atomic(output, graph)
    print(output)
