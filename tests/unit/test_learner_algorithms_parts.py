"""The pieces of the learning rules: returns, the GRU's derivatives, optimisers, networks, batch rows."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import jit
from torch import Tensor

from liir_common.config import OptimizerConfig
from liir_common.types import Batch, EnvSpec
from services.learner.algorithms import gru, gru_compiled
from services.learner.algorithms.data import Data, prepare
from services.learner.algorithms.networks import AgentValue, fit_width, initial
from services.learner.algorithms.optim import Optimizer
from services.learner.algorithms.returns import explained_variance, lambda_return, normalize
from services.learner.bench import synthetic_batch

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

SPEC = EnvSpec("test", "1", "{}", 3, 4, 3, 5, 9, ())
CPU = torch.device("cpu")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def data_of(batch: Batch, limit_is_terminal: bool = True) -> Data:
    return prepare(batch, SPEC, limit_is_terminal=limit_is_terminal, device=CPU, dtype=torch.float64)


def test_returns_by_hand() -> None:
    # Two steps, γ = 1/2, λ_g = 1/2, then the end; the other episode is one step, bootstrapped from 4.
    reward = torch.tensor([[1.0, 2.0], [3.0, 99.0]]).unsqueeze(-1)
    value = torch.tensor([[10.0, 20.0, 0.0], [30.0, 4.0, 0.0]]).unsqueeze(-1)
    filled = torch.tensor([[1.0, 1.0], [1.0, 0.0]])
    returns = lambda_return(reward, value, filled, 0.5, 0.5)
    # G_1 = 2; G_0 = 1 + 1/2·(1/2·20 + 1/2·2) = 6.5; 3 + 1/2·4 = 5.
    assert returns[0, :, 0].tolist() == [6.5, 2.0]
    assert returns[1, 0, 0] == 5.0
    one_step = lambda_return(reward, value, filled, 0.5, 0.0)
    assert one_step[0, :, 0].tolist() == [11.0, 2.0]


def test_gae_equals_the_sum_over_all_pairs_of_steps() -> None:
    """A_t = Σ_k≥t (γλ)^(k-t) · δ_k, term by term, cut at the end of each episode."""
    gamma, lambda_g = 0.9, 0.7
    lengths, steps = [5, 3, 1], 5
    reward, value = random(3, steps, 2), random(3, steps + 1, 2, seed=1)
    filled = torch.zeros(3, steps, dtype=torch.float64)
    for b, length in enumerate(lengths):
        filled[b, :length] = 1
        value[b, length + (b == 1) :] = 0
    advantage = lambda_return(reward, value, filled, gamma, lambda_g) - value[:, :-1]
    for b, length in enumerate(lengths):
        for t in range(length):
            wanted = torch.zeros(2, dtype=torch.float64)
            for k in range(t, length):
                delta = reward[b, k] + gamma * value[b, k + 1] - value[b, k]
                wanted += (gamma * lambda_g) ** (k - t) * delta
            torch.testing.assert_close(advantage[b, t], wanted, rtol=1e-12, atol=1e-12)


def test_normalised_advantages_ignore_entries_without_weight() -> None:
    weight = torch.tensor([1.0, 1.0, 0.0, 1.0, 1.0])
    out = normalize(torch.tensor([1.0, 3.0, 1e6, 1.0, 3.0]), weight)
    assert out[[0, 1, 3, 4]].tolist() == pytest.approx([-1, 1, -1, 1], rel=1e-6)


def test_normalising_equal_advantages_stays_finite() -> None:
    advantage = torch.full((4,), 0.5, requires_grad=True)
    out = normalize(advantage, torch.ones(4))
    (gradient,) = torch.autograd.grad(out.sum(), advantage)
    assert out.tolist() == [0, 0, 0, 0]
    assert torch.isfinite(gradient).all()


def test_explained_variance() -> None:
    target = torch.tensor([1.0, 2.0, 3.0])
    assert explained_variance(target + 7, target) == 1
    assert explained_variance(torch.zeros(3), target) == 0
    assert explained_variance(-target, target) == -3


SIZES = [4, 4, 3, 1]


def reference_gru(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """torch's GRU on the packed sequence; `inputs` are gates already, so its input weights are the unit."""
    module = torch.nn.GRU(inputs.shape[1], weight.shape[1], dtype=inputs.dtype)
    parameters = {
        "weight_ih_l0": torch.eye(inputs.shape[1], dtype=inputs.dtype),
        "weight_hh_l0": weight,
        "bias_ih_l0": torch.zeros_like(bias),
        "bias_hh_l0": bias,
    }
    packed = torch.nn.utils.rnn.PackedSequence(inputs, torch.tensor(SIZES))
    out: Tensor = torch.func.functional_call(module, parameters, (packed,))[0].data
    return out


def run_gru(inputs: Tensor, weight: Tensor, bias: Tensor) -> gru.Trace:
    width = weight.shape[1]
    rz, n = bias.split([2 * width, width])
    return gru.forward(inputs + torch.cat([rz, torch.zeros_like(n)]), weight, n, SIZES)


def test_gru_and_its_derivatives_equal_torch() -> None:
    width = 5
    arguments = [random(sum(SIZES), 3 * width), random(3 * width, width, seed=1), random(3 * width, seed=2)]
    leaves = [x.clone().requires_grad_() for x in arguments]
    out = reference_gru(*leaves)
    trace = run_gru(*arguments)
    torch.testing.assert_close(trace.h, out.detach(), rtol=1e-12, atol=1e-12)

    cotangent = random(*out.shape, seed=3)
    wanted = torch.autograd.grad(out, leaves, cotangent)
    got = gru.backward(trace, arguments[1], cotangent.clone())
    for a, b in zip(got, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)

    tangents = [random(*x.shape, seed=4 + k) for k, x in enumerate(arguments)]
    recurrent = trace.previous @ tangents[1].t() + tangents[2]
    h_dot = gru.forward_derivative(trace, arguments[1], tangents[0], recurrent)
    both_ways = sum(float((g * t).sum()) for g, t in zip(wanted, tangents, strict=True))
    assert float((h_dot * cotangent).sum()) == pytest.approx(both_ways, rel=1e-12)


@pytest.mark.parametrize("threads", [1, 2, 9])
def test_compiled_gru_and_its_derivatives_equal_the_eager_ones(
    monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """With units left over from the unrolled loops, and with more threads than lives."""
    width, sizes = 13, [7, 7, 5, 2, 2, 1]
    rows = sum(sizes)

    def run(dtype: torch.dtype) -> list[Tensor]:
        inputs, weight, bias_n, grad_h, d_inputs, d_recurrent = (
            random(*shape, seed=k).to(dtype)
            for k, shape in enumerate(
                [(rows, 3 * width), (3 * width, width), (width,), (rows, width)] + [(rows, 3 * width)] * 2
            )
        )
        trace = gru.forward(inputs, weight, bias_n, sizes)
        gradients = gru.backward(trace, weight, grad_h)
        h_dot = gru.forward_derivative(trace, weight, d_inputs, d_recurrent)
        parts = [trace.h, trace.previous, trace.z, trace.to_n, trace.to_gates]
        return [*(x.clone() for x in parts), *gradients, h_dot]

    wanted = run(torch.float64)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    compiled = run(torch.float32)
    for a, b in zip(compiled, wanted, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=2e-5, atol=2e-5)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    assert all(torch.equal(a, b) for a, b in zip(compiled, run(torch.float32), strict=True))


def test_the_rows_of_the_compiled_gru_are_compiled_to_vectors() -> None:
    # Code from numba's cache cannot be inspected.
    step = gru_compiled._step
    compiled = jit(**step.targetoptions)(step.py_func)
    units, gates = (np.zeros(width, np.float32) for width in (64, 192))
    compiled(gates, gates.copy(), units, units.copy(), units.copy(), units.copy(), gates.copy())
    (code,) = compiled.inspect_llvm().values()
    assert len(re.findall(r"fdiv contract <\d+ x float>", code)) >= 3


@pytest.mark.parametrize("name", ["adam", "rmsprop"])
def test_optimiser_equals_torch(name: str) -> None:
    config = OptimizerConfig(name=name, lr=0.01, eps=1e-6, alpha=0.9, clip=1.0)
    ours, theirs = random(7), torch.nn.Parameter(random(7))
    optimizer = Optimizer(ours, config)
    reference = (
        torch.optim.Adam([theirs], 0.01, eps=1e-6, maximize=True)
        if name == "adam"
        else torch.optim.RMSprop([theirs], 0.01, 0.9, 1e-6, maximize=True)
    )
    for step in range(5):
        gradient = random(7, seed=step) * (0.1 if step % 2 else 10)
        theirs.grad = gradient * min(1.0, 1.0 / float(gradient.norm()))
        optimizer.ascend(gradient)
        reference.step()
        torch.testing.assert_close(ours, theirs.detach(), rtol=1e-12, atol=1e-14)


def test_agent_value_sees_state_and_id() -> None:
    network = AgentValue(SPEC, 6)
    flat = initial(network, 1.0, False, 3, CPU, torch.float64)
    state = random(2, SPEC.state_dim)
    ids = torch.eye(SPEC.n_agents, dtype=torch.float64).expand(2, -1, -1)
    x = torch.cat([state.unsqueeze(1).expand(-1, SPEC.n_agents, -1), ids], -1)
    wanted = super(AgentValue, network).__call__(flat, x).squeeze(-1)
    torch.testing.assert_close(network(flat, state), wanted, rtol=1e-12, atol=1e-12)
    assert wanted.std(1).min() > 0


def test_initial_parameters_depend_on_the_seed_alone() -> None:
    network = AgentValue(SPEC, 6)
    first = initial(network, 1.0, True, 3, CPU, torch.float32)
    torch.rand(5)
    assert torch.equal(first, initial(network, 1.0, True, 3, CPU, torch.float32))
    assert not torch.equal(first, initial(network, 1.0, True, 4, CPU, torch.float32))


def test_fit_width_takes_the_nearest() -> None:
    assert fit_width(100, lambda width: width**2) == 10
    assert fit_width(109, lambda width: width**2) == 10
    assert fit_width(112, lambda width: width**2) == 11


def test_rows_are_the_steps_of_lives() -> None:
    batch = synthetic_batch(SPEC, episodes=5, steps=6, seed=3)
    data = data_of(batch)
    w = batch.alive[:, :-1] & batch.filled[..., None]
    assert data.sizes == sorted(data.sizes, reverse=True)
    assert sorted(data.rows.tolist()) == np.flatnonzero(w).tolist()
    assert data.count == w.sum()
    for row, (index, x) in enumerate(zip(data.rows.tolist(), data.inputs, strict=True)):
        b, t, i = np.unravel_index(index, w.shape)
        obs, last, agent = x.split([SPEC.obs_dim, SPEC.n_actions, SPEC.n_agents])
        assert obs.tolist() == batch.obs[b, t, i].astype(np.float64).tolist()
        wanted = [float(t > 0 and a == batch.actions[b, t - 1, i]) for a in range(SPEC.n_actions)]
        assert last.tolist() == wanted
        assert agent.argmax() == i
        assert agent.sum() == 1
        assert data.actions[0, row] == batch.actions[b, t, i]
        assert data.floor[:, row].sum().item() == pytest.approx(batch.epsilon)
        assert ((data.floor[:, row] > 0).numpy() == batch.mask[b, t, i]).all()


@pytest.mark.parametrize("limit_is_terminal", [True, False])
def test_only_a_limit_that_is_no_end_is_bootstrapped(limit_is_terminal: bool) -> None:
    batch = synthetic_batch(SPEC, episodes=12, steps=6, seed=3)
    assert 0 < batch.truncated.sum() < 12
    data = data_of(batch, limit_is_terminal)
    dense = data.team(torch.ones(len(data.state), 1, dtype=torch.float64)).squeeze(-1).numpy()
    lengths = batch.filled.sum(1)
    wanted = (
        np.arange(dense.shape[1]) < (lengths + (batch.truncated.any(1) & (not limit_is_terminal)))[:, None]
    )
    assert (dense == wanted).all()
    assert (data.state[: data.played].numpy() == batch.state[:, :-1][batch.filled]).all()


def test_unusable_batches_are_refused() -> None:
    batch = synthetic_batch(SPEC, episodes=3, steps=6, seed=3)
    everyone = np.argwhere(batch.alive[:, :-1] & batch.filled[..., None])[0]
    no_action, closed = batch.mask.copy(), batch.mask.copy()
    no_action[tuple(everyone)] = False
    closed[(*everyone, batch.actions[tuple(everyone)])] = False
    closed[(*everyone, (batch.actions[tuple(everyone)] + 1) % SPEC.n_actions)] = True
    gap = batch.filled.copy()
    gap[1, 0] = False
    for wrong, message in [
        (replace(batch, mask=no_action), "mask without any"),
        (replace(batch, mask=closed), "available"),
        (replace(batch, actions=batch.actions + SPEC.n_actions), "available"),
        (replace(batch, filled=gap), r"episodes \[1\]"),
        (replace(batch, terminated=batch.terminated & False, truncated=batch.truncated & False), "end"),
        (replace(batch, alive=batch.alive & False), "nobody is alive"),
        (replace(batch, obs=batch.obs[..., 1:]), r"batch.obs wants shape .* got"),
    ]:
        with pytest.raises(ValueError, match=message):
            data_of(wrong)
