"""What the rest of the service counts on, for every method: state, determinism, indifference to padding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from liir_common.config import METHOD_PRESETS, PRESETS, AlgorithmConfig, EnvConfig
from liir_common.rollout.play import make_player
from liir_common.types import Batch, EnvSpec, Ticket, Weights, policy_shapes
from services.learner.algorithms import Algorithm, gru, gru_eager, make_algorithm
from services.learner.algorithms.networks import views
from services.learner.bench import bench_learner, synthetic_batch
from tests.states import load_state, state_of

# On products this small a second thread only waits, and it spins while it does.
torch.set_num_threads(1)

SPEC = EnvSpec("test", "1", "{}", 3, 4, 3, 5, 9, ())
CPU = torch.device("cpu")
REPLAY = {"episodes": 20, "batch_episodes": 5, "episodes_per_update": 4}
METHODS: dict[str, dict[str, object]] = {
    "liir": {"lambda": 1.0, "r_in_gain": 1.0},
    "liir fresh": {"lambda": 1.0, "outer_samples": "fresh"},
    "liir paper": PRESETS["paper"]["algorithm"] | {"lambda": 1.0, "target_interval": 3},
    "liir difference": {"lambda": 1.0, "meta_gradient": "difference"},
    "central_v": {"name": "central_v"},
    "central_v bootstrapped": {"name": "central_v", "limit_is_terminal": False},
    "iac": {"name": "iac"},
    "iac bootstrapped": {"name": "iac", "limit_is_terminal": False},
    "coma": METHOD_PRESETS["coma"] | {"name": "coma", "target_interval": 3},
    "coma strong": {"name": "coma"},
    "iql": METHOD_PRESETS["iql"] | {"name": "iql", "replay": REPLAY, "target_interval": 3},
    "vdn": METHOD_PRESETS["vdn"] | {"name": "vdn", "replay": REPLAY, "target_interval": 0},
    "qmix": METHOD_PRESETS["qmix"] | {"name": "qmix", "replay": REPLAY},
    "qmix bootstrapped": {"name": "qmix", "replay": REPLAY, "limit_is_terminal": False},
}
VALUE_BASED = {name for name in METHODS if name.startswith(("iql", "vdn", "qmix"))}
ON_POLICY = sorted(METHODS.keys() - VALUE_BASED)


def make(method: str, seed: int = 5) -> Algorithm:
    config = AlgorithmConfig.model_validate({"policy_hidden": 8, "policy_gain": 1.0} | METHODS[method])
    return make_algorithm(SPEC, config, seed, CPU)


def batch_of(seed: int) -> Batch:
    return synthetic_batch(SPEC, episodes=6, steps=6, seed=seed, policy_version=seed, epsilon=0.2)


def copy(source: Algorithm, into: Algorithm) -> None:
    """What the learner does when it resumes."""
    into.load_state(source.state())
    if source.replay is not None:
        into.replay.extend(source.replay.first, source.replay.frames(source.replay.first))


def assert_equal_states(a: Algorithm, b: Algorithm, *, but_for: str = "nothing") -> None:
    x, y = ({k: v for k, v in s.items() if not k.startswith(but_for)} for s in (state_of(a), state_of(b)))
    assert x.keys() == y.keys()
    assert [name for name in x if not torch.equal(x[name], y[name])] == []


@pytest.mark.parametrize("method", METHODS)
def test_the_policy_is_announced_once_and_stays_as_it_was_then(method: str) -> None:
    algorithm = make(method)
    announced: list[Weights] = []
    for seed in range(3):
        before = algorithm.policy()
        algorithm.update(batch_of(seed), announced.append)
        after = algorithm.policy()
        assert len(announced) == seed + 1
        assert [name for name in after if not np.array_equal(announced[-1][name], after[name])] == []
    assert any(not np.array_equal(before[name], after[name]) for name in after)


@pytest.mark.parametrize("method", METHODS)
def test_going_on_from_a_saved_state_equals_never_having_stopped(method: str) -> None:
    straight = make(method)
    for seed in range(4):
        straight.update(batch_of(seed))
    saved = state_of(straight)
    resumed = make(method, seed=6)
    for seed in range(2):
        resumed.update(batch_of(seed))
    copy(straight, resumed)
    assert_equal_states(straight, resumed)
    for seed in range(4, 8):
        assert straight.update(batch_of(seed)) == resumed.update(batch_of(seed))
        assert_equal_states(straight, resumed)
    assert any(not torch.equal(saved[name], value) for name, value in state_of(straight).items())


@pytest.mark.parametrize("method", METHODS)
def test_a_saved_state_is_a_copy(method: str) -> None:
    algorithm = make(method)
    algorithm.update(batch_of(0))
    saved = state_of(algorithm)
    kept = {name: value.clone() for name, value in saved.items()}
    algorithm.update(batch_of(1))
    assert all(torch.equal(saved[name], kept[name]) for name in saved)


def test_states_of_something_else_are_refused() -> None:
    algorithm = make("liir")
    before = state_of(algorithm)
    other_shape = before | {"phi.parameters": torch.zeros(3)}
    without = {name: value for name, value in before.items() if name != "eta.optimizer.mean"}
    other_type = before | {"phi.parameters": before["phi.parameters"].double()}
    fresh = make("liir fresh")
    fresh.update(batch_of(0))
    for state, message in [
        (state_of(make("central_v")), "missing .*eta.parameters"),
        (without, r"missing \['eta.optimizer.mean'\]"),
        (other_shape, r"phi.parameters wants .* got \(\(3,\)"),
        (other_type, "float64"),
        (state_of(fresh), "unknown .*pending"),
    ]:
        with pytest.raises(ValueError, match=message):
            load_state(algorithm, state)
    after = state_of(algorithm)
    assert all(torch.equal(before[name], after[name]) for name in before)


def with_garbage(batch: Batch, *, dead: bool, bootstraps: bool) -> Batch:
    """The batch with other values wherever nothing was played and, if `dead`, in the rows of the dead.

    A terminal state is not looked at either, nor are observations and masks of any last row unless a method
    `bootstraps` from them.
    """
    rng = np.random.default_rng(0)
    lengths = batch.filled.sum(1)
    rows = np.arange(batch.filled.shape[1] + 1)
    after = rows >= lengths[:, None]
    beyond = rows > lengths[:, None]
    ended = beyond | (after & ~batch.truncated.any(1)[:, None])
    agents = (ended if bootstraps else after)[..., None] | (~batch.alive if dead else False)

    def garbage(array: np.ndarray, where: np.ndarray) -> np.ndarray:
        out = array.copy()
        noise = rng.integers(2, 50, array.shape)
        where = where.reshape(where.shape + (1,) * (array.ndim - where.ndim))
        np.copyto(out, noise.astype(array.dtype), where=np.broadcast_to(where, array.shape))
        return out

    return replace(
        batch,
        obs=garbage(batch.obs, agents),
        state=garbage(batch.state, ended),
        mask=garbage(batch.mask, agents),
        alive=garbage(batch.alive, ended if bootstraps else after),
        actions=garbage(batch.actions, agents[:, :-1]) % SPEC.n_actions,
        log_mu=garbage(batch.log_mu, agents[:, :-1]),
        reward=garbage(batch.reward, after[:, :-1]),
    )


@pytest.mark.parametrize(
    ("method", "dead"), [(method, dead) for method in METHODS for dead in {False, method in ON_POLICY}]
)
def test_garbage_after_the_mask_changes_nothing(method: str, dead: bool) -> None:
    """The values of the dead go on, so that where values are learned what they observe counts."""
    clean, dirty = make(method), make(method)
    for seed in range(3):
        batch = batch_of(seed)
        garbage = with_garbage(batch, dead=dead, bootstraps="bootstrapped" in method)
        assert not np.array_equal(batch.obs, garbage.obs)
        assert clean.update(batch) == dirty.update(garbage)
        assert clean.policy()["fc1.weight"].tobytes() == dirty.policy()["fc1.weight"].tobytes()
    assert_equal_states(clean, dirty, but_for="pending.batch")


@pytest.mark.parametrize("method", METHODS)
def test_a_life_may_have_a_gap(method: str) -> None:
    """What happens within it matters to the GRU, but what was done there counts for nothing."""
    batch = batch_of(1)
    b, t, i = (int(x[0]) for x in np.nonzero(batch.alive[:, 2:-1] & batch.filled[:, 2:, None]))
    alive = batch.alive.copy()
    alive[b, t + 1, i] = False
    assert alive[b, t + 2, i]
    batch = replace(batch, alive=alive)
    log_mu, mask = batch.log_mu.copy(), batch.mask.copy()
    log_mu[b, t + 1, i] = -3
    mask[b, t + 1, i] = False
    clean, dirty = make(method), make(method)
    assert clean.update(batch) == dirty.update(replace(batch, log_mu=log_mu, mask=mask))
    assert_equal_states(clean, dirty, but_for="pending.batch")


@pytest.mark.parametrize("method", METHODS)
def test_the_dead_still_teach_the_values(method: str) -> None:
    """The team's reward goes on after an agent's death, so its steps are in the critics' targets."""
    batch = batch_of(2)
    alive = batch.alive.copy()
    alive[:, 3:, 1:] = False
    batch = replace(batch, alive=alive, mask=batch.mask | ~alive[..., None])
    late = batch.reward.copy()
    late[:, 3:] += batch.filled[:, 3:]
    other, base = make(method), make(method)
    base.update(batch)
    other.update(replace(batch, reward=late))
    names = [
        name for name in ("phi.parameters", "varphi.parameters", "q.parameters") if name in state_of(base)
    ]
    assert names
    assert not any(torch.equal(state_of(base)[name], state_of(other)[name]) for name in names)


@pytest.mark.parametrize(
    ("method", "part"), [("liir paper", "phi"), ("liir paper", "varphi"), ("coma", "varphi"), ("iql", "q")]
)
def test_targets_are_copied_at_every_interval(method: str, part: str) -> None:
    algorithm = make(method)
    followed = []
    for seed in range(7):
        algorithm.update(batch_of(seed))
        state = state_of(algorithm)
        followed.append(torch.equal(state[f"{part}.target"], state[f"{part}.parameters"]))
    assert followed == [False, False, True, False, False, True, False]


@pytest.mark.parametrize("method", METHODS)
def test_equal_seeds_learn_equally_and_leave_global_randomness_alone(method: str) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = make(method)
    first.update(batch_of(0))
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(2)
    second = make(method)
    second.update(batch_of(0))
    assert_equal_states(first, second)
    assert not np.array_equal(first.policy()["fc1.weight"], make(method, seed=6).policy()["fc1.weight"])


def test_an_update_without_compiled_recurrences_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU has none of them."""
    compiled, eager = make("liir"), make("liir")
    before = state_of(compiled)
    figures = compiled.update(batch_of(0))
    monkeypatch.setattr(gru, "_recurrences", lambda tensor: gru_eager)
    assert eager.update(batch_of(0)) == pytest.approx(figures, rel=1e-4)
    wanted, got = state_of(compiled), state_of(eager)
    assert not torch.equal(got["policy.parameters"], wanted["policy.parameters"]), "both went the same way"
    for name, value in wanted.items():
        assert (got[name] - value).double().norm() <= 1e-4 * (value - before[name]).double().norm(), name


@pytest.mark.parametrize("method", METHODS)
def test_policy_has_the_agreed_names_shapes_and_type(method: str) -> None:
    algorithm = make(method)
    weights = algorithm.policy()
    assert {name: array.shape for name, array in weights.items()} == policy_shapes(SPEC, 8)
    assert {array.dtype for array in weights.values()} == {np.dtype(np.float32)}
    kept = weights["fc1.weight"].copy()
    algorithm.update(batch_of(0))
    assert np.array_equal(weights["fc1.weight"], kept)
    assert bool(algorithm.intrinsic()) == method.startswith("liir")


@pytest.mark.parametrize("method", METHODS)
def test_a_refused_batch_changes_nothing(method: str) -> None:
    algorithm = make(method)
    algorithm.update(batch_of(0))
    before = state_of(algorithm)
    with pytest.raises(ValueError, match="mask without any"):
        algorithm.update(replace(batch_of(1), mask=np.zeros_like(batch_of(1).mask)))
    after = state_of(algorithm)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert algorithm.replay is None or algorithm.replay.total == 6


@pytest.mark.parametrize("method", ["liir", "coma", "qmix"])
def test_divergence_is_an_error(method: str) -> None:
    algorithm = make(method)
    batch = batch_of(0)
    with pytest.raises(FloatingPointError, match="diverged"):
        algorithm.update(replace(batch, reward=batch.reward + np.float32(np.inf)))


def test_a_single_step_on_its_own_episodes_clips_nothing() -> None:
    """The actors' kernel and the learner's products round differently, which is no clipping."""
    player = make_player(EnvConfig(map="3m"))
    settings = {"name": "central_v", "policy_epochs": 1, "ratio_bound": 1.0}
    config = AlgorithmConfig.model_validate(settings)
    algorithm = make_algorithm(player.spec, config, 5, CPU)
    player.load(algorithm.policy())
    tickets = [Ticket.for_training(1, i, 0, config.behaviour, epsilon=0.1) for i in range(8)]
    batch = Batch.from_trajectories([player.play(ticket) for ticket in tickets], epsilon=0.1)
    assert algorithm.update(batch)["clip_fraction"] == 0


@pytest.mark.parametrize("method", ON_POLICY)
def test_a_saturated_policy_is_seen_in_its_hidden_std(method: str) -> None:
    algorithm = make(method)
    assert algorithm.update(batch_of(0))["policy_hidden_std"] > 0.03
    state = state_of(algorithm)
    _, z, n = views(state["policy.parameters"], policy_shapes(SPEC, 8))["gru.bias_ih"].chunk(3)
    z.fill_(-50)
    n.fill_(50)  # h = tanh(n) from the first step on
    load_state(algorithm, state)
    assert algorithm.update(batch_of(1))["policy_hidden_std"] < 0.001


def test_the_reward_ratio_is_left_out_where_no_extrinsic_reward_came() -> None:
    batch = batch_of(0)
    assert "reward_ratio" in make("liir").update(batch)
    assert "reward_ratio" not in make("liir").update(replace(batch, reward=batch.reward * 0))


SIZES = {
    # map: agents, actions, observation, state, then θ and budget
    "3m": (3, 9, 30, 21, 28297, 31625),
    "8m": (8, 14, 80, 56, 32462, 65550),
    "2s3z": (5, 11, 80, 65, 31883, 51339),
    "3s5z": (8, 14, 128, 104, 35534, 77838),
}


@pytest.mark.parametrize("name", ["liir", "central_v", "iac", "coma"])
@pytest.mark.parametrize("battle", SIZES)
def test_parameters_meet_the_budget(battle: str, name: str) -> None:
    n, actions, obs, state, theta, budget = SIZES[battle]
    spec = EnvSpec(battle, "1", "{}", n, actions, obs, state, 60, ())
    algorithm = make_algorithm(spec, AlgorithmConfig(name=name), 1, CPU)
    counts = algorithm.parameter_counts()
    assert counts["theta"] == theta == sum(w.size for w in algorithm.policy().values())
    assert counts["budget"] == budget
    beside_theta = [size for part, size in counts.items() if part not in ("theta", "budget")]
    assert sum(beside_theta) == pytest.approx(budget, rel=0 if name == "coma" else 0.01)
    assert sum(w.size for w in algorithm.intrinsic().values()) == counts.get("eta", 0)
    trained = [v.numel() for key, v in state_of(algorithm).items() if key.endswith(".parameters")]
    assert sorted(trained) == sorted([theta, *beside_theta])


@pytest.mark.parametrize(("name", "mixer"), [("iql", 0), ("vdn", 0), ("qmix", 12577)])
def test_value_based_methods_count_their_mixer(name: str, mixer: int) -> None:
    n, actions, obs, state, theta, _ = SIZES["3m"]
    spec = EnvSpec("3m", "1", "{}", n, actions, obs, state, 60, ())
    counts = make_algorithm(spec, AlgorithmConfig(name=name), 1, CPU).parameter_counts()
    assert counts == {"theta": theta, "mixer": mixer}


def test_the_bench_counts_what_is_computed() -> None:
    config = AlgorithmConfig(name="central_v", policy_epochs=1, critic_epochs=1, policy_hidden=8)
    once = bench_learner(config, SPEC, episodes=4, steps=6, threads=(1,), repeats=2)
    more = config.model_copy(update={"policy_epochs": 3})
    thrice = bench_learner(more, SPEC, episodes=4, steps=6, threads=(1,), repeats=2)
    batch = synthetic_batch(SPEC, 4, 6, seed=0)
    rows = int((batch.alive[:, :-1] & batch.filled[..., None]).sum())
    # Per row and multiply-add: forward, and backward without the gradient by the inputs of the first layer.
    first, rest = 10 * 8, 2 * 24 * 8 + 8 * 4
    assert (thrice["flops"] - once["flops"]) / 2 == pytest.approx(2 * rows * (2 * first + 3 * rest), rel=0.05)
    figures = once["threads"][1]
    assert figures["ratio"] == pytest.approx(figures["update_ms"] / figures["floor_ms"])
