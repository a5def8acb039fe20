"""A battle played in one compiled call is the battle played through PettingZoo, bit for bit; and a
trajectory follows from its ticket and weights alone."""

import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from liir_common.battle.engine import STEPS
from liir_common.battle.observation import observe
from liir_common.config import EnvConfig
from liir_common.rollout import fused
from liir_common.rollout.play import make_player
from liir_common.rollout.player import Player
from liir_common.rollout.policy import random_weights
from liir_common.types import (
    TRAJECTORY_ARRAYS,
    Exploration,
    Ticket,
    Trajectory,
    Weights,
    expected_shape,
)
from tests.samples import trajectories_equal
from tests.unit.test_rollout_policy import TorchPolicy

HIDDEN = 64


def ticket(
    episode_id: int, exploration: Exploration = Exploration.SOFTMAX_FLOOR, epsilon: float = 0.3
) -> Ticket:
    return Ticket.for_training(11, episode_id, 0, exploration, epsilon)


def weights_for(player: Player, seed: int) -> Weights:
    """Four times the usual spread, so that policies have clear preferences and differ."""
    return {name: 4 * array for name, array in random_weights(player.spec, HIDDEN, seed).items()}


def loaded(env: EnvConfig) -> Player:
    player = make_player(env, HIDDEN)
    player.load(weights_for(player, seed=3))
    return player


def differences(one: Trajectory, other: Trajectory) -> list[str]:
    return [
        name for name in TRAJECTORY_ARRAYS if getattr(one, name).tobytes() != getattr(other, name).tobytes()
    ]


@pytest.mark.parametrize("exploration", list(Exploration))
@pytest.mark.parametrize(
    ("map_name", "options"),
    [("3m", {}), ("8m", {}), ("3m", {"reward_only_positive": False, "state_last_action": False})],
)
def test_fused_is_bit_for_bit_the_loop(
    map_name: str, options: dict[str, Any], exploration: Exploration
) -> None:
    env = EnvConfig(map=map_name, options=options)
    compiled, stepped = make_player(env, HIDDEN), make_player(env, HIDDEN, fused=False)
    assert compiled.spec == stepped.spec
    played = set()
    for episode_id in range(25):
        compiled.load(weights_for(compiled, episode_id))
        stepped.load(weights_for(stepped, episode_id))
        order = ticket(episode_id, exploration, epsilon=0.05 + 0.03 * episode_id)
        one, other = compiled.play(order), stepped.play(order)
        assert trajectories_equal(one, other), f"{order} differs in {differences(one, other)}"
        played.add(one.obs.tobytes())
    assert len(played) == 25


@pytest.mark.parametrize("map_name", ["3m", "8m"])
def test_torch_finds_log_mu_again_in_the_trajectory(map_name: str) -> None:
    """What an importance weight of 1 rests on: h starts at 0, the last action is that of the step before."""
    player = loaded(EnvConfig(map=map_name))
    reference = TorchPolicy(player.spec, weights_for(player, seed=3))
    for episode_id in range(5):
        played = player.play(ticket(episode_id, epsilon=0.1))
        last, hidden = np.full(player.spec.n_agents, -1), torch.zeros(player.spec.n_agents, HIDDEN)
        for t in range(played.length):
            with torch.no_grad():
                logits, hidden = reference(played.obs[t], last, hidden)
            available = torch.from_numpy(played.mask[t])
            softmax = torch.softmax(logits.masked_fill(~available, -torch.inf), 1)
            pi = 0.9 * softmax + 0.1 * available / available.sum(1, keepdim=True)
            last = played.actions[t].astype(int)
            log_pi = pi.gather(1, torch.from_numpy(last)[:, None])[:, 0].log()
            np.testing.assert_allclose(played.log_mu[t], log_pi.numpy(), atol=2e-5)


def test_trajectory_has_the_declared_shapes_and_one_end() -> None:
    player = loaded(EnvConfig(map="3m"))
    for episode_id in range(50):
        played = player.play(ticket(episode_id))
        for name, (dtype, _) in TRAJECTORY_ARRAYS.items():
            array = getattr(played, name)
            assert array.dtype == dtype
            assert array.shape == expected_shape(name, player.spec, played.length)
            assert array.flags.c_contiguous
            assert array.flags.owndata
        assert played.terminated or played.truncated
        assert played.length <= player.spec.episode_limit
        assert set(played.info) == set(player.spec.info_keys)
        available = np.take_along_axis(played.mask[:-1], played.actions[..., None].astype(int), -1)
        assert available.all()


def test_a_ticket_plays_the_same_whatever_was_played_before() -> None:
    player, fresh = loaded(EnvConfig(map="3m")), loaded(EnvConfig(map="3m"))
    first = player.play(ticket(0))
    for episode_id in range(1, 20):
        player.play(ticket(episode_id))
    assert trajectories_equal(player.play(ticket(0)), first)
    assert trajectories_equal(fresh.play(ticket(0)), first)


def test_tickets_differ_in_what_they_play() -> None:
    player = loaded(EnvConfig(map="3m"))
    played = {player.play(ticket(episode_id)).obs.tobytes() for episode_id in range(50)}
    assert len(played) == 50


def test_a_trajectory_is_not_changed_by_the_next_episode() -> None:
    player = loaded(EnvConfig(map="3m"))
    first = player.play(ticket(0))
    before = {name: getattr(first, name).tobytes() for name in TRAJECTORY_ARRAYS}
    player.play(ticket(1))
    assert before == {name: getattr(first, name).tobytes() for name in TRAJECTORY_ARRAYS}


def test_threads_play_the_same_bytes() -> None:
    def episodes(player: Player) -> list[Trajectory]:
        return [player.play(ticket(episode_id)) for episode_id in range(200)]

    here = episodes(loaded(EnvConfig(map="3m")))
    with ThreadPoolExecutor(2) as pool:
        for there in pool.map(episodes, [loaded(EnvConfig(map="3m")) for _ in range(2)]):
            assert all(trajectories_equal(one, other) for one, other in zip(here, there, strict=True))


PLAY_ELSEWHERE = """
from tests.unit.test_rollout_fused import EnvConfig, digest, loaded, ticket
player = loaded(EnvConfig(map="3m"))
print(*(digest(player.play(ticket(i))) for i in (5, 2, 7)))
"""


def digest(trajectory: Trajectory) -> str:
    arrays = b"".join(getattr(trajectory, name).tobytes() for name in TRAJECTORY_ARRAYS)
    return hashlib.sha256(arrays + repr(trajectory.info).encode()).hexdigest()


def test_another_process_plays_the_same_bytes() -> None:
    player = loaded(EnvConfig(map="3m"))
    here = [digest(player.play(ticket(i))) for i in (5, 2, 7)]
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", PLAY_ELSEWHERE]
    there = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    assert there.stdout.split() == here


def test_an_agent_without_action_is_named_with_its_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def forgetful(tables: Any, battle: Any, obs: Any, state: Any, mask: Any, alive: Any) -> None:
        observe(tables, battle, obs, state, mask, alive)
        mask[1] &= battle.status[STEPS] < 4

    # The battle always leaves an action; so the episode is run uncompiled, with an observe that does not.
    monkeypatch.setattr(fused, "observe", forgetful)
    monkeypatch.setattr(fused, "_play_episode", fused._play_episode.py_func)
    player = loaded(EnvConfig(map="3m"))
    with pytest.raises(ValueError, match="step 4: agent 1 has no available action"):
        player.play(ticket(0))


def test_the_interpreter_is_free_while_a_battle_is_played() -> None:
    assert fused._play_episode.targetoptions["nogil"]


def test_dead_agents_come_from_the_simulator() -> None:
    player = loaded(EnvConfig(map="3m"))
    fallen = [t for t in (player.play(ticket(i)) for i in range(20)) if not t.alive.all()]
    assert fallen
    for played in fallen:
        dead = ~played.alive
        assert (played.mask[dead].argmax(-1) == 0).all()
        assert (played.mask[dead].sum(-1) == 1).all()
        assert not played.log_mu[dead[:-1]].any()
        assert played.info["dead_allies"] == dead[-1].sum()


def test_weights_decide_and_reloading_brings_them_back() -> None:
    player = loaded(EnvConfig(map="3m"))
    greedy = replace(ticket(0), exploration=Exploration.GREEDY)
    first = player.play(greedy)
    player.load(weights_for(player, seed=99))
    assert not trajectories_equal(player.play(greedy), first)
    player.load(weights_for(player, seed=3))
    assert trajectories_equal(player.play(greedy), first)


def test_options_reach_the_simulator() -> None:
    positive = loaded(EnvConfig(map="3m", options={"reward_only_positive": True}))
    negative = loaded(EnvConfig(map="3m", options={"reward_only_positive": False}))
    assert all(positive.play(ticket(i)).reward.min() >= 0 for i in range(10))
    assert any(negative.play(ticket(i)).reward.min() < 0 for i in range(10))
    with pytest.raises(ValueError, match="no_such_option"):
        make_player(EnvConfig(map="3m", options={"no_such_option": 1}))
