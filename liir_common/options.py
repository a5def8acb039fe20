"""Command-line options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from liir_common import config
from liir_common.config import Config, SecurityConfig
from liir_common.errors import ConfigError, CorruptError

ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file with the configuration.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="key.sub=value, stronger than file and environment.")
]
RunDir = Annotated[
    Path | None, typer.Option("--run-dir", help="Run directory; a new one under runs/ if absent.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with the run in the run directory.")]
ResumeIfBegun = Annotated[
    bool, typer.Option("--resume-if-begun", help="Resume a run that is there, or begin it; for supervisors.")
]
Learner = Annotated[str, typer.Option("--learner", help="HOST:PORT of the learner.")]


def run(command: Callable[..., None]) -> None:
    """Run a process's only command."""
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(command)
    app()


def load_security(file: Path | None, settings: list[str] | None) -> SecurityConfig:
    """The section `security` of a client of a learner: from the file, the environment and the settings.

    Raises:
        ConfigError: the configuration cannot be used.
    """
    return config.load(file, settings or ()).security


_MAY_CHANGE = (
    "actors",
    "checkpoints",
    "evaluation",
    "learner",
    "metrics",
    "security",
    "training.save_interval",
    "training.total_env_steps",
)
"""Where a run goes on, how far, and what is kept of it; what it learns stays as it began."""


def load_run_config(
    file: Path | None, settings: list[str] | None, run_dir: Path | None, resume: bool
) -> Config:
    """Configuration of a run: a resumed one keeps its own, with the settings laid over it.

    Raises:
        ConfigError: there is a run and `resume` is false, or the other way round, or the configuration
            cannot be used, or a resumed run would go on with what it did not begin with.
        CorruptError: the configuration that a run keeps is damaged.
    """
    if run_dir is not None:
        _check_run_dir(run_dir, resume)
    if not resume or run_dir is None:
        return config.load(file, settings or ())
    kept = _kept_tree(run_dir / "config.yaml")
    resumed = config.from_tree(config.merge(kept, config.parse_settings(settings or ())))
    _check_same_run(config.from_tree(kept), resumed, run_dir)
    return resumed


def _kept_tree(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError) as error:
        raise CorruptError(f"{path} is damaged ({error}); restore it from a backup") from error
    if not isinstance(tree, dict):
        raise CorruptError(f"{path} is damaged: wanted sections, got {tree!r}; restore it from a backup")
    return tree


def _check_same_run(kept: Config, resumed: Config, run_dir: Path) -> None:
    differ = config.differences(kept.tree(), resumed.tree())
    changed = [text for key, text in differ.items() if not key.startswith(_MAY_CHANGE)]
    if changed:
        raise ConfigError(
            f"{run_dir} was begun with other settings ({'; '.join(changed)}); a resumed run may change only "
            f"{', '.join(_MAY_CHANGE)}; leave the others out, or begin another run"
        )


def _check_run_dir(run_dir: Path, resume: bool) -> None:
    exists = config.holds_run(run_dir)
    if exists and not resume:
        raise ConfigError(f"{run_dir} holds a run already; go on with --resume, or name another --run-dir")
    if resume and not exists:
        raise ConfigError(f"{run_dir} holds no run to resume; leave out --resume to begin one there")
