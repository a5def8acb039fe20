"""LIIR finds out which action of each player earns the team's reward: three players, three levers each.

Player 0's lever 0 earns the team 1 and its lever 2 costs it 1; player 1's levers are wired the other way
round and player 2's not at all. The three share one policy and see nothing but who they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch

from liir_common.config import AlgorithmConfig
from liir_common.intrinsic import IntrinsicReward
from liir_common.types import Batch, EnvSpec, Trajectory, Weights
from services.learner.algorithms import Algorithm, make_algorithm
from services.learner.algorithms.policy import Policy

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

SPEC = EnvSpec(
    "levers", "1", "{}", n_agents=3, n_actions=3, obs_dim=3, state_dim=1, episode_limit=3, info_keys=()
)
WIRES = np.array([[1.0, 0.0, -1.0], [-1.0, 0.0, 1.0], [0.0, 0.0, 0.0]], np.float32)
"""What the team earns [player, lever]"""
EPSILON, STEPS, EPISODES, UPDATES = 0.5, 3, 32, 90
SCALE = 4.0
"""Of the observations; the further apart they are, the less a lesson for one player moves the others."""
SETTINGS = {
    "lambda": 1.0,
    "gae_lambda": 0.0,
    "policy_epochs": 1,
    "critic_epochs": 2,
    "entropy": 0.0,
    "policy_hidden": 64,
    "policy_gain": 0.01,  # these observations are large: from more it would begin with its mind made up
    # Slow beside η. Parameters are shared, so r_in may also teach a player what only helps another; while
    # neither has learned its lever, players 0 and 1 want opposite things there, and that cancels.
    "policy_optimizer": {"lr": 1e-5},
    "eta_optimizer": {"lr": 2e-3},
}


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def play(algorithm: Algorithm, rng: np.random.Generator, version: int) -> Batch:
    """All episodes at once, with the algorithm's policy and exploration floor."""
    w = algorithm.policy()
    n, a = SPEC.n_agents, SPEC.n_actions
    h = np.zeros((EPISODES, n, w["gru.weight_hh"].shape[1]))
    last = np.zeros((EPISODES, n, a))
    ids = np.broadcast_to(np.eye(n), (EPISODES, n, n))
    actions, log_mu = [], []
    for _ in range(STEPS):
        x = np.concatenate([SCALE * ids, last, ids], -1)
        x = np.maximum(x @ w["fc1.weight"].T + w["fc1.bias"], 0)
        i = np.split(x @ w["gru.weight_ih"].T + w["gru.bias_ih"], 3, -1)
        g = np.split(h @ w["gru.weight_hh"].T + w["gru.bias_hh"], 3, -1)
        r, z = sigmoid(i[0] + g[0]), sigmoid(i[1] + g[1])
        h = (1 - z) * np.tanh(i[2] + r * g[2]) + z * h
        logits = h @ w["fc2.weight"].T + w["fc2.bias"]
        softmax = np.exp(logits - logits.max(-1, keepdims=True))
        pi = (1 - EPSILON) * softmax / softmax.sum(-1, keepdims=True) + EPSILON / a
        u = (pi.cumsum(-1) < rng.random((EPISODES, n, 1))).sum(-1).clip(max=a - 1)
        last = np.eye(a)[u]
        actions.append(u)
        log_mu.append(np.log((pi * last).sum(-1)))
    return Batch.from_trajectories(
        [trajectory(b, version, np.stack(actions)[:, b], np.stack(log_mu)[:, b]) for b in range(EPISODES)],
        EPSILON,
    )


def trajectory(number: int, version: int, actions: np.ndarray, log_mu: np.ndarray) -> Trajectory:
    shape = (STEPS + 1, SPEC.n_agents)
    return Trajectory(
        episode_id=number,
        policy_version=version,
        obs=np.broadcast_to(SCALE * np.eye(3, dtype=np.float32), (*shape, 3)),
        state=np.ones((STEPS + 1, 1), np.float32),
        mask=np.ones((*shape, SPEC.n_actions), np.bool_),
        alive=np.ones(shape, np.bool_),
        actions=actions.astype(np.int16),
        log_mu=log_mu.astype(np.float32),
        reward=WIRES[np.arange(SPEC.n_agents), actions].sum(1),
        terminated=True,
        truncated=False,
        info={},
    )


def intrinsic_rewards(algorithm: Algorithm, bound: float) -> np.ndarray:
    """r_in [player, lever]; a player sees nothing but who it is."""
    return IntrinsicReward(algorithm.intrinsic(), bound)(SCALE * np.eye(3, dtype=np.float32))


class Learned(NamedTuple):
    before: np.ndarray
    """r_in [player, lever]"""
    after: np.ndarray
    policy: Weights


def train(settings: dict[str, object], seed: int, updates: int = UPDATES) -> Learned:
    config = AlgorithmConfig.model_validate(SETTINGS | settings)
    algorithm = make_algorithm(SPEC, config, seed, torch.device("cpu"))
    rng = np.random.default_rng(seed)
    before = intrinsic_rewards(algorithm, config.r_in_bound)
    for version in range(updates):
        algorithm.update(play(algorithm, rng, version))
    return Learned(before, intrinsic_rewards(algorithm, config.r_in_bound), algorithm.policy())


def tells_apart(r_in: np.ndarray) -> bool:
    """Whether r_in [player, lever] ranks each player's own levers as they pay; one credit for all ranks both
    players' alike."""
    return bool(
        r_in[0, 0] - r_in[0, 2] > 0.25
        and r_in[1, 2] - r_in[1, 0] > 0.25
        and r_in[0, 0] > r_in[0, 1] > r_in[0, 2]
        and r_in[1, 2] > r_in[1, 1] > r_in[1, 0]
    )


@pytest.mark.parametrize("outer_samples", ["reuse", "fresh"])
@pytest.mark.parametrize("seed", range(3))
def test_intrinsic_reward_tells_each_player_its_own_lever(outer_samples: str, seed: int) -> None:
    before, after, _ = train({"outer_samples": outer_samples}, seed)
    assert tells_apart(after)
    assert tells_apart(after - before)
    if outer_samples == "reuse":  # from fresh samples seed 0 leaves player 1 less spread than player 2
        spread = np.ptp(after, axis=1)
        assert spread[2] < 0.6 * spread[:2].min()


@pytest.mark.parametrize("seed", range(3))
def test_one_credit_for_all_tells_no_player_its_own_lever(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the released program has it, whose ∇η is one number, of the wrong sign, times the mean return's."""
    settings = {"normalize_advantages": False}  # else what all have alike would cancel
    assert tells_apart(train(settings, seed).after)
    derivative = Policy.derivative
    monkeypatch.setattr(
        Policy, "derivative", lambda *args: torch.full_like(c := derivative(*args), -float(c.mean()))
    )
    before, after, _ = train(settings, seed)
    assert not tells_apart(after)
    assert np.abs(after - before).mean() > 0.1  # it learns, but one thing for all


@pytest.mark.parametrize("seed", range(3))
def test_without_lambda_intrinsic_reward_tells_no_player_its_own_lever(seed: int) -> None:
    before, after, _ = train({"lambda": 0.0}, seed)
    assert np.array_equal(before, after)
    assert not tells_apart(after)


def same(first: Weights, second: Weights) -> bool:
    return all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("control", [{"lambda": 0.0}, {"freeze_eta": True}])
def test_controls_learn_a_policy_and_no_intrinsic_reward(control: dict[str, object]) -> None:
    before, after, policy = train(control, 0, updates=3)
    assert np.array_equal(before, after)
    assert not same(policy, train(control, 0, updates=2).policy)


def test_without_lambda_no_intrinsic_reward_reaches_the_policy() -> None:
    """However large it is; with λ, its size alone makes another policy."""
    small, large = ({"r_in_gain": gain, "freeze_eta": True} for gain in (0.01, 1.0))
    control, weighted = {"lambda": 0.0}, {"lambda": 1.0}
    assert same(train(small | control, 0, updates=3).policy, train(large | control, 0, updates=3).policy)
    assert not same(
        train(small | weighted, 0, updates=3).policy, train(large | weighted, 0, updates=3).policy
    )
