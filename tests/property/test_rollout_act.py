"""What holds for every policy, observation and mask."""

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from liir_common import seeds
from liir_common.rollout.policy import GREEDY, MODES, SOFTMAX_FLOOR, Choice, act, pack, random_weights
from liir_common.types import EnvSpec

HIDDEN = 16


@st.composite
def decisions(draw: st.DrawFn) -> tuple[EnvSpec, np.random.Generator, Any, Choice]:
    n, actions, width = draw(st.integers(1, 6)), draw(st.integers(1, 12)), draw(st.integers(1, 20))
    spec = EnvSpec("any", "1", "{}", n, actions, width, 1, 1, ())
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    mask = random.random((n, actions)) < draw(st.floats(0, 1))
    mask[np.arange(n), random.integers(0, actions, n)] = True
    stream = np.array([draw(st.integers(0, 2**64 - 1))], np.uint64)
    how = Choice(stream, draw(st.sampled_from(sorted(MODES.values()))), draw(st.floats(0, 1)))
    return spec, random, mask, how


def decide(spec: EnvSpec, random: Any, mask: Any, how: Choice) -> tuple[Any, Any, Any, Any]:
    weights = random_weights(spec, HIDDEN, seed=int(random.integers(2**32)))
    policy = pack({name: 20 * array for name, array in weights.items()}, spec, HIDDEN)
    obs = random.normal(scale=3, size=(spec.n_agents, spec.obs_dim)).astype(np.float32)
    hidden = random.uniform(-1, 1, (spec.n_agents, HIDDEN)).astype(np.float32)
    last = random.integers(-1, spec.n_actions, spec.n_agents)
    taken, log_mu = np.full(spec.n_agents, -7), np.full(spec.n_agents, np.nan, np.float32)
    act(policy, hidden, obs, last, mask, how, taken, log_mu)
    return policy, hidden, taken, log_mu


@settings(deadline=None, max_examples=300)
@given(decisions())
def test_available_actions_with_their_probabilities(decision: Any) -> None:
    spec, random, mask, how = decision
    before = int(how.stream[0])
    policy, hidden, taken, log_mu = decide(spec, random, mask, how)
    agents = np.arange(spec.n_agents)
    assert mask[agents, taken].all()
    assert (np.abs(hidden) <= 1).all()
    assert (log_mu <= 0).all()
    assert np.isfinite(log_mu).all()
    assert int(how.stream[0]) == (before + spec.n_agents * seeds.GOLDEN) % 2**64
    logits = np.where(mask, policy.logits.astype(np.float64), -np.inf)
    best = logits.argmax(1)
    if how.mode == SOFTMAX_FLOOR:
        chosen = np.exp(logits - logits.max(1, keepdims=True))
        chosen /= chosen.sum(1, keepdims=True)
    else:
        chosen = np.eye(spec.n_actions)[best]
    epsilon = 0.0 if how.mode == GREEDY else how.epsilon
    behaviour = (1 - epsilon) * chosen + epsilon * mask / mask.sum(1, keepdims=True)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(log_mu, np.log(behaviour[agents, taken]), atol=1e-5, rtol=1e-6)


@settings(deadline=None, max_examples=100)
@given(decisions())
def test_an_agent_decides_by_what_it_sees_alone(decision: Any) -> None:
    """Agents share the pass over the weights; neither the others' inputs nor their number may leak."""
    spec, random, mask, how = decision
    weights = random_weights(spec, HIDDEN, seed=1)
    obs = random.normal(size=(spec.n_agents, spec.obs_dim)).astype(np.float32)
    other = obs.copy()
    other[1:] = random.normal(size=other[1:].shape)
    outcomes = []
    for seen in (obs, other):
        policy = pack(weights, spec, HIDDEN)
        hidden = np.zeros((spec.n_agents, HIDDEN), np.float32)
        taken, log_mu = np.full(spec.n_agents, -1), np.zeros(spec.n_agents, np.float32)
        act(policy, hidden, seen, taken, mask, how._replace(stream=how.stream.copy()), taken, log_mu)
        outcomes.append((hidden[0].tobytes(), int(taken[0]), float(log_mu[0])))
    assert outcomes[0] == outcomes[1]
