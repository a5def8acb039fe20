"""The other methods against slow implementations in their papers' notation, with loops over everything.

The references know nothing of the learner's code; they share the network and the policy gradient with the
reference of LIIR.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from liir_common.config import METHOD_PRESETS, PRESETS, AlgorithmConfig
from liir_common.types import Batch, policy_shapes
from services.learner.algorithms import Algorithm, make_algorithm
from services.learner.algorithms.coma import counterfactual_advantage
from services.learner.algorithms.iql import Independent
from services.learner.algorithms.networks import count, views
from services.learner.algorithms.qmix import MonotonicMixer
from services.learner.algorithms.vdn import Sum
from tests.states import state_of
from tests.unit.test_liir_oracle import (
    SPEC,
    Preconditioner,
    State,
    batch_of,
    close,
    continued,
    mlp,
    network_outputs,
    policy_gradient,
    policy_probabilities,
    scaled,
    standardised,
    t64,
    weights_of,
)

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

CPU = torch.device("cpu")
BASE = {"policy_hidden": 8, "policy_gain": 1.0}
PAPER = PRESETS["paper"]["algorithm"] | {"target_interval": 3}
ONCE = {"replay": {"episodes": 6, "batch_episodes": 6, "episodes_per_update": 6}}
"""Every update sees exactly the batch that came."""
ACTOR_CRITIC: dict[str, dict[str, object]] = {
    "central_v strong": {},
    "central_v paper": PAPER,
    "central_v bootstrap": {"limit_is_terminal": False},
    "iac strong": {},
    "iac paper": PAPER,
    "iac bootstrap": {"limit_is_terminal": False},
    "coma": METHOD_PRESETS["coma"] | {"target_interval": 3},
    "coma strong": {},
}
VALUE_BASED: dict[str, dict[str, object]] = {
    f"{name} {variant}": METHOD_PRESETS[name] | ONCE | settings
    for name in ("iql", "vdn", "qmix")
    for variant, settings in {
        "pymarl": {"target_interval": 3},
        "adam, lambda, no targets": {"gae_lambda": 0.8, "target_interval": 0, "policy_optimizer": {}},
        "bootstrap, clipped": {
            "limit_is_terminal": False,
            "target_interval": 3,
            "policy_optimizer": {"name": "rmsprop", "clip": 0.01},
        },
    }.items()
}


def warmed(case: str, settings: dict[str, object]) -> tuple[Algorithm, State, AlgorithmConfig]:
    """An algorithm in the middle of learning."""
    config = AlgorithmConfig.model_validate(BASE | settings | {"name": case.split()[0]})
    algorithm = make_algorithm(SPEC, config, 5, CPU, torch.float64)
    for seed in range(4):
        algorithm.update(batch_of(seed, seed))
    return algorithm, state_of(algorithm), config


def played(batch: Batch) -> list[tuple[int, int]]:
    return [(int(b), int(t)) for b, t in np.argwhere(batch.filled)]


def ends(batch: Batch, b: int, t: int, config: AlgorithmConfig) -> bool:
    """Whether nothing follows step t."""
    return bool(batch.terminated[b, t] or (batch.truncated[b, t] and config.limit_is_terminal))


def returns_of(batch: Batch, value: Tensor, config: AlgorithmConfig) -> Tensor:
    """G_t = V_t + Σ_k≥t (γ·λ_g)^(k-t)·δ_k, term by term, [B, T, k] for values [B, T+1, k]."""
    out = torch.zeros_like(value[:, :-1])
    for b, t in played(batch):
        out[b, t] = value[b, t]
        for k in range(t, int(batch.filled[b].sum())):
            ahead = 0 * value[b, k] if ends(batch, b, k, config) else value[b, k + 1]
            delta = float(batch.reward[b, k]) + config.gamma * ahead - value[b, k]
            out[b, t] += (config.gamma * config.gae_lambda) ** (k - t) * delta
    return out


def one_hot(index: int, size: int) -> list[float]:
    return [float(i == index) for i in range(size)]


def inputs_of(name: str, batch: Batch, b: int, t: int, i: int) -> list[float]:
    """What the critic of agent i sees at step t, which may be the one after the last."""
    n, actions = SPEC.n_agents, SPEC.n_actions
    if name == "central_v":
        return batch.state[b, t].tolist()
    obs = batch.obs[b, t, i].tolist() if batch.alive[b, t, i] else [0.0] * SPEC.obs_dim
    if name == "iac":
        return [*obs, *one_hot(i, n)]
    others: list[float] = []
    last: list[float] = []
    for j in range(n):
        does = t < batch.filled.shape[1] and batch.alive[b, t, j] and j != i
        others += one_hot(int(batch.actions[b, t, j]), actions) if does else [0.0] * actions
        did = t > 0 and batch.alive[b, t - 1, j]
        last += one_hot(int(batch.actions[b, t - 1, j]), actions) if did else [0.0] * actions
    return [*batch.state[b, t].tolist(), *obs, *others, *last, *one_hot(i, n)]


def seen(name: str, batch: Batch) -> Tensor:
    """Inputs [B, T+1, n, inputs] of the critic."""
    episodes, rows, n = batch.alive.shape
    return torch.tensor(
        [[[inputs_of(name, batch, b, t, i) for i in range(n)] for t in range(rows)] for b in range(episodes)],
        dtype=torch.float64,
    )


def taken_by(batch: Batch) -> Tensor:
    """[B, T, n, 1]; the dead count as taking action 0."""
    return torch.as_tensor(np.where(batch.alive[:, :-1], batch.actions, 0))[..., None]


def reference(state: State, batch: Batch, config: AlgorithmConfig) -> tuple[Tensor, Tensor]:
    """θ' and ϕ' after one update."""
    x = seen(config.name, batch)
    outputs = SPEC.n_actions if config.name == "coma" else 1
    live, target = (
        scaled(mlp(state[key], x, outputs), state, "varphi")
        for key in ("varphi.parameters", "varphi.target" if config.target_interval else "varphi.parameters")
    )
    theta = state["policy.parameters"]
    taken = taken_by(batch)
    if config.name == "coma":
        # A state after the end is worth nothing, and COMA has no other state without an action.
        value = functional.pad(target[:, :-1].gather(-1, taken).squeeze(-1), (0, 0, 0, 1))
        returns = returns_of(batch, value, config)
        pi = policy_probabilities(theta, batch, config.policy_hidden)
        advantage = torch.zeros_like(returns)
        for b, t in played(batch):
            for i in range(SPEC.n_agents):
                baseline = sum(pi[b, t, i, a] * live[b, t, i, a] for a in range(SPEC.n_actions))
                advantage[b, t, i] = live[b, t, i, taken[b, t, i, 0]] - baseline
    else:
        returns = returns_of(batch, target.squeeze(-1), config)
        advantage = returns - live[:, :-1].squeeze(-1)
    advantage = standardised(advantage, weights_of(batch)[0], config)
    precondition = Preconditioner(state, config)
    for _ in range(config.policy_epochs):
        before = theta.detach().requires_grad_()
        theta = before + precondition(policy_gradient(before, advantage, batch, config))
    return theta.detach(), regressed(state, x, taken, returns, batch, config)


def regressed(
    state: State, x: Tensor, taken: Tensor, returns: Tensor, batch: Batch, config: AlgorithmConfig
) -> Tensor:
    """The critic's parameters after its epochs, by torch's own optimiser."""
    filled = torch.as_tensor(batch.filled)
    target, x, taken = returns[filled], x[:, :-1][filled], taken[filled]
    if config.normalize_values:
        moments = torch.stack([torch.ones(()).double(), target.mean(), (target**2).mean()])
        moments = 0.99 * state["varphi.moments"] + 0.01 * moments
        total, first, second = moments
        target = (target - first / total) / (second / total - (first / total) ** 2).sqrt()
    parameters, optimizer = continued(state, "varphi", config.critic_optimizer)
    for _ in range(config.critic_epochs):
        optimizer.zero_grad()
        prediction = mlp(parameters, x, SPEC.n_actions if config.name == "coma" else 1)
        prediction = prediction.gather(-1, taken) if config.name == "coma" else prediction
        (prediction.squeeze(-1) - target).square().mean().backward()
        optimizer.step()
    return parameters.detach()


@pytest.mark.parametrize("case", ACTOR_CRITIC)
def test_actor_critic_update_equals_the_formulas(case: str) -> None:
    algorithm, before, config = warmed(case, ACTOR_CRITIC[case])
    batch = batch_of(9, 9)
    theta, varphi = reference(before, batch, config)
    metrics = algorithm.update(batch)
    after = state_of(algorithm)
    for key, wanted in [("policy.parameters", theta), ("varphi.parameters", varphi)]:
        close(after[key] - before[key], wanted - before[key], 1e-9)
    assert (metrics["clip_fraction"] > 0.01) == (config.policy_epochs > 1)


def test_coma_advantages_sum_to_zero_under_the_policy() -> None:
    _, before, config = warmed("coma", ACTOR_CRITIC["coma"])
    batch = batch_of(9, 9)
    w, _ = weights_of(batch)
    pi = policy_probabilities(before["policy.parameters"], batch, config.policy_hidden)[w > 0].T
    q = torch.randn(pi.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 10
    advantage = counterfactual_advantage(q, pi)
    assert float((pi * advantage).sum(0).abs().max()) < 1e-13
    # It is a shift of each column: differences between actions stay.
    torch.testing.assert_close(advantage[1] - advantage[0], q[1] - q[0])


def naive_mix(name: str, mixing: Tensor, q: Tensor, s: Tensor, config: AlgorithmConfig) -> Tensor:
    """The team's values [k] of the agents' values [n] in the state [S], agent by agent and unit by unit."""
    if name == "iql":
        return q
    if name == "vdn":
        return sum(q.unbind(), torch.zeros(()).double())[None]
    p = views(mixing, MonotonicMixer(SPEC, config.mixer_width, config.hypernet_width).shapes)

    def two_layers(layer: str) -> Tensor:
        hidden = torch.relu(p[f"{layer}_in.weight"] @ s + p[f"{layer}_in.bias"])
        return p[f"{layer}_out.weight"] @ hidden + p[f"{layer}_out.bias"]

    w1 = two_layers("w1").abs().reshape(SPEC.n_agents, config.mixer_width)
    w2, b1 = two_layers("w2").abs(), p["b1.weight"] @ s + p["b1.bias"]
    total = two_layers("b2")
    for unit in range(config.mixer_width):
        x = b1[unit]
        for i in range(SPEC.n_agents):
            x = x + w1[i, unit] * q[i]
        total = total + w2[unit] * (x if x > 0 else x.exp() - 1)
    return total


def available(batch: Batch, b: int, t: int, i: int) -> list[int]:
    """To the dead only what they did, and after the last step only the first action."""
    if batch.alive[b, t, i]:
        return [int(a) for a in np.flatnonzero(batch.mask[b, t, i])]
    inside = t < batch.filled.shape[1] and batch.filled[b, t]
    return [int(batch.actions[b, t, i])] if inside else [0]


def q_loss(parameters: Tensor, target: Tensor, batch: Batch, config: AlgorithmConfig) -> Tensor:
    """Mean of (Q_tot - y)² with double Q-learning."""
    split = sum(int(np.prod(shape)) for shape in policy_shapes(SPEC, config.policy_hidden).values())
    q, q_bar = (network_outputs(p[:split], batch, config.policy_hidden) for p in (parameters, target))
    agents = range(SPEC.n_agents)

    def mix(p: Tensor, q: list[Tensor], b: int, t: int) -> Tensor:
        return naive_mix(config.name, p[split:], torch.stack(q), t64(batch.state[b, t]), config)

    def best(b: int, t: int) -> Tensor:
        chosen = [max(available(batch, b, t, i), key=lambda a: q[b, t, i, a].item()) for i in agents]
        return mix(target, [q_bar[b, t, i, chosen[i]] for i in agents], b, t).detach()

    episodes, rows = batch.alive.shape[:2]
    columns = SPEC.n_agents if config.name == "iql" else 1
    value = torch.zeros(episodes, rows, columns, dtype=torch.float64)
    for b, t in played(batch):
        value[b, t] = best(b, t)
        if batch.truncated[b, t] and not ends(batch, b, t, config):
            value[b, t + 1] = best(b, t + 1)
    y = returns_of(batch, value, config)
    squares = [
        (mix(parameters, [q[b, t, i, batch.actions[b, t, i]] for i in agents], b, t) - y[b, t]) ** 2
        for b, t in played(batch)
    ]
    return torch.cat(squares).mean()


@pytest.mark.parametrize("case", VALUE_BASED)
def test_value_based_update_equals_the_formulas(case: str) -> None:
    algorithm, before, config = warmed(case, VALUE_BASED[case])
    batch = batch_of(9, 9)
    # To the dead only what they did is open, whatever their mask says.
    batch.alive[:, 1, 1:] = False
    parameters = before["q.parameters"].clone().requires_grad_()
    target = before["q.target" if config.target_interval else "q.parameters"]
    loss = q_loss(parameters, target, batch, config)
    (gradient,) = torch.autograd.grad(loss, parameters)
    renamed = {f"policy.optimizer.{key}": before[f"q.optimizer.{key}"] for key in ("square", "mean", "steps")}
    wanted = Preconditioner(renamed, config)(-gradient)
    metrics = algorithm.update(batch)
    close(state_of(algorithm)["q.parameters"] - before["q.parameters"], wanted, 1e-9)
    assert metrics["q_loss"] == pytest.approx(loss.item(), rel=1e-12)
    assert (metrics["policy_gradient_norm"] > config.policy_optimizer.clip) == ("clipped" in case)


def test_every_update_draws_other_episodes_and_there_are_as_many_as_configured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    replay = {"replay": {"episodes": 20, "batch_episodes": 7, "episodes_per_update": 4}}
    config = AlgorithmConfig.model_validate(BASE | METHOD_PRESETS["iql"] | replay | {"name": "iql"})
    algorithm = make_algorithm(SPEC, config, 5, CPU)
    assert algorithm.replay is not None
    draws: list[list[int]] = []
    sample = algorithm.replay.sample
    monkeypatch.setattr(
        algorithm.replay, "sample", lambda places: draws.append(list(places)) or sample(places)
    )
    made = []
    for seed in range(6):
        before = len(draws)
        figures = algorithm.update(batch_of(seed, seed))
        made.append(len(draws) - before)
        assert bool(figures) == bool(made[-1])
    # Six episodes a batch: 6, 12, 18, … of them, the first too few to draw seven from.
    assert made == [0, 2, 1, 2, 1, 2]
    assert all(places == sorted(set(places)) and len(places) == 7 for places in draws)
    assert len({tuple(places) for places in draws}) == len(draws)
    assert max(max(places) for places in draws[-3:]) > 12


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_qmix_is_monotonic_in_every_agent_in_every_state() -> None:
    mixer = MonotonicMixer(SPEC, 32, 64)
    slopes = []
    for seed in range(20):
        flat, state = random(count(mixer.shapes), seed=seed), random(50, SPEC.state_dim, seed=seed + 100)
        q = 3 * random(50, SPEC.n_agents, seed=seed + 200)
        q.requires_grad_()
        (slope,) = torch.autograd.grad(mixer(flat, q, state).sum(), q)
        slopes.append(slope)
    everything = torch.cat(slopes)
    assert float(everything.min()) > 0
    # How it mixes is the state's doing: were the slopes all alike, it would be VDN.
    assert float(everything.std()) > 0.1 * float(everything.mean())


def test_vdn_adds_and_iql_leaves_alone() -> None:
    q = torch.tensor([[1.0, 2.0, -5.0], [0.5, 0.25, 0.25]])
    nothing, state = q.new_zeros(0), q.new_zeros(2, SPEC.state_dim)
    assert Sum()(nothing, q, state).tolist() == [[-2.0], [1.0]]
    assert torch.equal(Independent()(nothing, q, state), q)
