"""The compiled policy: against torch, against its own probabilities, and what it refuses."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numba import jit

from liir_common.rollout.policy import (
    EPSILON_GREEDY,
    GREEDY,
    MODES,
    SOFTMAX_FLOOR,
    Choice,
    Policy,
    _recur,
    act,
    first_stuck,
    pack,
    random_weights,
)
from liir_common.seeds import GOLDEN
from liir_common.types import EnvSpec, Exploration, Weights

SPEC = EnvSpec(
    "small", "1", "{}", n_agents=3, n_actions=9, obs_dim=30, state_dim=1, episode_limit=9, info_keys=()
)


class TorchPolicy(torch.nn.Module):
    """The policy as its definition reads: one-hot inputs, torch's own layers."""

    def __init__(self, spec: EnvSpec, weights: Weights) -> None:
        super().__init__()
        hidden, inputs = weights["fc1.weight"].shape
        self.spec = spec
        self.fc1 = torch.nn.Linear(inputs, hidden)
        self.gru = torch.nn.GRUCell(hidden, hidden)
        self.fc2 = torch.nn.Linear(hidden, spec.n_actions)
        self.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})

    def forward(self, obs: Any, last: Any, hidden: Any) -> Any:
        one_hot = torch.zeros(self.spec.n_agents, self.spec.n_actions)
        for agent, action in enumerate(last):
            if action >= 0:
                one_hot[agent, action] = 1
        x = torch.cat([torch.from_numpy(obs), one_hot, torch.eye(self.spec.n_agents)], 1)
        hidden = self.gru(torch.relu(self.fc1(x)), hidden)
        return self.fc2(hidden), hidden


def scaled(spec: EnvSpec, hidden: int, scale: float, seed: int = 0) -> Weights:
    weights = random_weights(spec, hidden, seed)
    return {name: array * np.float32(scale) for name, array in weights.items()}


def fresh(spec: EnvSpec, hidden: int) -> tuple[Any, Any, Any]:
    return (
        np.zeros((spec.n_agents, hidden), np.float32),
        np.full(spec.n_agents, -1),
        np.zeros(spec.n_agents, np.float32),
    )


def choice(mode: int, epsilon: float, seed: int = 5) -> Choice:
    return Choice(np.array([seed], np.uint64), mode, epsilon)


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
@pytest.mark.parametrize(
    ("n", "actions", "width", "hidden"), [(3, 9, 30, 64), (8, 14, 80, 64), (2, 3, 2, 5), (1, 1, 1, 1)]
)
def test_agrees_with_torch_over_an_episode(
    n: int, actions: int, width: int, hidden: int, scale: float
) -> None:
    spec = replace(SPEC, n_agents=n, n_actions=actions, obs_dim=width)
    weights = scaled(spec, hidden, scale)
    policy, reference = pack(weights, spec, hidden), TorchPolicy(spec, weights)
    random = np.random.default_rng(1)
    h, last, log_mu = fresh(spec, hidden)
    torch_h = torch.zeros(n, hidden)
    how = choice(SOFTMAX_FLOOR, 0.1)
    for _ in range(40):
        obs = random.normal(size=(n, width)).astype(np.float32)
        mask = random.random((n, actions)) < 0.6
        mask[np.arange(n), random.integers(0, actions, n)] = True
        with torch.no_grad():
            logits, torch_h = reference(obs, last, torch_h)
        act(policy, h, obs, last, mask, how, last, log_mu)
        np.testing.assert_allclose(h, torch_h.numpy(), atol=1e-5)
        np.testing.assert_allclose(policy.logits, logits.numpy(), atol=1e-5 * max(1, scale))
        available = torch.from_numpy(mask)
        pi = 0.9 * torch.softmax(
            logits.masked_fill(~available, -torch.inf), 1
        ) + 0.1 * available / available.sum(1, keepdim=True)
        taken = pi[torch.arange(n), torch.from_numpy(last)]
        np.testing.assert_allclose(log_mu, taken.log().numpy(), atol=1e-5 * max(1, scale))
        assert mask[np.arange(n), last].all()


def policy_with_logits(logits: list[float]) -> tuple[EnvSpec, Policy]:
    """A one-agent policy whose outputs are these, whatever it sees."""
    spec = replace(SPEC, n_agents=1, n_actions=len(logits), obs_dim=1)
    weights = dict(scaled(spec, 4, 0.0))
    weights["fc2.bias"] = np.array(logits, np.float32)
    return spec, pack(weights, spec, 4)


def sample(logits: list[float], mask: list[int], how: Choice, draws: int) -> tuple[Any, Any]:
    spec, policy = policy_with_logits(logits)
    h, last, log_mu = fresh(spec, 4)
    taken, logs = np.zeros(draws, int), np.zeros(draws, np.float32)
    for i in range(draws):
        act(policy, h, np.zeros((1, 1), np.float32), last, np.array([mask], bool), how, last, log_mu)
        taken[i], logs[i] = last[0], log_mu[0]
    return taken, logs


LOGITS = [0.5, -1.0, 2.0, 0.0, 1.0]
MASK = [1, 1, 0, 1, 1]
SOFTMAX = np.exp(LOGITS) * MASK / (np.exp(LOGITS) * MASK).sum()
UNIFORM = np.array(MASK) / 4
BEST = np.array([0, 0, 0, 0, 1])


@pytest.mark.parametrize(
    ("mode", "epsilon", "probabilities"),
    [
        (SOFTMAX_FLOOR, 0.0, SOFTMAX),
        (SOFTMAX_FLOOR, 0.3, 0.7 * SOFTMAX + 0.3 * UNIFORM),
        (SOFTMAX_FLOOR, 1.0, UNIFORM),
        (EPSILON_GREEDY, 0.4, 0.6 * BEST + 0.4 * UNIFORM),
        (EPSILON_GREEDY, 0.0, BEST),
        (GREEDY, 0.4, BEST),
    ],
)
def test_frequencies_and_log_mu_are_those_of_the_behaviour_policy(
    mode: int, epsilon: float, probabilities: Any
) -> None:
    draws = 20_000
    taken, log_mu = sample(LOGITS, MASK, choice(mode, epsilon), draws)
    counts = np.bincount(taken, minlength=len(LOGITS))
    possible = probabilities > 0
    assert (counts[~possible] == 0).all()
    expected = draws * probabilities[possible]
    # At most 3 degrees of freedom: 99.9 % of such samples are below 16.3.
    assert ((counts[possible] - expected) ** 2 / expected).sum() < 16.3
    np.testing.assert_allclose(log_mu, np.log(probabilities[taken]), atol=1e-6)


@pytest.mark.parametrize(
    ("logits", "mask", "best"),
    [
        ([1.0, 1.0, 1.0], [1, 1, 1], 0),
        ([0.0, 2.0, 2.0], [1, 1, 1], 1),
        ([5.0, 2.0, 2.0], [0, 1, 1], 1),
        ([5.0, -2.0, 9.0], [0, 1, 0], 1),
    ],
)
def test_greedy_takes_the_lowest_of_the_best_available(
    logits: list[float], mask: list[int], best: int
) -> None:
    taken, log_mu = sample(logits, mask, choice(GREEDY, 0.0), 50)
    assert (taken == best).all()
    assert (log_mu == 0).all()


def test_an_action_without_probability_is_never_taken() -> None:
    # exp(-2000) is 0: neither rounding at the end of the sum nor a draw of 0 may pick it.
    taken, log_mu = sample([-1000.0, 1000.0, -1000.0], [1, 1, 1], choice(SOFTMAX_FLOOR, 0.0), 5000)
    assert (taken == 1).all()
    assert np.isfinite(log_mu).all()


def test_every_agent_takes_one_draw_in_every_mode() -> None:
    policy = pack(random_weights(SPEC, 64, 0), SPEC)
    obs, mask = np.ones((3, 30), np.float32), np.ones((3, 9), bool)
    mask[1, 1:] = False
    positions = set()
    for mode in MODES.values():
        h, last, log_mu = fresh(SPEC, 64)
        how = choice(mode, 0.2)
        for _ in range(7):
            act(policy, h, obs, last, mask, how, last, log_mu)
        positions.add(int(how.stream[0]))
    assert positions == {(5 + 21 * GOLDEN) % 2**64}


def test_every_exploration_has_a_mode() -> None:
    assert set(MODES) == set(Exploration)


def test_first_stuck_is_the_lowest_agent_without_an_action() -> None:
    mask = np.ones((4, 3), bool)
    assert first_stuck(mask) == -1
    mask[[1, 3]] = False
    assert first_stuck(mask) == 1


def without(weights: Weights, name: str) -> Weights:
    return {key: array for key, array in weights.items() if key != name}


def test_pack_refuses_what_does_not_fit() -> None:
    weights = random_weights(SPEC, 64, 0)
    with pytest.raises(ValueError, match=r"missing \['fc2.bias'\], unknown \[\]"):
        pack(without(weights, "fc2.bias"), SPEC)
    with pytest.raises(ValueError, match=r"missing \[\], unknown \['fc3.bias'\]"):
        pack({**weights, "fc3.bias": weights["fc2.bias"]}, SPEC)
    with pytest.raises(ValueError, match=r"fc1.weight: wanted float32 \(64, 43\), got float32 \(64, 42\)"):
        pack(weights, replace(SPEC, obs_dim=31))
    with pytest.raises(ValueError, match=r"fc1.weight: wanted float32 \(32, 42\)"):
        pack(weights, SPEC, hidden=32)
    with pytest.raises(ValueError, match=r"fc2.bias: wanted float32 .*, got float64"):
        pack({**weights, "fc2.bias": weights["fc2.bias"].astype(np.float64)}, SPEC)
    broken = weights["gru.bias_hh"].copy()
    broken[[3, 5]] = np.nan, np.inf
    with pytest.raises(ValueError, match=r"gru.bias_hh: 2 of 192 values are not finite"):
        pack({**weights, "gru.bias_hh": broken}, SPEC)


def test_packing_copies() -> None:
    weights = random_weights(SPEC, 64, 0)
    policy = pack(weights, SPEC)
    assert not any(np.shares_memory(array, given) for array in policy for given in weights.values())


def test_the_loop_over_units_is_compiled_to_vectors() -> None:
    policy = pack(random_weights(SPEC, 64, 0), SPEC)
    # Code from numba's cache cannot be inspected.
    compiled = jit(**_recur.targetoptions)(_recur.py_func)
    compiled(policy, np.zeros((3, 64), np.float32))
    (code,) = compiled.inspect_llvm().values()
    assert re.search(r"fdiv contract <\d+ x float>", code)
