"""docs/environments.md does what it says, and the battle under SuperSuit is the battle."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import supersuit
import yaml

from liir_common.battle.env import parallel_env
from liir_common.config import EnvConfig, load
from liir_common.rollout.loop import LoopPlayer
from liir_common.rollout.play import make_player
from liir_common.rollout.policy import random_weights
from liir_common.types import Exploration, Ticket, Trajectory

DOC = (Path(__file__).parents[2] / "docs" / "environments.md").read_text()


def snippets(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", DOC, re.DOTALL | re.MULTILINE)


def play(env: EnvConfig, seed: int) -> Trajectory:
    player = make_player(env, 16)
    assert isinstance(player, LoopPlayer)
    player.load(random_weights(player.spec, 16, seed=0))
    return player.play(Ticket(0, 0, seed, Exploration.SOFTMAX_FLOOR, 0.3))


@pytest.mark.parametrize("code", snippets("python"))
def test_python_runs(code: str) -> None:
    scope: dict[str, Any] = {}
    exec(code, scope)
    if "results" in scope:
        assert set(scope["results"]) <= {0.0, 1.0}


def test_configurations_load_and_say_what_the_text_says(tmp_path: Path) -> None:
    assert len(snippets("yaml")) == 3
    for text in snippets("yaml"):
        file = tmp_path / "run.yaml"
        file.write_text(text)
        loaded = load(file, ["preset=none"]).env
        assert loaded == EnvConfig.model_validate(yaml.safe_load(text)["env"])


def test_the_factories_are_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (games,) = (code for code in snippets("python") if code.startswith("# games.py"))
    (tmp_path / "games.py").write_text(games)
    monkeypatch.syspath_prepend(str(tmp_path))
    pursuit, stacked = (yaml.safe_load(text)["env"] for text in snippets("yaml")[:2])
    assert play(EnvConfig.model_validate(pursuit), 3).length <= 15
    played = play(EnvConfig.model_validate(stacked), 3)
    assert played.obs.shape[1:] == (3, 4 * 30 + 3)
    taken = np.take_along_axis(played.mask[:-1], played.actions[..., None].astype(int), -1)
    assert taken.all()
    assert not played.mask.all()
    assert set(played.info) == {"won", "dead_allies", "dead_enemies"}


@pytest.mark.parametrize("cpus", [0, 2])
def test_vectorised_battles_are_the_battles(cpus: int) -> None:
    one = supersuit.pettingzoo_env_to_vec_env_v1(parallel_env("2s3z"))
    envs = supersuit.concat_vec_envs_v1(one, 2, num_cpus=cpus, base_class="gymnasium")
    singles = [parallel_env("2s3z") for _ in range(2)]
    n = len(singles[0].possible_agents)
    random, ended = np.random.default_rng(0), [False, False]
    try:
        observations, _ = envs.reset(seed=11)
        expected = [env.reset(seed=11 + k)[0] for k, env in enumerate(singles)]
        while not all(ended):
            actions = np.array([random.choice(np.flatnonzero(m)) for m in observations["action_mask"]])
            for k, env in enumerate(singles):
                if not ended[k]:
                    for i, agent in enumerate(env.possible_agents):
                        for key, value in expected[k][agent].items():
                            assert np.array_equal(observations[key][k * n + i], value)
            observations, rewards, terminations, truncations, infos = envs.step(actions)
            for k, env in enumerate(singles):
                if ended[k]:
                    continue
                team = slice(k * n, (k + 1) * n)
                expected[k], paid, over, limit, last = env.step(
                    dict(zip(env.agents, actions[team], strict=True))
                )
                assert rewards[team].tolist() == [np.float32(r) for r in paid.values()]
                assert terminations[team].tolist() == list(over.values())
                assert truncations[team].tolist() == list(limit.values())
                ended[k] = not env.agents
                if ended[k]:
                    assert infos[k * n]["won"] == last["ally_0"]["won"]
                    final = infos[k * n]["terminal_observation"]["observation"]
                    assert np.array_equal(final, expected[k]["ally_0"]["observation"])
    finally:
        envs.close()


@pytest.mark.parametrize(
    ("wrap", "meaning"),
    [
        (supersuit.clip_reward_v0, lambda reward: max(-1.0, min(1.0, reward))),
        (lambda env: supersuit.reward_lambda_v0(env, abs), abs),
    ],
)
def test_wrappers_of_rewards_take_the_battle_as_it_is(wrap: Any, meaning: Any) -> None:
    plain, wrapped = (parallel_env("3m", reward_only_positive=False, reward_scale=False) for _ in range(2))
    wrapped = wrap(wrapped)
    for env in (plain, wrapped):
        env.reset(seed=2)
    changed = 0
    while plain.agents:
        actions = {agent: wrapped.action_space(agent).sample() for agent in wrapped.agents}
        reward, changed_reward = (env.step(actions)[1]["ally_0"] for env in (plain, wrapped))
        assert changed_reward == meaning(reward)
        changed += changed_reward != reward
    assert changed > 0
