"""`liir train` and what starts, asks or stops its processes."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Annotated

import typer

from liir_common import options
from liir_common.cli.shared import written
from liir_common.errors import ConfigError, UnreachableError

app = typer.Typer()
_PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command()
def train(
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
) -> None:
    """Train on this machine: a learner, Ray actors and an evaluator, until the run is complete."""
    from liir_common import launch, logs

    if resume and config is not None:
        raise ConfigError(
            "--config begins a run, and --resume keeps the configuration it was begun with; leave one out"
        )
    logs.configure("train")
    launch.train("liir train", launch.local, config, settings or (), run_dir, resume)


def _run_service(name: str, context: typer.Context) -> None:
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
    from liir_common.client import TrainingClient, refusals_explained
    from liir_common.rpc.tokens import Role

    security = options.load_security(config, settings)
    with TrainingClient(learner, 3, security, Role.READER) as client, refusals_explained():
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


@app.command()
def backup(
    run_dir: Annotated[Path, typer.Option("--run-dir", help="Run directory; the run may go on meanwhile.")],
) -> None:
    """Write a run to standard output, as a tar.gz from which it can be resumed."""
    from liir_common.backup import back_up

    if sys.stdout.isatty():
        raise ConfigError("an archive is not for a terminal; send it on, as in `liir backup … > run.tar.gz`")
    with written(Path("standard output")):
        back_up(run_dir, sys.stdout.buffer)
        sys.stdout.flush()


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

    with written(output):
        make_certs(output, hosts or ())
    print(f"security: {output}/learner")
    print(
        f"# clients elsewhere have the folder of their role: {', '.join(f'{output}/{role}' for role in Role)}"
    )
