"""A batch as the learner computes on it: tensors on the device, without padding and without dead agents."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from liir_common.types import TRAJECTORY_ARRAYS, Batch, EnvSpec, expected_shape


@dataclass(frozen=True)
class Data:
    """Agents' rows and team rows of a batch.

    The R agents' rows are the steps of every life, the dead time after it left out, packed as `gru` wants
    them. The team rows are the M played steps followed by the states to bootstrap from, M' in all.
    """

    epsilon: float
    n_agents: int
    sizes: list[int]
    """Lives that have a step t, for t = 0, 1, ...; never grows, sums to R"""
    rows: Tensor
    """[R], index into [B, T, n] flattened"""
    inputs: Tensor
    """[R, O + A + n]: observation, one-hot last action (zeros at the start), one-hot agent id"""
    local: Tensor
    """[R, O + n]: observation, one-hot agent id"""
    floor: Tensor
    """[A, R], ε / available actions, 0 where an action is not available"""
    closed: Tensor
    """[A, R], 0 where an action is available and else -∞"""
    actions: Tensor
    """[1, R]"""
    log_mu: Tensor
    """[R]"""
    weight: Tensor
    """[R], w: 1 where the agent is alive, 0 in gaps of a life; as no step follows the end of an episode,
    filled · (1 - terminated[t-1]) · alive comes to this"""
    count: float
    """N = Σ w"""
    reward: Tensor
    """[B, T, 1], r_ex"""
    filled: Tensor
    """[B, T], m: 1 where the step was played"""
    state: Tensor
    """[M', S]"""
    steps: Tensor
    """[M'], index into [B, T+1] flattened"""
    played: int
    """M"""

    def agents(self, values: Tensor) -> Tensor:
        """Agents' rows [R] of `values` [B, T, n], or [B, T, 1] where the team shares them."""
        return values.expand(*self.filled.shape, self.n_agents).reshape(-1).index_select(0, self.rows)

    def lives(self, values: Tensor) -> Tensor:
        """[B, T, n] from agents' rows [R], zero elsewhere."""
        out = values.new_zeros(self.filled.numel() * self.n_agents)
        return out.index_copy(0, self.rows, values).view(*self.filled.shape, self.n_agents)

    def team(self, values: Tensor) -> Tensor:
        """[B, T+1, k] from team rows [M', k], zero elsewhere: after an end there is nothing to come."""
        episodes, steps = self.filled.shape
        out = values.new_zeros(episodes * (steps + 1), values.shape[1])
        return out.index_copy(0, self.steps, values).view(episodes, steps + 1, -1)

    def mean(self, values: Tensor) -> Tensor:
        """(1/N) Σ w · values over agents' rows [R]."""
        return (self.weight * values).sum() / self.count


def prepare(
    batch: Batch, spec: EnvSpec, *, limit_is_terminal: bool, device: torch.device, dtype: torch.dtype
) -> Data:
    """Gather what counts of `batch` onto `device`.

    With `limit_is_terminal` the step limit is an end like any other; otherwise the state after it is
    bootstrapped from.

    Raises:
        ValueError: as `check`.
    """
    check(batch, spec)
    order, lengths = _lives(batch)
    t, rank = np.nonzero(np.arange(lengths[0])[:, None] < lengths)
    b, i = np.divmod(order[rank], spec.n_agents)
    alive = batch.alive[b, t, i]
    mask, actions = batch.mask[b, t, i], batch.actions[b, t, i]
    # A gap in a life may have any mask; no row may leave the softmax without an action.
    mask = mask | ~alive[:, None]

    counts = np.pad(batch.filled, ((0, 0), (0, 1)))
    cut = batch.truncated & ~batch.terminated
    bootstraps = np.pad(cut & (not limit_is_terminal), ((0, 0), (1, 0)))
    steps = np.concatenate([np.flatnonzero(counts), np.flatnonzero(bootstraps)])

    def floats(array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device, dtype)

    def as_is(array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(array).to(device)

    obs = batch.obs[b, t, i]
    ids = np.eye(spec.n_agents, dtype=np.float32)[i]
    return Data(
        epsilon=batch.epsilon,
        n_agents=spec.n_agents,
        sizes=np.bincount(t).tolist(),
        rows=as_is((b * batch.reward.shape[1] + t) * spec.n_agents + i),
        inputs=floats(np.concatenate([obs, _last_actions(batch, b, t, i, spec.n_actions), ids], 1)),
        local=floats(np.concatenate([obs, ids], 1)),
        floor=floats((batch.epsilon * mask / mask.sum(1, keepdims=True)).T),
        closed=floats(np.where(mask.T, 0.0, -np.inf)),
        actions=as_is(actions[None]),
        log_mu=floats(batch.log_mu[b, t, i]),
        weight=floats(alive),
        count=float(alive.sum()),
        reward=floats(np.where(batch.filled, batch.reward, 0)[..., None]),
        filled=floats(batch.filled),
        state=floats(batch.state.reshape(-1, spec.state_dim)[steps]),
        steps=as_is(steps),
        played=int(batch.filled.sum()),
    )


def _lives(batch: Batch) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The agents (b·n + i) that live at all, longest life first, and the lengths of their lives."""
    steps = batch.reward.shape[1]
    lives = (batch.alive[:, :-1] & batch.filled[..., None]).transpose(0, 2, 1).reshape(-1, steps)
    lengths = np.where(lives, np.arange(1, steps + 1), 0).max(1)
    order = np.argsort(-lengths, kind="stable")[: np.count_nonzero(lengths)]
    return order, lengths[order]


def _last_actions(
    batch: Batch, b: NDArray[np.int64], t: NDArray[np.int64], i: NDArray[np.int64], n_actions: int
) -> NDArray[np.float32]:
    """One-hot actions of the step before, zeros at the start."""
    before = np.eye(n_actions, dtype=np.float32)[batch.actions[b, t - 1, i]]
    before[t == 0] = 0
    return before


def observations(batch: Batch, data: Data) -> Tensor:
    """What every agent observes in the team rows of `data`, which come from `batch`: [M', n, O], zero for
    the dead."""
    steps = data.steps.cpu().numpy()
    obs, alive = (array.reshape(-1, *array.shape[2:])[steps] for array in (batch.obs, batch.alive))
    return torch.from_numpy(obs * alive[..., None]).to(data.state)


def check(batch: Batch, spec: EnvSpec) -> None:
    """See that one can learn from `batch`.

    Raises:
        ValueError: shapes differ from `spec`, an episode is not a filled prefix with an end at its last
            step, nobody is alive, or a living agent has no action or took one that was not available.
    """
    _check_episodes(batch, spec)
    alive = batch.alive[:, :-1] & batch.filled[..., None]
    if not alive.any():
        episodes, _, n = alive.shape
        raise ValueError(
            f"a batch wants a living agent; in {episodes} episodes of {n} agents nobody is alive"
        )
    _check_actions(batch.mask[:, :-1][alive], batch.actions[alive])


def _check_episodes(batch: Batch, spec: EnvSpec) -> None:
    episodes, steps = batch.reward.shape
    for name in TRAJECTORY_ARRAYS:
        wanted, got = (episodes, *expected_shape(name, spec, steps)), getattr(batch, name).shape
        if wanted != got:
            raise ValueError(f"batch.{name} wants shape {wanted} for {spec.name}, got {got}")
    lengths = batch.filled.sum(1)
    last = np.arange(steps) == lengths[:, None] - 1
    prefix = np.arange(steps) < lengths[:, None]
    wrong = (
        (lengths == 0)
        | ((batch.terminated | batch.truncated) != last).any(1)
        | (batch.filled != prefix).any(1)
    )
    if wrong.any():
        raise ValueError(
            "an episode wants its steps filled from the first on and an end (terminated, truncated) at the "
            f"last alone; episodes {np.flatnonzero(wrong).tolist()} of the batch differ"
        )


def _check_actions(mask: NDArray[np.bool_], actions: NDArray[np.int64]) -> None:
    """`mask` [k, A] and `actions` [k] of the living."""
    if not mask.any(1).all():
        raise ValueError("a living agent wants at least one available action, got a mask without any")
    if (
        actions.min() < 0
        or actions.max() >= mask.shape[1]
        or not np.take_along_axis(mask, actions[:, None], 1).all()
    ):
        raise ValueError(
            f"actions want to be available and in [0, {mask.shape[1]}); a living agent took one that is not"
        )
