"""The policy FC - ReLU - GRU - FC and its exploration as compiled float32 code; `dense` has the rules."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from liir_common import rng
from liir_common.rollout.dense import add_product, affine, aligned, sigmoid, tanh
from liir_common.types import EnvSpec, Exploration, FloatArray, Weights, policy_shapes

SOFTMAX_FLOOR, EPSILON_GREEDY, GREEDY = 0, 1, 2
MODES = {
    Exploration.SOFTMAX_FLOOR: SOFTMAX_FLOOR,
    Exploration.EPSILON_GREEDY: EPSILON_GREEDY,
    Exploration.GREEDY: GREEDY,
}
"""What `act` calls each exploration."""


class Choice(NamedTuple):
    """How `act` chooses, for one episode."""

    stream: rng.Stream
    """Every agent takes one draw a step, needed or not: its position depends on the step alone."""
    mode: int
    """A value of MODES."""
    epsilon: float
    """In [0, 1]"""


class Policy(NamedTuple):
    """Weights laid out for `act`, and the room it works in: a policy serves one thread at a time.

    Weights are [inputs, outputs], so that the innermost loop runs along memory; H hidden units.
    """

    fc1_obs: FloatArray
    """[O, H]"""
    fc1_action: FloatArray
    """[A, H], what a one-hot last action adds"""
    fc1_agent: FloatArray
    """[n, H], what the one-hot agent id adds, with the bias"""
    gru_input: FloatArray
    """[H, 3H], gates r, z, n"""
    gru_input_bias: FloatArray
    """[3H]"""
    gru_hidden: FloatArray
    """[H, 3H], gates r, z, n"""
    gru_hidden_bias: FloatArray
    """[3H]"""
    fc2: FloatArray
    """[H, A]"""
    fc2_bias: FloatArray
    """[A]"""
    features: FloatArray
    """[n, H], room for the output of the first layer"""
    input_gates: FloatArray
    """[n, 3H], room"""
    hidden_gates: FloatArray
    """[n, 3H], room"""
    logits: FloatArray
    """[n, A], room; after `act` the network's outputs, not masked"""


def pack(weights: Weights, spec: EnvSpec, hidden: int = 64) -> Policy:
    """Lay out the weights of a policy with `hidden` units for `act`.

    Raises:
        ValueError: a parameter is missing, unknown, of another shape or dtype, or not finite.
    """
    _check(weights, policy_shapes(spec, hidden))
    n, actions, width = spec.n_agents, spec.n_actions, spec.obs_dim
    fc1 = weights["fc1.weight"].T
    return Policy(
        fc1_obs=aligned(fc1[:width]),
        fc1_action=aligned(fc1[width : width + actions]),
        fc1_agent=aligned(fc1[width + actions :] + weights["fc1.bias"]),
        gru_input=aligned(weights["gru.weight_ih"].T),
        gru_input_bias=aligned(weights["gru.bias_ih"]),
        gru_hidden=aligned(weights["gru.weight_hh"].T),
        gru_hidden_bias=aligned(weights["gru.bias_hh"]),
        fc2=aligned(weights["fc2.weight"].T),
        fc2_bias=aligned(weights["fc2.bias"]),
        features=aligned(np.zeros((n, hidden))),
        input_gates=aligned(np.zeros((n, 3 * hidden))),
        hidden_gates=aligned(np.zeros((n, 3 * hidden))),
        logits=aligned(np.zeros((n, actions))),
    )


def random_weights(spec: EnvSpec, hidden: int, seed: int) -> Weights:
    """Weights for measurements, uniform in ± 1 / sqrt(H), the range that torch's GRU starts in."""
    random = np.random.default_rng(seed)
    bound = hidden**-0.5
    shapes = policy_shapes(spec, hidden)
    return {name: random.uniform(-bound, bound, shape).astype(np.float32) for name, shape in shapes.items()}


def _check(weights: Weights, shapes: dict[str, tuple[int, ...]]) -> None:
    if weights.keys() != shapes.keys():
        missing, unknown = sorted(shapes.keys() - weights.keys()), sorted(weights.keys() - shapes.keys())
        raise ValueError(f"a policy wants {', '.join(shapes)}; missing {missing}, unknown {unknown}")
    for name, shape in shapes.items():
        array = weights[name]
        if array.shape != shape or array.dtype != np.float32:
            raise ValueError(
                f"policy parameter {name}: wanted float32 {shape}, got {array.dtype} {array.shape}; "
                "do the environment and the hidden units match those of training?"
            )
        if not np.isfinite(array).all():
            raise ValueError(
                f"policy parameter {name}: {np.count_nonzero(~np.isfinite(array))} of {array.size} values "
                "are not finite; the training that made it diverged"
            )


_ZERO = np.float32(0)


@njit(cache=True, fastmath={"contract"})
def _embed(policy, obs, last_actions):
    """ReLU of the first layer into `features`; one-hot inputs are additions of a row."""
    features = policy.features
    n, units = features.shape
    for a in range(n):
        for j in range(units):
            features[a, j] = policy.fc1_agent[a, j]
        if last_actions[a] >= 0:
            for j in range(units):
                features[a, j] += policy.fc1_action[last_actions[a], j]
    add_product(obs, policy.fc1_obs, features)
    for a in range(n):
        for j in range(units):
            features[a, j] = max(features[a, j], _ZERO)


@njit(inline="always")
def _gates(sums, units):
    """The parts r, z, n of [3H]."""
    return sums[:units], sums[units : 2 * units], sums[2 * units :]


# Python's check for division by zero would keep the loop over units from vectorising.
@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _recur(policy, hidden):
    """One step of torch's GRUCell on `features`: hidden[n, H] in place."""
    units = hidden.shape[1]
    affine(policy.features, policy.gru_input, policy.gru_input_bias, policy.input_gates)
    affine(hidden, policy.gru_hidden, policy.gru_hidden_bias, policy.hidden_gates)
    for a in range(len(hidden)):
        x_reset, x_update, x_new = _gates(policy.input_gates[a], units)
        h_reset, h_update, h_new = _gates(policy.hidden_gates[a], units)
        h = hidden[a]
        for j in range(units):
            x_new[j] += sigmoid(x_reset[j] + h_reset[j]) * h_new[j]
        for j in range(units):
            new = tanh(x_new[j])
            h[j] = new + sigmoid(x_update[j] + h_update[j]) * (h[j] - new)


@njit(cache=True)
def _best(logits, mask):
    """The available action with the largest output; the lowest index among equals."""
    best = -1
    for action in range(len(logits)):
        if mask[action] and (best < 0 or logits[action] > logits[best]):
            best = action
    return best


@njit(cache=True)
def _probability(action, logits, best, total, available, choice):
    if choice.mode == SOFTMAX_FLOOR:
        p = math.exp(np.float64(logits[action]) - logits[best]) / total
    else:
        p = 1.0 if action == best else 0.0
    return p if choice.mode == GREEDY else (1.0 - choice.epsilon) * p + choice.epsilon / available


@njit(cache=True)
def _sample(logits, mask, draw, choice):
    """The action at the uniform number `draw` of the masked distribution, and its probability."""
    best = _best(logits, mask)
    available, total = 0, 0.0
    for action in range(len(logits)):
        if mask[action]:
            available += 1
            total += math.exp(np.float64(logits[action]) - logits[best])
    taken, probability, reached = best, 1.0, 0.0
    for action in range(len(logits)):
        if mask[action]:
            p = _probability(action, logits, best, total, available, choice)
            reached += p
            if p > 0.0:
                # Stays the last possible action where rounding leaves the sum below the draw.
                taken, probability = action, p
            if draw < reached:
                break
    return taken, probability


@njit(cache=True, nogil=True)
def act(policy, hidden, obs, last_actions, mask, choice, actions, log_mu):
    """One decision of the team.

    Args:
        policy: from `pack`.
        hidden: [n, H] float32, the recurrent state; zeros before the first step; updated in place.
        obs: [n, O] float32.
        last_actions: [n] integers, -1 before the first step; may be the array `actions`.
        mask: [n, A] bool, true where available; `first_stuck` finds rows without any.
        choice: how to choose; its stream advances by n draws.
        actions: [n] integers, written.
        log_mu: [n] float32, written: log of the probability of the action taken; 0 if greedy.
    """
    _embed(policy, obs, last_actions)
    _recur(policy, hidden)
    affine(hidden, policy.fc2, policy.fc2_bias, policy.logits)
    for a in range(len(hidden)):
        actions[a], probability = _sample(policy.logits[a], mask[a], rng.uniform(choice.stream), choice)
        log_mu[a] = math.log(probability)


@njit(cache=True, nogil=True)
def first_stuck(mask):
    """Lowest agent of mask[n, A] without an available action, or -1."""
    for a in range(mask.shape[0]):
        if not mask[a].any():
            return a
    return -1


def stuck_message(agent: int, step: int) -> str:
    """What to tell whoever wrote an environment that left `agent` without an action at `step`."""
    return (
        f"step {step}: agent {agent} has no available action (its action mask is all zero); "
        "the environment must leave at least one, for example a no-op for a dead agent"
    )
