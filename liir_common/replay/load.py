"""Find and read the checkpoint to show, from a file or from a run directory."""

from __future__ import annotations

import warnings
from pathlib import Path

from liir_common import checkpoint
from liir_common.battle.engine import SIMULATOR_VERSION
from liir_common.checkpoint import Manifest
from liir_common.errors import ConfigError
from liir_common.files import read_table
from liir_common.types import Weights


def load_checkpoint(path: Path) -> tuple[Manifest, Weights]:
    """The manifest and all tensors of the checkpoint whose .safetensors or .json file is `path`.

    Warns if it was trained on battles that another version of the simulator played.

    Raises:
        ConfigError: one of the two files cannot be read.
        CorruptError: they do not belong together, or are no checkpoint.
    """
    try:
        manifest = Manifest.from_json(path.with_suffix(".json").read_text(encoding="utf-8"))
        data = path.with_suffix(".safetensors").read_bytes()
    except OSError as error:
        raise ConfigError(
            f"a checkpoint is a .safetensors file with its .json beside it; cannot read {error.filename}: "
            f"{error.strerror}"
        ) from None
    tensors = checkpoint.unpack(data, manifest.sha256)
    _warn_of_another_simulator(manifest)
    return manifest, tensors


def _warn_of_another_simulator(manifest: Manifest) -> None:
    spec = manifest.spec
    if spec.name.startswith("battle/") and spec.version != SIMULATOR_VERSION:
        warnings.warn(
            f"checkpoint {manifest.episode} was trained with version {spec.version} of the battle simulator, "
            f"and version {SIMULATOR_VERSION} is installed: battles go differently from those of its "
            f"training and its tests; to see those, use the build of commit {manifest.git_commit}",
            stacklevel=3,
        )


def find_checkpoint(file: Path | None, run_dir: Path | None, best: bool = False) -> Path:
    """The file that a person named, or the latest or `best` checkpoint of the run directory named.

    Raises:
        ConfigError: not exactly one of the two was named, or the run has no such checkpoint.
    """
    if (file is None) == (run_dir is None):
        raise ConfigError("wanted either --checkpoint FILE or --run-dir DIRECTORY")
    if file is not None:
        if best:
            raise ConfigError("--best chooses among the checkpoints of a --run-dir, not for --checkpoint")
        return file
    assert run_dir is not None
    return _best(run_dir) if best else _latest(run_dir)


def _latest(run_dir: Path) -> Path:
    paths = sorted((run_dir / "checkpoints").glob("checkpoint-*.json"))
    if not paths:
        raise ConfigError(f"{run_dir} holds no checkpoint; name a run directory, or a file with --checkpoint")
    return paths[-1]


def _best(run_dir: Path) -> Path:
    """As `CheckpointClient.best`."""
    folder = run_dir / "checkpoints"
    tests = {
        folder / f"checkpoint-{int(t['episode']):09d}.json": t
        for t in read_table(run_dir / "evaluations.csv")
    }
    there = [path for path in tests if path.exists()]
    if not there:
        raise ConfigError(
            f"{run_dir} holds no tested checkpoint; leave out --best to take the latest checkpoint"
        )
    keys = ("greedy_win_rate", "sampled_win_rate", "greedy_return_mean", "episode")
    return max(there, key=lambda path: [float(tests[path][key]) for key in keys])
