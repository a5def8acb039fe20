"""`env.kind: smac` on a stand-in for SMAC's package that plays our battles: both must be told alike."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from liir_common.battle.env import battle_spec, parallel_env
from liir_common.config import EnvConfig
from liir_common.errors import ConfigError, EpisodeLostError
from liir_common.rollout.fused import FusedPlayer
from liir_common.rollout.loop import LoopPlayer
from liir_common.rollout.play import env_spec, make_player
from liir_common.rollout.policy import random_weights
from liir_common.smac import SmacEnv
from liir_common.types import Exploration, Ticket
from tests.samples import trajectories_equal

STAND_IN = str(Path(__file__).parents[1] / "stand_in")
OPTIONS: dict[str, Any] = {"reward_only_positive": False, "state_last_action": False}


def forget_smac() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "smac"]:
        del sys.modules[name]


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The stand-in under SMAC's name."""
    forget_smac()
    monkeypatch.syspath_prepend(STAND_IN)
    yield
    forget_smac()


def tickets(first_seed: int, count: int) -> list[Ticket]:
    return [Ticket(i, 0, first_seed + i, Exploration.SOFTMAX_FLOOR, 0.3) for i in range(count)]


# 2s3z has shields and two kinds of units, MMM a medivac, which may heal and whose team can die without it.
@pytest.mark.parametrize(
    ("map_name", "options"),
    [
        ("3m", {}),
        ("2s3z", {}),
        ("MMM", {}),
        ("3m", {"obs_timestep_number": True}),
        ("3m", {"obs_timestep_number": True, "obs_instead_of_state": True}),
    ],
    ids=str,
)
@pytest.mark.usefixtures("installed")
def test_trajectories_are_those_of_the_battle_underneath(map_name: str, options: dict[str, Any]) -> None:
    options = OPTIONS | options
    env = EnvConfig(kind="smac", map=map_name, options={**options, "seed": 40})
    players = make_player(env, 16), FusedPlayer(map_name, options, 16)
    assert isinstance(players[0], LoopPlayer)
    for player in players:
        player.load(random_weights(player.spec, 16, seed=0))
    for ticket in tickets(40, 6):
        ours, theirs = (player.play(ticket) for player in players)
        assert trajectories_equal(ours, theirs)


@pytest.mark.usefixtures("installed")
def test_the_limit_truncates_and_a_lost_battle_terminates() -> None:
    """Standing still loses; walking away from the enemies lasts until the limit."""
    for action, wanted in ((1, (True, False)), (2, (False, True))):
        smac, battle = SmacEnv("3m", seed=5), parallel_env("3m")
        smac.reset()
        battle.reset(seed=5)
        while smac.agents:
            masks = [smac.action_space(a).available for a in smac.agents]
            choices = {
                a: action if mask[action] else int(np.flatnonzero(mask)[0])
                for a, mask in zip(smac.agents, masks, strict=True)
            }
            _, rewards, terminations, truncations, infos = smac.step(choices)
            expected = battle.step(choices)
            assert (rewards, terminations, truncations) == expected[1:4]
            for info in (infos["ally_0"], expected[4]["ally_0"]):
                info["action_mask"] = info["action_mask"].tolist()
            assert infos["ally_0"] == expected[4]["ally_0"]
        assert (terminations["ally_0"], truncations["ally_0"]) == wanted


@pytest.mark.usefixtures("installed")
@pytest.mark.filterwarnings("error")
def test_pettingzoo_api() -> None:
    parallel_api_test(SmacEnv("2s3z"), num_cycles=200)


@pytest.mark.usefixtures("installed")
def test_the_spec_is_the_battles_and_no_game_starts_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smac.env.StarCraft2Env.reset", None)
    spec = env_spec(EnvConfig(kind="smac", map="2s3z", options=OPTIONS))
    battle = battle_spec("2s3z", **OPTIONS)
    assert (spec.name, spec.version) == ("smac/2s3z", "smac_v1")
    assert spec.options == '{"reward_only_positive":false,"state_last_action":false}'
    assert replace(spec, name=battle.name, version=battle.version, options=battle.options) == battle


@pytest.mark.usefixtures("installed")
def test_unavailable_actions_are_refused_before_smac_sees_them() -> None:
    env = SmacEnv("3m", seed=1)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step({})
    env.reset()
    with pytest.raises(
        ValueError, match=r"action 7 of ally_1 is not available; its mask allows \[1, 2, 3, 4, 5\]"
    ):
        env.step({"ally_0": 1, "ally_1": 7, "ally_2": 1})


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("breakdowns", [2, 3])
def test_a_battle_in_which_the_game_breaks_down_is_played_again(
    breakdowns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = EnvConfig(kind="smac", options={"seed": 40})
    player, undisturbed = make_player(env, 16), make_player(EnvConfig(), 16)
    for each in (player, undisturbed):
        each.load(random_weights(each.spec, 16, seed=0))
    step, calls = sys.modules["smac.env"].StarCraft2Env.step, 0

    def breaking(game: Any, actions: Any) -> Any:
        nonlocal calls
        calls += 1
        # What SMAC returns when the connection to the game is gone: here in the third step of a battle.
        lost = calls % 3 == 0 and calls <= 3 * breakdowns
        return (0, True, {}) if lost else step(game, actions)

    monkeypatch.setattr("smac.env.StarCraft2Env.step", breaking)
    ticket = tickets(40 + breakdowns, 1)[0]
    if breakdowns == 3:
        with pytest.raises(EpisodeLostError, match="StarCraft II broke down"):
            player.play(ticket)
    else:
        # The stand-in's third battle has the seed of the ticket.
        assert trajectories_equal(player.play(ticket), undisturbed.play(ticket))


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("map_name", "options", "message"),
    [
        ("4m", {}, "refuses env.map '4m' .*KeyError"),
        ("3m", {"reward_sprase": True}, "unexpected keyword argument 'reward_sprase'"),
        ("3m", {"continuing_episode": False}, "multiple values for keyword argument 'continuing_episode'"),
    ],
)
def test_bad_input(map_name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        env_spec(EnvConfig(kind="smac", map=map_name, options=options))


@pytest.mark.parametrize("found", ["nothing", "the optimiser", "old generated code"])
def test_a_missing_package_is_explained(found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_smac()
    package = tmp_path / "smac"
    package.mkdir()
    (package / "__init__.py").write_text("")
    if found == "nothing":
        monkeypatch.setitem(sys.modules, "smac", None)
    if found == "old generated code":
        (package / "env.py").write_text("raise TypeError('Descriptors cannot be created directly.')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match=r"oxwhirl/smac, not the optimiser .*docs/environments.md"):
        make_player(EnvConfig(kind="smac"))
    forget_smac()
