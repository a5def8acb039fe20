"""The shared data: shapes, padding of a batch, and what it refuses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from liir_common import seeds
from liir_common.types import (
    TRAJECTORY_ARRAYS,
    Batch,
    EnvSpec,
    Exploration,
    Ticket,
    Trajectory,
    expected_shape,
    policy_shapes,
)
from tests.samples import trajectories_equal

SPEC = EnvSpec("battle/3m", "1", "{}", 3, 9, 30, 48, 60, ("won",))


def trajectory(episode_id: int, length: int, **changes: Any) -> Trajectory:
    """Values that name their episode, so that a misplaced row shows."""
    arrays = {
        name: np.full(expected_shape(name, SPEC, length), episode_id + 1).astype(dtype)
        for name, (dtype, _) in TRAJECTORY_ARRAYS.items()
    }
    ending = {"terminated": True, "truncated": False, "info": {"won": 1.0}}
    return Trajectory(episode_id, 4, **{**arrays, **ending, **changes})


@pytest.mark.parametrize(
    ("spec", "parameters"), [(SPEC, 28_297), (replace(SPEC, n_agents=8, n_actions=14, obs_dim=80), 32_462)]
)
def test_policy_has_the_size_of_the_paper(spec: EnvSpec, parameters: int) -> None:
    assert sum(int(np.prod(shape)) for shape in policy_shapes(spec, 64).values()) == parameters


def test_batch_keeps_every_step_and_pads_the_rest() -> None:
    lengths = [2, 5, 3]
    played = [trajectory(i, length) for i, length in enumerate(lengths)]
    batch = Batch.from_trajectories(played, 0.1)
    assert batch.policy_version == 4
    assert batch.env_steps == 10
    for name, (_, axes) in TRAJECTORY_ARRAYS.items():
        stacked = getattr(batch, name)
        assert stacked.shape == (3, *expected_shape(name, SPEC, 5))
        for i, length in enumerate(lengths):
            rows = length + (axes[0] == "T+1")
            assert (stacked[i, :rows] == getattr(played[i], name)).all()
            if name != "mask":
                assert not stacked[i, rows:].any()


def test_no_row_of_the_mask_is_empty_and_padding_has_action_0_only() -> None:
    mask = np.zeros((3, 3, 9), bool)
    mask[..., 4] = True
    batch = Batch.from_trajectories([trajectory(0, 2, mask=mask), trajectory(1, 6)], 0.1)
    assert batch.mask.any(-1).all()
    assert (batch.mask[0, :3] == mask).all()
    assert (batch.mask[0, 3:].argmax(-1) == 0).all()
    assert (batch.mask[0, 3:].sum(-1) == 1).all()


def test_flags_of_the_end_stand_at_the_last_step() -> None:
    ended = trajectory(0, 2)
    limited = trajectory(1, 4, terminated=False, truncated=True)
    batch = Batch.from_trajectories([ended, limited], 0.1)
    assert batch.filled.tolist() == [[True, True, False, False], [True] * 4]
    assert np.argwhere(batch.terminated).tolist() == [[0, 1]]
    assert np.argwhere(batch.truncated).tolist() == [[1, 3]]


def test_batch_has_the_declared_dtypes() -> None:
    batch = Batch.from_trajectories([trajectory(0, 2)], 0.1)
    assert batch.actions.dtype == np.int64
    assert {batch.obs.dtype, batch.state.dtype, batch.reward.dtype, batch.log_mu.dtype} == {
        np.dtype(np.float32)
    }
    assert {batch.mask.dtype, batch.filled.dtype, batch.alive.dtype} == {np.dtype(bool)}


@pytest.mark.parametrize(
    ("played", "message"),
    [
        ([], "at least one trajectory"),
        ([trajectory(1, 2), trajectory(0, 2)], r"ascending episode ids, got \[1, 0\]"),
        ([trajectory(1, 2), trajectory(1, 2)], r"ascending episode ids, got \[1, 1\]"),
        (
            [trajectory(0, 2), replace(trajectory(1, 2), policy_version=5)],
            r"one policy version, got \[4, 5\]",
        ),
    ],
)
def test_batch_refuses(played: list[Trajectory], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Batch.from_trajectories(played, 0.1)


def test_equality_of_trajectories_sees_every_field() -> None:
    one = trajectory(0, 3)
    assert trajectories_equal(one, trajectory(0, 3))
    for name in TRAJECTORY_ARRAYS:
        array = getattr(one, name).copy()
        array.flat[-1] = 1 - array.flat[-1]
        assert not trajectories_equal(one, replace(one, **{name: array}))
    assert not trajectories_equal(one, replace(one, log_mu=one.log_mu.astype(np.float64)))
    changes: list[dict[str, Any]] = [{"terminated": False}, {"policy_version": 1}, {"info": {"won": 0.0}}]
    for change in changes:
        assert not trajectories_equal(one, replace(one, **change))


def test_hash_of_a_spec_depends_on_every_field() -> None:
    changes: list[dict[str, Any]] = [
        {"name": "battle/8m"},
        {"version": "2"},
        {"options": '{"a":1}'},
        {"n_agents": 4},
        {"n_actions": 10},
        {"obs_dim": 31},
        {"state_dim": 49},
        {"episode_limit": 61},
        {"info_keys": ()},
    ]
    hashes = {SPEC.hash, *(replace(SPEC, **change).hash for change in changes)}
    assert len(hashes) == 1 + len(changes)
    assert replace(SPEC).hash == SPEC.hash


def test_seed_of_a_ticket_follows_from_run_and_episode() -> None:
    one = Ticket.for_training(1, 7, 0, Exploration.GREEDY, 0.0)
    later = Ticket.for_training(1, 7, 9, Exploration.SOFTMAX_FLOOR, 0.5)
    assert one.seed == later.seed == seeds.episode_seed(1, seeds.TRAINING, 7)
    assert one.seed != Ticket.for_training(2, 7, 0, Exploration.GREEDY, 0.0).seed
