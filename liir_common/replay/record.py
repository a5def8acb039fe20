"""Play one battle with a frozen policy and keep all there is to see: the units, what the policy weighed at
every decision, and the intrinsic reward of every action it could have taken."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liir_common import checkpoint
from liir_common.battle.env import BattleEnv
from liir_common.battle.parameters import resolve
from liir_common.battle.render import Blast, Shot
from liir_common.battle.scenarios import make_battle
from liir_common.battle.snapshots import UnitRecord
from liir_common.battle.units import UNIT_TYPES
from liir_common.checkpoint import Manifest
from liir_common.config import AlgorithmConfig, EnvConfig
from liir_common.errors import ConfigError
from liir_common.intrinsic import IntrinsicReward
from liir_common.rollout.loop import LoopPlayer
from liir_common.rollout.play import env_spec
from liir_common.rollout.policy import MODES, Choice, act, pack
from liir_common.types import (
    BoolArray,
    EnvSpec,
    Exploration,
    FloatArray,
    IntArray,
    Ticket,
    Trajectory,
    Weights,
)

HEALERS = frozenset(name for name, unit in UNIT_TYPES.items() if unit.weapon is None)
"""Unit types whose targets are their friends"""
BLASTS = {name: unit.weapon.blast for name, unit in UNIT_TYPES.items() if unit.weapon and unit.weapon.blast}
"""How far the unit types reach that burst when they die"""
Frame = Sequence[UnitRecord]
"""All units at one moment, allies first"""


@dataclass(frozen=True)
class Recording:
    """One battle of T steps, with n agents and A actions."""

    map_name: str
    seed: int
    exploration: Exploration
    manifest: Manifest
    """Of the checkpoint that played"""
    pathing: NDArray[np.bool_]
    """[32, 32] by (x, y), true where ground units can stand"""
    frames: Sequence[Frame]
    """T + 1 of them, as `Trajectory` has observations"""
    shots: Sequence[Sequence[Shot]]
    """T of them: the attacks that began within each step"""
    blasts: Sequence[Sequence[Blast]]
    """T of them: the units that burst within each step"""
    trajectory: Trajectory
    probabilities: FloatArray | None
    """[T, n, A], softmax over the available actions, however the action was chosen; None with Q values"""
    q_values: FloatArray | None
    """[T, n, A], 0 where unavailable; None where the method learns probabilities"""
    intrinsic: FloatArray | None
    """[T, n, A], r_in of every action; None where the method learns none"""


def record(
    manifest: Manifest,
    tensors: Weights,
    seed: int = 0,
    sampled: bool = False,
    map_name: str | None = None,
) -> Recording:
    """Play the battle that `env.reset(seed)` begins.

    Args:
        manifest, tensors: a checkpoint, as `load_checkpoint` returns it.
        seed: 64 bits, for the battle and for what is drawn from the policy.
        sampled: choose as in sampled tests (`AlgorithmConfig.frozen_choice`), not the best action every time.
        map_name: another map than that of the training, with the same sizes.

    Raises:
        ConfigError: the policy does not play battles, the map is unknown or does not fit the policy, or the
            seed is out of range.
    """
    env = EnvConfig.model_validate(manifest.config["env"])
    if env.kind != "battle":
        raise ConfigError(f"a replay wants a policy that plays battles, got one for {env.label}")
    if not 0 <= seed < 2**64:
        raise ConfigError(f"a seed wants an integer in [0, 2**64), got {seed}")
    map_name = map_name or env.map
    algorithm = AlgorithmConfig.model_validate(manifest.config["algorithm"])
    exploration, epsilon = algorithm.frozen_choice(sampled)
    options: dict[str, Any] = dict(env.options)
    spec, weights = env_spec(env.model_copy(update={"map": map_name})), checkpoint.section(tensors, "policy")
    battle = _WatchedBattle(map_name, **options)
    player = LoopPlayer(battle, spec, len(weights["fc1.bias"]))
    try:
        player.load(weights)
    except ValueError as error:
        raise ConfigError(f"{map_name} does not fit a policy trained on {env.map}: {error}") from None
    trajectory = player.play(Ticket(0, manifest.policy_version, seed, exploration, epsilon))
    outputs = policy_outputs(weights, spec, trajectory)
    return Recording(
        map_name=map_name,
        seed=seed,
        exploration=exploration,
        manifest=manifest,
        pathing=make_battle(map_name, **options)[0].pathing,
        frames=battle.frames,
        shots=[
            find_shots(before, after, aims, resolve(options).step_mul)
            for before, after, aims in zip(battle.frames, battle.frames[1:], battle.aims, strict=False)
        ],
        blasts=[find_blasts(before, after) for before, after in itertools.pairwise(battle.frames)],
        trajectory=trajectory,
        probabilities=None if algorithm.value_based else _softmax(outputs, trajectory.mask[:-1]),
        q_values=np.where(trajectory.mask[:-1], outputs, 0) if algorithm.value_based else None,
        intrinsic=_intrinsic(manifest, tensors, trajectory),
    )


class _WatchedBattle(BattleEnv):
    """A battle that remembers how all units stood before each step and after the last, and at whom they had
    aimed by the end of each step."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        result = super().reset(seed, options)
        self.frames = [self.snapshot()]
        self.aims: list[IntArray] = []
        return result

    def step(self, actions: dict[str, Any]) -> Any:
        result = super().step(actions)
        self.frames.append(self.snapshot())
        self.aims.append(self._battle.units["aim"].copy())
        return result


def policy_outputs(weights: Weights, spec: EnvSpec, trajectory: Trajectory) -> FloatArray:
    """[T, n, A], what the network says of every action along an episode, available or not."""
    hidden = np.zeros((spec.n_agents, len(weights["fc1.bias"])), np.float32)
    policy = pack(weights, spec, hidden.shape[1])
    choice = Choice(np.zeros(1, np.uint64), MODES[Exploration.GREEDY], 0.0)
    last, chosen = np.full(spec.n_agents, -1), np.zeros(spec.n_agents, np.int64)
    log_mu = np.zeros(spec.n_agents, np.float32)
    outputs = np.zeros(trajectory.mask[:-1].shape, np.float32)
    for t in range(trajectory.length):
        act(policy, hidden, trajectory.obs[t], last, trajectory.mask[t], choice, chosen, log_mu)
        outputs[t] = policy.logits
        # What was done, not what this pass would have chosen, is what the policy sees next.
        last[:] = trajectory.actions[t]
    return outputs


def _softmax(outputs: FloatArray, mask: BoolArray) -> FloatArray:
    logits = np.where(mask, outputs, -np.inf)
    exponentials = np.exp(logits - logits.max(-1, keepdims=True))
    probabilities: FloatArray = exponentials / exponentials.sum(-1, keepdims=True)
    return probabilities


def _intrinsic(manifest: Manifest, tensors: Weights, trajectory: Trajectory) -> FloatArray | None:
    if not checkpoint.section(tensors, "intrinsic"):
        return None
    return IntrinsicReward.from_checkpoint(manifest, tensors)(trajectory.obs[:-1])


def find_shots(before: Frame, after: Frame, aims: IntArray, loops: int) -> list[Shot]:
    """Attacks that began in the step of `loops` between two frames.

    An attack sets the weapon's cooldown, which otherwise only falls; `aims` [units] are the targets of the
    last attacks.
    """
    return [
        Shot(i, int(aims[i]))
        for i, (old, new) in enumerate(zip(before, after, strict=True))
        if new["cooldown"] > max(0.0, old["cooldown"] - loops)
    ]


def find_blasts(before: Frame, after: Frame) -> list[Blast]:
    """Of the units that died between two frames those that burst, where they did: the dead do not move."""
    return [
        Blast(new["x"], new["y"], BLASTS[new["unit_type"]])
        for old, new in zip(before, after, strict=True)
        if old["alive"] and not new["alive"] and new["unit_type"] in BLASTS
    ]


def target_number(unit: UnitRecord, n_allies: int) -> int | None:
    """Place in the frame of the unit that `unit` attacks or heals."""
    if unit["target"] is None:
        return None
    aims_at_enemies = (unit["team"] == "ally") != (unit["unit_type"] in HEALERS)
    return unit["target"] + n_allies if aims_at_enemies else unit["target"]
