"""The data every part of the service agrees on: what is played, what is sent, what is learned from.

Everything here is plain numpy and frozen; shapes use n agents, A actions, O observation values,
S state values, T steps of an episode and B episodes of a batch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liir_common import seeds

Array = NDArray[Any]
FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int16]
Weights = Mapping[str, FloatArray]
"""Named float32 parameters of a policy; `policy_shapes` has names and shapes."""


@dataclass(frozen=True)
class EnvSpec:
    """What an environment looks like from outside; both ends of a stream must agree on its hash."""

    name: str
    version: str
    """Version of the simulator: two builds with equal versions play the same episodes."""
    options: str
    """Canonical JSON of the options that the environment was made with."""
    n_agents: int
    n_actions: int
    obs_dim: int
    state_dim: int
    episode_limit: int
    info_keys: tuple[str, ...]
    """Names of the end-of-episode figures; a game that can be won has "won" (0 or 1) among them."""

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> EnvSpec:
        """The one whose fields came through JSON."""
        return cls(**{**fields, "info_keys": tuple(fields["info_keys"])})

    @property
    def hash(self) -> str:
        """SHA-256 of all fields, as hex."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def policy_shapes(spec: EnvSpec, hidden: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the policy FC - ReLU - GRU - FC with `hidden` units H.

    Its input is (observation, one-hot last action, one-hot agent id); gates are in torch's order r, z, n.
    """
    inputs = spec.obs_dim + spec.n_actions + spec.n_agents
    return {
        "fc1.weight": (hidden, inputs),
        "fc1.bias": (hidden,),
        "gru.weight_ih": (3 * hidden, hidden),
        "gru.weight_hh": (3 * hidden, hidden),
        "gru.bias_ih": (3 * hidden,),
        "gru.bias_hh": (3 * hidden,),
        "fc2.weight": (spec.n_actions, hidden),
        "fc2.bias": (spec.n_actions,),
    }


class Exploration(StrEnum):
    """How an action is chosen from the network's outputs."""

    SOFTMAX_FLOOR = "softmax_floor"
    """(1 - epsilon) * softmax + epsilon / available actions."""
    EPSILON_GREEDY = "epsilon_greedy"
    """The best available action, or with probability epsilon a uniformly random available one."""
    GREEDY = "greedy"
    """The best available action."""


@dataclass(frozen=True)
class Ticket:
    """The order for one episode; together with the weights it determines every byte of it."""

    episode_id: int
    policy_version: int
    seed: int
    """64-bit seed; `seeds.episode_seed(run seed, domain, episode id)` and nothing else."""
    exploration: Exploration
    epsilon: float

    @classmethod
    def for_training(
        cls, run_seed: int, episode_id: int, version: int, exploration: Exploration, epsilon: float
    ) -> Ticket:
        """Ticket of a training episode."""
        seed = seeds.episode_seed(run_seed, seeds.TRAINING, episode_id)
        return cls(episode_id, version, seed, exploration, epsilon)


@dataclass(frozen=True)
class Trajectory:
    """Everything one episode of T steps produced, padded nowhere.

    Arrays with T + 1 rows include the situation after the last step, which bootstrapping needs.
    """

    episode_id: int
    policy_version: int
    obs: FloatArray
    """[T+1, n, O]"""
    state: FloatArray
    """[T+1, S]"""
    mask: BoolArray
    """[T+1, n, A], true where an action is available"""
    alive: BoolArray
    """[T+1, n], from the environment, never derived from the mask"""
    actions: IntArray
    """[T, n]"""
    log_mu: FloatArray
    """[T, n], log of the behaviour policy's probability of the action taken"""
    reward: FloatArray
    """[T], the team's extrinsic reward"""
    terminated: bool
    """The game itself ended the episode."""
    truncated: bool
    """The step limit ended it."""
    info: Mapping[str, float]
    """End-of-episode figures named by `EnvSpec.info_keys`."""

    @property
    def length(self) -> int:
        """Number of steps T."""
        return len(self.reward)

    @property
    def nbytes(self) -> int:
        """Size of all arrays."""
        return sum(getattr(self, name).nbytes for name in TRAJECTORY_ARRAYS)


TRAJECTORY_ARRAYS: Mapping[str, tuple[type[np.generic], tuple[str, ...]]] = {
    "obs": (np.float32, ("T+1", "n", "O")),
    "state": (np.float32, ("T+1", "S")),
    "mask": (np.bool_, ("T+1", "n", "A")),
    "alive": (np.bool_, ("T+1", "n")),
    "actions": (np.int16, ("T", "n")),
    "log_mu": (np.float32, ("T", "n")),
    "reward": (np.float32, ("T",)),
}
"""dtype and symbolic shape of each array of a trajectory."""


def expected_shape(name: str, spec: EnvSpec, length: int) -> tuple[int, ...]:
    """Shape that array `name` of a trajectory of `length` steps must have."""
    sizes = {
        "T": length,
        "T+1": length + 1,
        "n": spec.n_agents,
        "A": spec.n_actions,
        "O": spec.obs_dim,
        "S": spec.state_dim,
    }
    return tuple(sizes[axis] for axis in TRAJECTORY_ARRAYS[name][1])


@dataclass(frozen=True)
class Batch:
    """The trajectories of one learner step in `episode_id` order, padded with zeros to the longest."""

    policy_version: int
    epsilon: float
    """Exploration floor that the behaviour policy had"""
    obs: FloatArray
    """[B, T+1, n, O]"""
    state: FloatArray
    """[B, T+1, S]"""
    mask: BoolArray
    """[B, T+1, n, A]; padded steps have action 0 available so that no softmax sees an empty row"""
    alive: BoolArray
    """[B, T+1, n]"""
    actions: NDArray[np.int64]
    """[B, T, n]"""
    log_mu: FloatArray
    """[B, T, n]"""
    reward: FloatArray
    """[B, T]"""
    filled: BoolArray
    """[B, T], true for steps that were played"""
    terminated: BoolArray
    """[B, T], true at the step whose end the game decided"""
    truncated: BoolArray
    """[B, T], true at the step after which the limit ended the episode"""

    @property
    def env_steps(self) -> int:
        """Number of steps played."""
        return int(self.filled.sum())

    @classmethod
    def from_trajectories(cls, trajectories: Sequence[Trajectory], epsilon: float) -> Batch:
        """Pad and stack; the episodes must share their policy version and come in id order.

        Raises:
            ValueError: no trajectory, mixed policy versions, or ids out of order.
        """
        if not trajectories:
            raise ValueError("a batch wants at least one trajectory, got none")
        ids = [t.episode_id for t in trajectories]
        if ids != sorted(set(ids)):
            raise ValueError(f"a batch wants ascending episode ids, got {ids}")
        versions = {t.policy_version for t in trajectories}
        if len(versions) != 1:
            raise ValueError(f"a batch wants one policy version, got {sorted(versions)}")
        lengths = np.array([t.length for t in trajectories])
        steps = int(lengths.max())
        padded: dict[str, Any] = {name: _pad(trajectories, name, steps) for name in TRAJECTORY_ARRAYS}
        played = np.arange(steps) < lengths[:, None]
        padded["mask"][np.arange(steps + 1) > lengths[:, None], :, 0] = True
        padded["actions"] = padded["actions"].astype(np.int64)
        last = np.arange(steps) == lengths[:, None] - 1
        return cls(
            policy_version=versions.pop(),
            epsilon=epsilon,
            filled=played,
            terminated=last & np.array([t.terminated for t in trajectories])[:, None],
            truncated=last & np.array([t.truncated for t in trajectories])[:, None],
            **padded,
        )


def _pad(trajectories: Sequence[Trajectory], name: str, steps: int) -> NDArray[np.generic]:
    dtype, axes = TRAJECTORY_ARRAYS[name]
    first = getattr(trajectories[0], name)
    rows = steps + (axes[0] == "T+1")
    out = np.zeros((len(trajectories), rows, *first.shape[1:]), dtype)
    for row, trajectory in zip(out, trajectories, strict=True):
        array = getattr(trajectory, name)
        row[: len(array)] = array
    return out
