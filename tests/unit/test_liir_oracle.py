"""LIIR against a slow implementation in the paper's notation that differentiates through the inner step.

The reference knows nothing of the learner's code: dense arrays, loops over time, `create_graph=True`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from liir_common.config import PRESETS, AlgorithmConfig, OptimizerConfig
from liir_common.types import Batch, EnvSpec, policy_shapes
from services.learner.algorithms import Algorithm, make_algorithm
from services.learner.bench import synthetic_batch
from tests.states import load_state, state_of

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

SPEC = EnvSpec("test", "1", "{}", 3, 4, 3, 5, 9, ())
CPU = torch.device("cpu")
BETA_1, BETA_2 = 0.9, 0.999
State = dict[str, Tensor]
BASE = {"policy_hidden": 8, "lambda": 0.7, "policy_gain": 1.0, "r_in_gain": 1.0, "r_in_bound": 1.5}
CASES: dict[str, dict[str, object]] = {
    "strong": {},
    "paper": PRESETS["paper"]["algorithm"] | {"target_interval": 3},
    "td0": {"gae_lambda": 0.0, "policy_epochs": 1, "normalize_advantages": False},
    "gae": {"policy_epochs": 1, "normalize_advantages": False},
    "normalised": {"policy_epochs": 1},
    "clipped gradient": {"policy_optimizer": {"clip": 0.01, "lr": 0.02}},
    "rmsprop": {"policy_optimizer": {"name": "rmsprop", "clip": 0.01}, "policy_epochs": 1},
    "two steps": {"policy_epochs": 2, "entropy": 0.0, "ratio_clip": 0.05},
    "targets": {"target_interval": 3, "gae_lambda": 0.8},
    "bootstrap": {"limit_is_terminal": False, "normalize_values": False},
    "default init": {"orthogonal_init": False},
    "old samples": {"policy_epochs": 1, "ratio_bound": 1.1},
    "old samples, two steps": {"policy_epochs": 2, "ratio_bound": 1.0},
}


def config_of(case: dict[str, object]) -> AlgorithmConfig:
    return AlgorithmConfig.model_validate(BASE | case)


def batch_of(seed: int, version: int = 0) -> Batch:
    """Padding, deaths, a gap in a life, a behaviour policy that is not the learner's, and episodes that end
    by the limit, by themselves, and by both at once."""
    batch = synthetic_batch(SPEC, episodes=6, steps=6, seed=seed, policy_version=version, epsilon=0.2)
    noise = np.random.default_rng(seed).normal(0, 0.3, batch.log_mu.shape).astype(np.float32)
    alive = batch.alive.copy()
    assert alive[0, :3, 0].all()
    alive[0, 1, 0] = False
    truncated, ended = batch.truncated.copy(), np.argmax(batch.terminated.any(1))
    truncated[ended] |= batch.terminated[ended]
    return replace(batch, alive=alive, truncated=truncated, log_mu=batch.log_mu + noise)


@dataclass
class Reference:
    """What one update should have done, from the state before it."""

    theta: Tensor
    eta_gradient: Tensor
    outer_gradient: Tensor
    """v, the gradient of J_ex by θ'"""
    proxy_return: Tensor
    extrinsic_return: Tensor
    theta_before: Tensor


def unflatten(flat: Tensor, shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    out, start = {}, 0
    for name, shape in shapes.items():
        out[name] = flat[start : start + int(np.prod(shape))].reshape(shape)
        start += out[name].numel()
    assert start == flat.numel()
    return out


def mlp(flat: Tensor, x: Tensor, outputs: int) -> Tensor:
    inputs = x.shape[-1]
    # inputs·h + h + h² + h + outputs·h + outputs parameters
    b = inputs + outputs + 2
    h = round((-b + (b * b - 4 * (outputs - flat.numel())) ** 0.5) / 2)
    shapes = {"w1": (h, inputs), "b1": (h,), "w2": (h, h), "b2": (h,), "w3": (outputs, h), "b3": (outputs,)}
    p = unflatten(flat, shapes)
    x = torch.relu(x @ p["w1"].T + p["b1"])
    x = torch.relu(x @ p["w2"].T + p["b2"])
    return x @ p["w3"].T + p["b3"]


def t64(array: np.ndarray) -> Tensor:
    return torch.as_tensor(array.astype(np.float64))


def ids(*shape: int) -> Tensor:
    return torch.eye(SPEC.n_agents, dtype=torch.float64).expand(*shape, SPEC.n_agents, SPEC.n_agents)


def network_outputs(theta: Tensor, batch: Batch, hidden: int) -> Tensor:
    """[B, T+1, n, A], not masked: GRU from h = 0 over every step, padding and dead agents included."""
    p = unflatten(theta, policy_shapes(SPEC, hidden))
    episodes, steps, n = batch.log_mu.shape
    h = torch.zeros(episodes, n, hidden, dtype=theta.dtype)
    last = torch.zeros(episodes, n, SPEC.n_actions, dtype=theta.dtype)
    out = []
    for t in range(steps + 1):
        x = torch.cat([t64(batch.obs[:, t]), last, ids(episodes)], -1)
        x = torch.relu(x @ p["fc1.weight"].T + p["fc1.bias"])
        i_r, i_z, i_n = (x @ p["gru.weight_ih"].T + p["gru.bias_ih"]).chunk(3, -1)
        h_r, h_z, h_n = (h @ p["gru.weight_hh"].T + p["gru.bias_hh"]).chunk(3, -1)
        r, z = torch.sigmoid(i_r + h_r), torch.sigmoid(i_z + h_z)
        h = (1 - z) * torch.tanh(i_n + r * h_n) + z * h
        out.append(h @ p["fc2.weight"].T + p["fc2.bias"])
        if t < steps:
            last = torch.eye(SPEC.n_actions, dtype=theta.dtype)[batch.actions[:, t]]
    return torch.stack(out, 1)


def policy_probabilities(theta: Tensor, batch: Batch, hidden: int) -> Tensor:
    """π [B, T, n, A]"""
    mask = torch.as_tensor(batch.mask[:, :-1])
    logits = network_outputs(theta, batch, hidden)[:, :-1].masked_fill(~mask, -1e30)
    floor = batch.epsilon * mask.double() / mask.sum(-1, keepdim=True)
    return (1 - batch.epsilon) * torch.softmax(logits, -1) + floor


def log_pi_of(pi: Tensor, batch: Batch) -> Tensor:
    """log π(u) [B, T, n], 0 where w is 0: the action there may not have been available."""
    chosen = pi.gather(-1, torch.as_tensor(batch.actions)[..., None]).squeeze(-1)
    return torch.where(weights_of(batch)[0] > 0, chosen, 1.0).log()


def entropy_of(pi: Tensor) -> Tensor:
    """H [B, T, n]"""
    return -(pi * torch.where(pi > 0, pi, 1.0).log()).sum(-1)


def weights_of(batch: Batch) -> tuple[Tensor, Tensor]:
    """w [B, T, n] and N."""
    before = np.zeros_like(batch.terminated)
    before[:, 1:] = batch.terminated[:, :-1]
    w = t64((batch.filled & ~before)[..., None] & batch.alive[:, :-1])
    return w, w.sum().clamp_min(1)


def scaled(x: Tensor, state: State, name: str) -> Tensor:
    total, first, second = state[f"{name}.moments"]
    if total == 0:
        return x
    return first / total + (second / total - (first / total) ** 2).clamp_min(1e-6).sqrt() * x


def td_lambda(reward: Tensor, value: Tensor, batch: Batch, config: AlgorithmConfig) -> Tensor:
    """G_t = r_t + γ·(1 - term_t)·((1 - λ_g)·V_t+1 + λ_g·G_t+1), V_T in place of G_T at a cut."""
    g = torch.zeros_like(reward)
    for b, t in reversed(np.argwhere(batch.filled).tolist()):
        terminal = batch.terminated[b, t] or (batch.truncated[b, t] and config.limit_is_terminal)
        follows = t + 1 < batch.filled.shape[1] and batch.filled[b, t + 1]
        ahead = value[b, t + 1]
        if follows:
            ahead = (1 - config.gae_lambda) * ahead + config.gae_lambda * g[b, t + 1]
        g = g.clone()
        g[b, t] = reward[b, t] + (0 if terminal else config.gamma * ahead)
    return g


def standardised(a: Tensor, w: Tensor, config: AlgorithmConfig) -> Tensor:
    if not config.normalize_advantages:
        return a
    mean = (w * a).sum() / w.sum()
    return (a - mean) / ((w * (a - mean) ** 2).sum() / w.sum() + 1e-10).sqrt()


def intrinsic_reward(eta: Tensor, batch: Batch, config: AlgorithmConfig) -> Tensor:
    """r_in [B, T, n], 0 where w is 0"""
    w, _ = weights_of(batch)
    local = torch.cat([t64(batch.obs[:, :-1]), ids(*w.shape[:2])], -1)
    out = mlp(eta, local, SPEC.n_actions).gather(-1, torch.as_tensor(batch.actions)[..., None]).squeeze(-1)
    return config.r_in_bound * torch.tanh(out / config.r_in_bound) * w


def proxy(eta: Tensor, state: State, batch: Batch, config: AlgorithmConfig) -> tuple[Tensor, Tensor]:
    """Returns and advantages [B, T, n] of r_proxy."""
    w, _ = weights_of(batch)
    r_proxy = t64(batch.reward)[..., None] + config.lambda_ * intrinsic_reward(eta, batch, config)
    s = t64(batch.state)[:, :, None].expand(-1, -1, SPEC.n_agents, -1)
    x = torch.cat([s, ids(*s.shape[:2])], -1)
    live, target = (scaled(mlp(state[k], x, 1).squeeze(-1), state, "phi") for k in critic_keys(state, "phi"))
    g = td_lambda(r_proxy, target, batch, config)
    return g, standardised(g - live[:, :-1], w, config)


def critic_keys(state: State, name: str) -> tuple[str, str]:
    target = f"{name}.target"
    return f"{name}.parameters", target if target in state else f"{name}.parameters"


def extrinsic(state: State, batch: Batch, config: AlgorithmConfig) -> tuple[Tensor, Tensor]:
    s = t64(batch.state)
    live, target = (scaled(mlp(state[k], s, 1), state, "varphi") for k in critic_keys(state, "varphi"))
    g = td_lambda(t64(batch.reward)[..., None], target, batch, config)
    a = (g - live[:, :-1]).expand(-1, -1, SPEC.n_agents)
    return g, standardised(a, weights_of(batch)[0], config)


class Preconditioner:
    """The policy optimiser of the reference; returns the step with its diagonal frozen."""

    def __init__(self, state: State, config: AlgorithmConfig) -> None:
        self.config = config.policy_optimizer
        self.square, self.mean = state["policy.optimizer.square"], state["policy.optimizer.mean"]
        self.steps = int(state["policy.optimizer.steps"])

    def __call__(self, g: Tensor) -> Tensor:
        c = self.config
        norm = (g**2).sum().sqrt()
        g = g * c.clip / norm if norm > c.clip else g
        self.steps += 1
        frozen = g.detach()
        if c.name == "rmsprop":
            self.square = c.alpha * self.square + (1 - c.alpha) * frozen**2
            return c.lr * g / (self.square.sqrt() + c.eps)
        m = BETA_1 * self.mean + (1 - BETA_1) * g
        self.mean = m.detach()
        self.square = BETA_2 * self.square + (1 - BETA_2) * frozen**2
        diagonal = 1 / ((self.square / (1 - BETA_2**self.steps)).sqrt() + c.eps)
        return c.lr * m / (1 - BETA_1**self.steps) * diagonal


def policy_gradient(theta: Tensor, a: Tensor, batch: Batch, config: AlgorithmConfig) -> Tensor:
    """g(θ), differentiable in θ and A."""
    w, n = weights_of(batch)
    pi = policy_probabilities(theta, batch, config.policy_hidden)
    log_pi = log_pi_of(pi, batch)
    rho = (log_pi - t64(batch.log_mu)).exp()
    if config.policy_epochs == 1:
        surrogate = truncated(rho, config) * a
    else:
        low, high = 1 - config.ratio_clip, 1 + config.ratio_clip
        surrogate = torch.minimum(rho * a, rho.clamp(low, high) * a)
    objective = (w * (surrogate + config.entropy * entropy_of(pi))).sum() / n
    return torch.autograd.grad(objective, theta, create_graph=True)[0]


def outer_objective(theta: Tensor, batch: Batch, a_ex: Tensor, config: AlgorithmConfig) -> Tensor:
    """J with ∇J = (1/N) Σ w · ρ · A_ex · ∇log π."""
    w, n = weights_of(batch)
    rho = (
        log_pi_of(policy_probabilities(theta, batch, config.policy_hidden), batch) - t64(batch.log_mu)
    ).exp()
    return (w * a_ex * truncated(rho, config)).sum() / n


def truncated(rho: Tensor, config: AlgorithmConfig) -> Tensor:
    """What has min(ρ, bound) · ∇log π for its gradient."""
    bound = config.ratio_bound
    return torch.where(rho < bound, rho, bound * (1 + (rho / bound).log())) if bound else rho


def inner_steps(eta: Tensor, state: State, batch: Batch, config: AlgorithmConfig) -> tuple[Tensor, Tensor]:
    """θ before the last step, and θ'(η) with the graph of the last step."""
    _, a = proxy(eta, state, batch, config)
    precondition = Preconditioner(state, config)
    theta = state["policy.parameters"]
    for _ in range(config.policy_epochs):
        before = theta.detach().requires_grad_()
        theta = before + precondition(policy_gradient(before, a, batch, config))
    return before.detach(), theta


def reference(state: State, batch: Batch, config: AlgorithmConfig) -> Reference:
    eta = state["eta.parameters"].clone().requires_grad_()
    before, theta = inner_steps(eta, state, batch, config)
    g_ex, a_ex = extrinsic(state, batch, config)
    objective = outer_objective(theta, batch, a_ex.detach(), config)
    gradient, v = torch.autograd.grad(objective, [eta, theta])
    g_proxy, _ = proxy(eta.detach(), state, batch, config)
    return Reference(theta.detach(), gradient, v, g_proxy, g_ex, before)


def figures_of(wanted: Reference, eta: Tensor, batch: Batch, config: AlgorithmConfig) -> dict[str, float]:
    """Those of an update's figures that are one formula; the policy's are from before its last step."""
    w, n = weights_of(batch)
    pi = policy_probabilities(wanted.theta_before, batch, config.policy_hidden)
    log_rho = log_pi_of(pi, batch) - t64(batch.log_mu)
    intrinsic = config.lambda_ * intrinsic_reward(eta, batch, config).abs().sum() / n
    extrinsic = np.abs(batch.reward[batch.filled]).astype(np.float64).mean()
    figures = {
        "eta_gradient_norm": (wanted.eta_gradient**2).sum().sqrt(),
        "outer_gradient_norm": (wanted.outer_gradient**2).sum().sqrt(),
        "intrinsic_reward": intrinsic,
        "reward_ratio": intrinsic / extrinsic,
        "policy_entropy": (w * entropy_of(pi)).sum() / n,
        "policy_kl": (w * (log_rho.exp() - 1 - log_rho)).sum() / n,
    }
    return {name: float(figure) for name, figure in figures.items()}


def eta_gradient(before: State, after: State) -> Tensor:
    """∇η J_ex, recovered from Adam's mean."""
    return (after["eta.optimizer.mean"] - BETA_1 * before["eta.optimizer.mean"]) / (1 - BETA_1)


def close(a: Tensor, b: Tensor, rtol: float) -> None:
    error = float((a - b).norm() / b.norm())
    assert float(b.norm()) > 1e-9
    assert error < rtol, f"relative error {error:.2e}, wanted less than {rtol:.0e}"


def warmed(config: AlgorithmConfig) -> tuple[Algorithm, State]:
    """An algorithm in the middle of learning: moments, normalisers and targets are no longer zero."""
    algorithm = make_algorithm(SPEC, config, 5, CPU, torch.float64)
    for seed in range(4):
        algorithm.update(batch_of(seed, seed))
    return algorithm, state_of(algorithm)


def continued(
    state: State, name: str, config: OptimizerConfig
) -> tuple[torch.nn.Parameter, torch.optim.Optimizer]:
    """Parameters under torch's own optimiser, which goes on from where ours is, but descends."""
    parameters = torch.nn.Parameter(state[f"{name}.parameters"].clone())
    optimizer: torch.optim.Optimizer
    if config.name == "adam":
        optimizer = torch.optim.Adam([parameters], config.lr, (BETA_1, BETA_2), config.eps)
    else:
        optimizer = torch.optim.RMSprop([parameters], config.lr, config.alpha, config.eps)
    square = state[f"{name}.optimizer.square"]
    optimizer.state[parameters] = {
        "step": state[f"{name}.optimizer.steps"].float().clone(),
        "exp_avg": -state[f"{name}.optimizer.mean"],
        "exp_avg_sq": square.clone(),
        "square_avg": square.clone(),
    }
    return parameters, optimizer


def raised(state: State, gradient: Tensor, config: AlgorithmConfig) -> Tensor:
    """η a step up the gradient."""
    eta, optimizer = continued(state, "eta", config.eta_optimizer)
    eta.grad = -gradient * min(1.0, config.eta_optimizer.clip / float(gradient.norm()))
    optimizer.step()
    return eta.detach()


def fitted(state: State, name: str, returns: Tensor, batch: Batch, config: AlgorithmConfig) -> Tensor:
    """The critic's parameters after its epochs, by torch's own optimiser."""
    filled = torch.as_tensor(batch.filled)
    target = returns[filled]
    if config.normalize_values:
        batch_moments = torch.stack([torch.ones(()).double(), target.mean(), (target**2).mean()])
        state = state | {f"{name}.moments": 0.99 * state[f"{name}.moments"] + 0.01 * batch_moments}
        total, first, second = state[f"{name}.moments"]
        target = (target - first / total) / (second / total - (first / total) ** 2).sqrt()
    parameters, optimizer = continued(state, name, config.critic_optimizer)
    x = t64(batch.state[:, :-1])[filled]
    if name == "phi":
        x = torch.cat([x[:, None].expand(-1, SPEC.n_agents, -1), ids(len(x))], -1)
    for _ in range(config.critic_epochs):
        optimizer.zero_grad()
        prediction = mlp(parameters, x, 1)
        (prediction.squeeze(-1) if name == "phi" else prediction).sub(target).square().mean().backward()
        optimizer.step()
    return parameters.detach()


@pytest.mark.parametrize("case", CASES)
def test_update_equals_differentiating_through_the_inner_step(case: str) -> None:
    config = config_of(CASES[case])
    algorithm, before = warmed(config)
    batch = batch_of(9, 9)
    # Rewards of both signs, which their mean size must not cancel.
    batch = replace(batch, reward=batch.reward - np.float32(0.3) * batch.filled)
    wanted = reference(before, batch, config)
    metrics = algorithm.update(batch)
    after = state_of(algorithm)
    moved = wanted.theta - before["policy.parameters"]
    close(after["policy.parameters"] - before["policy.parameters"], moved, 1e-9)
    eta = raised(before, wanted.eta_gradient, config)
    close(after["eta.parameters"] - before["eta.parameters"], eta - before["eta.parameters"], 1e-9)
    close(after["phi.parameters"], fitted(before, "phi", wanted.proxy_return, batch, config), 1e-12)
    close(after["varphi.parameters"], fitted(before, "varphi", wanted.extrinsic_return, batch, config), 1e-12)
    figures = figures_of(wanted, before["eta.parameters"], batch, config)
    assert {name: metrics[name] for name in figures} == pytest.approx(figures, rel=1e-9)
    # The case has to exercise what it is there for.
    assert (metrics["clip_fraction"] > 0.01) == (config.policy_epochs > 1 or config.ratio_bound > 0)
    assert (metrics["policy_gradient_norm"] > config.policy_optimizer.clip) == (
        config.policy_optimizer.clip < 1
    )


@pytest.mark.parametrize("case", ["td0", "rmsprop", "two steps"])
def test_meta_gradient_equals_central_differences_of_eta(case: str) -> None:
    config = config_of(CASES[case])
    algorithm, before = warmed(config)
    batch = batch_of(9, 9)
    _, a_ex = extrinsic(before, batch, config)
    wanted = reference(before, batch, config)
    algorithm.update(batch)
    gradient = eta_gradient(before, state_of(algorithm))
    _, a_proxy = proxy(before["eta.parameters"], before, batch, config)
    last = frozen_step(before, batch, a_proxy, config)

    def outer(eta: Tensor) -> float:
        _, a = proxy(eta, before, batch, config)
        g = policy_gradient(wanted.theta_before.clone().requires_grad_(), a, batch, config).detach()
        return float(outer_objective(wanted.theta_before + last(g), batch, a_ex, config))

    for seed in range(3):
        direction = torch.randn(gradient.shape, generator=torch.Generator().manual_seed(seed)).double()
        direction = direction + gradient / gradient.norm() * direction.norm()
        h = 1e-5 / float(direction.norm())
        eta = before["eta.parameters"]
        slope = (outer(eta + h * direction) - outer(eta - h * direction)) / (2 * h)
        assert slope == pytest.approx(float(gradient @ direction), rel=1e-6)


def frozen_step(state: State, batch: Batch, a: Tensor, config: AlgorithmConfig) -> Callable[[Tensor], Tensor]:
    """The last policy step as a function of g, with the diagonal that it had."""
    precondition = Preconditioner(state, config)
    theta = state["policy.parameters"]
    for _ in range(config.policy_epochs):
        before = theta.detach().requires_grad_()
        g = policy_gradient(before, a, batch, config).detach().requires_grad_()
        step = precondition(g)
        theta = before + step
    c = config.policy_optimizer

    def clipped(g: Tensor) -> Tensor:
        return g * min(1.0, c.clip / float(g.norm()))

    # The step is affine in the clipped gradient; its slope is its own derivative along each coordinate.
    share = 1.0 if c.name == "rmsprop" else (1 - BETA_1) / (1 - BETA_1**precondition.steps)
    square = precondition.square / (1.0 if c.name == "rmsprop" else 1 - BETA_2**precondition.steps)
    diagonal = c.lr * share / (square.sqrt() + c.eps)
    constant = step.detach() - diagonal * clipped(g.detach())
    return lambda g: constant + diagonal * clipped(g)


def test_fresh_samples_judge_the_step_one_batch_later() -> None:
    config = config_of({"outer_samples": "fresh"})
    algorithm, before = warmed(config)
    first, second = batch_of(9, 9), batch_of(10, 10)
    algorithm.update(first)
    between = state_of(algorithm)
    algorithm.update(second)
    after = state_of(algorithm)

    # The step on `first` was made with the η that `first` had just improved, and with the critics before it.
    eta = between["eta.parameters"].clone().requires_grad_()
    _, theta = inner_steps(eta, before, first, config)
    close(theta.detach(), between["policy.parameters"], 1e-12)
    _, a_ex = extrinsic(between, second, config)
    (wanted,) = torch.autograd.grad(outer_objective(theta, second, a_ex, config), eta)
    close(eta_gradient(between, after), wanted, 1e-9)


def test_nothing_is_judged_before_fresh_samples_came() -> None:
    algorithm = make_algorithm(SPEC, config_of({"outer_samples": "fresh"}), 5, CPU, torch.float64)
    before = state_of(algorithm)
    metrics = algorithm.update(batch_of(0))
    assert torch.equal(state_of(algorithm)["eta.parameters"], before["eta.parameters"])
    assert "eta_gradient_norm" not in metrics


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-5), (torch.float32, 1e-3)])
def test_central_difference_comes_close_to_forward_mode(dtype: torch.dtype, rtol: float) -> None:
    gradients = []
    for mode in ("jvp", "difference"):
        algorithm = make_algorithm(SPEC, config_of({"meta_gradient": mode}), 5, CPU, dtype)
        before = state_of(algorithm)
        algorithm.update(batch_of(9))
        gradients.append(eta_gradient(before, state_of(algorithm)))
    assert not torch.equal(*gradients)
    close(gradients[1], gradients[0], rtol)


@pytest.mark.parametrize("control", [{"lambda": 0.0}, {"freeze_eta": True}])
def test_controls_leave_the_intrinsic_reward_alone(control: dict[str, object]) -> None:
    algorithm = make_algorithm(SPEC, config_of(control), 5, CPU, torch.float64)
    before = state_of(algorithm)
    for seed in range(3):
        algorithm.update(batch_of(seed, seed))
    after = state_of(algorithm)
    assert torch.equal(after["eta.parameters"], before["eta.parameters"])
    assert not torch.equal(after["policy.parameters"], before["policy.parameters"])


def test_without_lambda_the_policy_learns_as_if_there_were_no_intrinsic_reward() -> None:
    config = config_of({"lambda": 0.0})
    algorithm, other = (make_algorithm(SPEC, config, 5, CPU, torch.float64) for _ in range(2))
    state = state_of(other)
    load_state(other, state | {"eta.parameters": torch.randn_like(state["eta.parameters"])})
    for seed in range(2):
        for learner in (algorithm, other):
            learner.update(batch_of(seed, seed))
    assert equal_but_for_eta(state_of(algorithm), state_of(other))

    before, batch = state_of(algorithm), batch_of(9, 9)
    _, theta = inner_steps(torch.zeros_like(before["eta.parameters"]), before, batch, config)
    algorithm.update(batch)
    close(state_of(algorithm)["policy.parameters"], theta.detach(), 1e-12)


def equal_but_for_eta(a: State, b: State) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a if not name.startswith("eta."))
