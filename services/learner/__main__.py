"""`liir learner`: the learner process."""

import asyncio
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from liir_common import logs, options
from liir_common.config import holds_run
from liir_common.errors import exit_on_error, storage_explained
from liir_common.files import held
from liir_common.rollout.play import env_spec
from services.learner.run_directory import RunDirectory
from services.learner.service import serve


def learner(
    run_dir: Annotated[Path, typer.Option("--run-dir", help="Run directory.")] = Path("runs/learner"),
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    resume: options.Resume = False,
    resume_if_begun: options.ResumeIfBegun = False,
) -> None:
    """Train a run: serve tickets to actors, checkpoints to evaluators."""
    logs.configure("learner")
    resume = resume or (resume_if_begun and holds_run(run_dir))
    with exit_on_error():
        resolved = options.load_run_config(config, settings, run_dir, resume)
        spec = env_spec(resolved.env)
        with ExitStack() as stack:
            with storage_explained(run_dir):
                stack.enter_context(held(run_dir))
                run = RunDirectory(run_dir, resolved, spec)
            asyncio.run(serve(resolved, run, spec))


if __name__ == "__main__":
    options.run(learner)
