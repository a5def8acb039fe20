"""Run directories as a learner leaves them, with networks that nobody trained."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml

from liir_common import config
from liir_common.checkpoint import CheckpointStore, Manifest, pack
from liir_common.files import Table
from liir_common.rollout.play import env_spec
from liir_common.rollout.policy import random_weights

HIDDEN = 8
"""Width of the intrinsic reward."""


def make_run(path: Path, *settings: str, episodes: tuple[int, ...] = (100,)) -> Path:
    """A run with a checkpoint after each of `episodes`."""
    resolved = config.load(None, settings)
    spec = env_spec(resolved.env)
    store = CheckpointStore(str(path / "checkpoints"))
    (path / "run.json").write_text(json.dumps({"git": "abc"}))
    (path / "config.yaml").write_text(yaml.safe_dump(resolved.tree()))
    for episode in episodes:
        random = np.random.default_rng(episode)
        sizes = [spec.obs_dim + spec.n_agents, HIDDEN, HIDDEN, spec.n_actions]
        intrinsic = {}
        for layer in (1, 2, 3):
            shape = (sizes[layer], sizes[layer - 1])
            intrinsic[f"intrinsic.fc{layer}.weight"] = random.standard_normal(shape).astype(np.float32)
            intrinsic[f"intrinsic.fc{layer}.bias"] = np.zeros(sizes[layer], np.float32)
        policy = random_weights(spec, resolved.algorithm.policy_hidden, seed=episode)
        data = pack(intrinsic | {f"policy.{name}": array for name, array in policy.items()})
        manifest = Manifest(
            episode=episode,
            policy_version=3,
            env_steps=1000,
            run_id="run",
            git_commit="abc",
            env_spec=asdict(spec),
            config=resolved.tree(),
            created=1.0,
            sha256=hashlib.sha256(data).hexdigest(),
            size_bytes=len(data),
        )
        store.publish(manifest, data)
    return path


def add_evaluations(
    path: Path, wins: list[int], episodes: int = 20, spacing: int = 1000, sampled: list[int] | None = None
) -> Path:
    """Give a run `wins` of its test episodes at every 100th training episode, as many of `sampled` ones."""
    table = Table(path / "evaluations.csv")
    both = list(zip(wins, sampled or wins, strict=True))
    for index, pair in reversed(list(enumerate(both, start=1))):  # reports may come in any order
        row = {"episode": 100 * index, "env_steps": spacing * index, "policy_version": index}
        for mode, won in zip(("greedy", "sampled"), pair, strict=True):
            tested = {"episodes": episodes, "wins": won, "win_rate": won / episodes}
            row |= {f"{mode}_{key}": value for key, value in tested.items()}
        table.append(row)
    return path
