"""1D Pursuit: the paper's reward, the endings, and the PettingZoo interface."""

from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from liir_common.pursuit import MOVES, REWARD, Pursuit, parallel_env

STAY, UP, DOWN = range(3)


def placed(positions: list[int], **options: Any) -> Pursuit:
    """A game in which the agents stand where the test wants them."""
    game = parallel_env(**options)
    game.reset(seed=0)
    game._positions = np.array(positions)
    return game


def move(game: Pursuit, first: int, second: int) -> tuple[Any, float, bool, bool]:
    observations, rewards, terminations, truncations, _ = game.step({"agent_0": first, "agent_1": second})
    assert len(set(rewards.values())) == 1
    return observations, rewards["agent_0"], terminations["agent_0"], truncations["agent_0"]


@pytest.mark.parametrize("ending", ["any", "all", "never"])
def test_pettingzoo_api(ending: Any) -> None:
    parallel_api_test(parallel_env(ending=ending), num_cycles=200)


def test_pettingzoo_seeding() -> None:
    parallel_seed_test(parallel_env, num_cycles=200)


@pytest.mark.parametrize(
    ("positions", "actions", "reward"),
    [
        ([3, -4], (DOWN, UP), REWARD),
        ([3, 4], (DOWN, DOWN), REWARD),
        ([3, -4], (UP, DOWN), -REWARD),
        ([3, -4], (UP, UP), 0),
        ([3, -4], (STAY, UP), 0),
        ([3, -4], (STAY, DOWN), 0),
        ([3, -4], (STAY, STAY), 0),
    ],
)
def test_team_is_paid_when_both_approach_and_pays_when_both_leave(
    positions: list[int], actions: tuple[int, int], reward: float
) -> None:
    assert move(placed(positions), *actions)[1] == reward


def test_observation_is_own_and_other_position_in_tens() -> None:
    game = placed([3, -4])
    observations, *_ = move(game, UP, UP)
    np.testing.assert_allclose(observations["agent_0"], [0.4, -0.3])
    np.testing.assert_allclose(observations["agent_1"], [-0.3, 0.4])
    np.testing.assert_allclose(game.state(), [0.4, -0.3])


@pytest.mark.parametrize(
    ("ending", "positions", "actions", "ends"),
    [
        ("any", [1, 5], (DOWN, STAY), True),
        ("any", [2, 5], (DOWN, STAY), False),
        ("all", [1, 5], (DOWN, STAY), False),
        ("all", [1, -1], (DOWN, UP), True),
        ("never", [1, -1], (DOWN, UP), False),
    ],
)
def test_the_target_ends_the_game(
    ending: str, positions: list[int], actions: tuple[int, int], ends: bool
) -> None:
    game = placed(positions, ending=ending)
    _, _, terminated, truncated = move(game, *actions)
    assert (terminated, truncated, bool(game.agents)) == (ends, False, not ends)


def test_the_horizon_ends_the_game() -> None:
    game = placed([10, 10], horizon=3)
    ends = [move(game, STAY, STAY)[2:] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    assert not game.agents


def test_a_bad_step_off_the_target_pays_unless_the_target_ends_the_game() -> None:
    # Why the default ending is "any": otherwise one agent's step away is the first half of a gain.
    game = placed([0, 1], ending="all")
    paid = [move(game, UP, STAY)[1], move(game, DOWN, DOWN)[1]]
    assert paid == [0, REWARD]


def test_starts_are_uniform_and_never_on_the_target() -> None:
    game = parallel_env(start=3)
    game.reset(seed=1)
    starts = []
    for _ in range(3000):
        game.reset()
        starts.extend((game.state() * 10).round().astype(int).tolist())
    values, counts = np.unique(starts, return_counts=True)
    assert values.tolist() == [-3, -2, -1, 1, 2, 3]
    # 5 degrees of freedom: 99.9 % of such samples are below 20.5.
    assert ((counts - 1000) ** 2 / 1000).sum() < 20.5


def test_distance_is_reported() -> None:
    game = placed([3, -4])
    *_, infos = game.step({"agent_0": UP, "agent_1": DOWN})
    assert infos["agent_0"] == infos["agent_1"] == {"distance": 9.0}


@pytest.mark.parametrize("options", [{"horizon": 0}, {"start": 0}, {"ending": "soon"}])
def test_refuses_impossible_options(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="pursuit wants horizon >= 1"):
        parallel_env(**options)


@pytest.mark.parametrize("action", [{}, {"agent_1": len(MOVES)}, {"agent_1": -1}])
def test_refuses_what_is_no_action(action: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="agent_1: wanted an action from 0 to 2"):
        placed([1, 1]).step({"agent_0": STAY} | action)
