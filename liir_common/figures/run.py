"""What a figure reads of a trained run: a checkpoint, and its test episodes played once more."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from liir_common import seeds
from liir_common.battle.env import parallel_env
from liir_common.battle.snapshots import UnitRecord
from liir_common.checkpoint import CheckpointStore, section, unpack
from liir_common.config import Config, from_tree
from liir_common.errors import ConfigError
from liir_common.intrinsic import IntrinsicReward
from liir_common.rollout.play import make_player
from liir_common.types import EnvSpec, Exploration, FloatArray, Ticket, Trajectory, Weights

MODES = {"greedy": Exploration.GREEDY, "sampled": Exploration.SOFTMAX_FLOOR}


@dataclass(frozen=True)
class Frozen:
    """One checkpoint of a run."""

    run: str
    """Name of the run directory"""
    episode: int
    commit: str
    sha256: str
    config: Config
    spec: EnvSpec
    policy: Weights
    r_in: IntrinsicReward

    def evaluation_seed(self, index: int) -> int:
        """Of the evaluator's test episode of that index."""
        return seeds.evaluation_seed(self.config.seed, self.episode, index)

    def about(self) -> dict[str, object]:
        """What a figure says about where it is from."""
        return {"run": self.run, "checkpoint": self.episode, "commit": self.commit, "sha256": self.sha256}


def load(run_dir: Path, episode: int | None = None) -> Frozen:
    """The checkpoint of `episode`, or the newest, of a run whose method has an intrinsic reward.

    Raises:
        ConfigError: there is no run, no such checkpoint or no intrinsic reward.
    """
    if not (run_dir / "run.json").exists():
        raise ConfigError(f"{run_dir} holds no run")
    store = CheckpointStore(str(run_dir / "checkpoints"))
    episodes = [manifest.episode for manifest in store.manifests]
    if not episodes or episode not in (None, *episodes):
        there = f"{episodes[0]} to {episodes[-1]}" if episodes else "none"
        raise ConfigError(
            f"{run_dir} has no checkpoint {'' if episode is None else episode} (there: {there})"
        )
    manifest = store.manifests[-1] if episode is None else store.find(episode)
    tensors = unpack(store.read(manifest), manifest.sha256)
    return Frozen(
        run_dir.name,
        manifest.episode,
        manifest.git_commit,
        manifest.sha256,
        from_tree(manifest.config),
        manifest.spec,
        section(tensors, "policy"),
        IntrinsicReward.from_checkpoint(manifest, tensors),
    )


def play(frozen: Frozen, indices: range, mode: str, epsilon: float = 0.0) -> Iterator[Trajectory]:
    """The evaluator's test episodes of that checkpoint, by index; with `epsilon` 1 all actions are random.

    Raises:
        ConfigError: this build plays another game than the run did.
    """
    player = make_player(frozen.config.env, frozen.config.algorithm.policy_hidden)
    if player.spec.hash != frozen.spec.hash:
        raise ConfigError(
            f"{frozen.run} was trained on {frozen.spec}, this build plays {player.spec}; use the build that "
            "trained it"
        )
    player.load(frozen.policy)
    for index in indices:
        yield player.play(Ticket(index, 0, frozen.evaluation_seed(index), MODES[mode], epsilon))


def taken(r_in: FloatArray, trajectory: Trajectory) -> FloatArray:
    """[T, n], of r_in [T, n, A] that of the actions taken; NaN for the dead."""
    actions = trajectory.actions[..., None].astype(np.int64)
    values = np.take_along_axis(r_in, actions, -1)[..., 0]
    return np.where(trajectory.alive[:-1], values, np.float32(np.nan))


@dataclass(frozen=True)
class Battle:
    """One test battle."""

    trajectory: Trajectory
    units: list[list[UnitRecord]]
    """The units before each step and after the last, T + 1 times"""
    r_in: FloatArray
    """[T, n, A]"""


def battles(frozen: Frozen, indices: range, mode: str) -> Iterator[Battle]:
    """Test battles with the units' whereabouts, which trajectories lack.

    Raises:
        ConfigError: the run plays no battle, or another build's.
    """
    if frozen.config.env.kind != "battle":
        raise ConfigError(f"{frozen.run} plays {frozen.spec.name}; this figure wants a run on a battle map")
    options: dict[str, Any] = dict(frozen.config.env.options)
    env = parallel_env(frozen.config.env.map, **options)
    for trajectory in play(frozen, indices, mode):
        env.reset(seed=frozen.evaluation_seed(trajectory.episode_id))
        units = [env.snapshot()]
        for actions in trajectory.actions:
            env.step(dict(zip(env.agents, actions, strict=True)))
            units.append(env.snapshot())
        # The same seed and actions are the same battle: else the pictures would show another one.
        assert np.array_equal(env.state(), trajectory.state[-1])
        yield Battle(trajectory, units, frozen.r_in(trajectory.obs[:-1]))
