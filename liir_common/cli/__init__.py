"""`liir …`: every command; what is heavy is imported inside the command that needs it."""

from __future__ import annotations

import warnings

import typer

from liir_common.cli import battle, bench, checkpoints, experiments, run
from liir_common.errors import exit_on_error

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)
for module in (run, checkpoints, experiments, battle):
    app.add_typer(module.app)
app.add_typer(bench.bench, name="bench")


def main() -> None:
    """Entry point of the `liir` command."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    with exit_on_error():
        app()
