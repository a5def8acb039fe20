"""Checkpoints with random weights for tests of replays: real files, written as a learner writes them."""

from __future__ import annotations

import time
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

import numpy as np

from liir_common import checkpoint, config
from liir_common.checkpoint import CheckpointStore, Manifest
from liir_common.rollout.play import env_spec
from liir_common.rollout.policy import random_weights
from liir_common.types import Weights

HIDDEN, BOUND = 16, 2.0


def publish(run_dir: Path, episode: int = 100, map_name: str = "2s3z", method: str = "liir") -> Path:
    """Freeze a policy, and with method liir an intrinsic reward, in `run_dir`; returns the weights file."""
    settings = [f"env.map={map_name}", f"algorithm.name={method}", f"algorithm.r_in_bound={BOUND}"]
    settings.append(f"algorithm.policy_hidden={HIDDEN}")
    run = config.load(settings=settings)
    spec = env_spec(run.env)
    tensors = {f"policy.{name}": array for name, array in random_weights(spec, HIDDEN, episode).items()}
    if method == "liir":
        inputs = spec.obs_dim + spec.n_agents
        tensors |= {f"intrinsic.{name}": array for name, array in _mlp(inputs, spec.n_actions).items()}
    data = checkpoint.pack(tensors)
    manifest = Manifest(
        episode=episode,
        policy_version=3,
        env_steps=1000,
        run_id="</script><b>run",
        git_commit="abc",
        env_spec=asdict(spec),
        config=run.tree(),
        created=time.time(),
        sha256=sha256(data).hexdigest(),
        size_bytes=len(data),
    )
    CheckpointStore(str(run_dir / "checkpoints")).publish(manifest, data)
    return run_dir / "checkpoints" / f"checkpoint-{episode:09d}.safetensors"


def _mlp(inputs: int, outputs: int) -> Weights:
    random = np.random.default_rng(7)
    weights = {}
    for layer, (n_in, n_out) in enumerate(((inputs, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, outputs)), 1):
        weights[f"fc{layer}.weight"] = random.standard_normal((n_out, n_in)).astype(np.float32) / n_in**0.5
        weights[f"fc{layer}.bias"] = random.standard_normal(n_out).astype(np.float32)
    return weights
