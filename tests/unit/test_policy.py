"""A frozen policy plays what the service's own players play, and refuses what it does not fit."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import supersuit

from liir_common import checkpoint, config
from liir_common.battle.env import parallel_env
from liir_common.checkpoint import Manifest
from liir_common.config import EnvConfig
from liir_common.errors import CorruptError
from liir_common.policy import Policy
from liir_common.pursuit import Pursuit
from liir_common.replay import load
from liir_common.replay.load import load_checkpoint
from liir_common.rollout.loop import LoopPlayer, loop_spec
from liir_common.rollout.play import make_player
from liir_common.rollout.policy import random_weights
from liir_common.types import Exploration, Ticket
from tests.replays import HIDDEN, publish
from tests.unit.test_rollout_loop import Leaving

README = (Path(__file__).parents[2] / "README.md").read_text()
CHOICES = {
    ("liir", False): (Exploration.GREEDY, 0.0),
    ("liir", True): (Exploration.SOFTMAX_FLOOR, 0.0),
    ("qmix", False): (Exploration.GREEDY, 0.0),
    ("qmix", True): (Exploration.EPSILON_GREEDY, 0.05),
}


def taken(policy: Policy, env: Any, seed: int) -> list[dict[str, int]]:
    """The actions of one episode, chosen one step at a time."""
    policy.begin(env, seed)
    observations, infos = env.reset(seed=seed)
    actions = []
    while env.agents:
        actions.append(policy.act(observations, infos))
        observations, _, _, _, infos = env.step(actions[-1])
    return actions


@pytest.mark.parametrize(("method", "sampled"), CHOICES)
def test_it_plays_the_episodes_of_the_evaluator(tmp_path: Path, method: str, sampled: bool) -> None:
    path = publish(tmp_path, method=method)
    manifest, tensors = load_checkpoint(path)
    player = make_player(EnvConfig.model_validate(manifest.config["env"]), HIDDEN)
    player.load(checkpoint.section(tensors, "policy"))
    policy, env = (
        Policy.load(path, sampled=sampled),
        parallel_env("2s3z", **manifest.config["env"]["options"]),
    )
    for seed in (5, 6):  # the second would show what is left of the first
        played = player.play(Ticket(0, 3, seed, *CHOICES[method, sampled]))
        actions = taken(policy, env, seed)
        assert np.array_equal([list(step.values()) for step in actions], played.actions)
        rewards = [results[1] for results in policy.play(env, seed)]
        assert np.allclose([next(iter(reward.values())) for reward in rewards], played.reward)


def frozen(game: Any, **spec: Any) -> tuple[Manifest, dict[str, Any]]:
    """A checkpoint for a game that is no battle."""
    fields = replace(loop_spec(game, "game", {}), **spec)
    tensors = {f"policy.{name}": array for name, array in random_weights(fields, HIDDEN, seed=1).items()}
    settings = ["env.kind=pettingzoo", "env.factory=game:make", f"algorithm.policy_hidden={HIDDEN}"]
    data = checkpoint.pack(tensors)
    about = {"run_id": "run", "git_commit": "abc", "created": 1.0, "policy_version": 3, "env_steps": 1000}
    stored = {"sha256": sha256(data).hexdigest(), "size_bytes": len(data)}
    tree = config.load(settings=settings).tree()
    return Manifest(episode=100, env_spec=asdict(fields), config=tree, **about, **stored), tensors


@pytest.mark.parametrize("game", [Pursuit(), Leaving()])
def test_it_plays_any_game_and_agents_may_leave(game: Any) -> None:
    manifest, tensors = frozen(game)
    player = LoopPlayer(game, loop_spec(game, "game", {}), HIDDEN)
    player.load(checkpoint.section(tensors, "policy"))
    played = player.play(Ticket(0, 3, 7, Exploration.SOFTMAX_FLOOR, 0.0))
    actions = taken(Policy(manifest, tensors, sampled=True), game, 7)
    for row, step in zip(played.actions, actions, strict=True):
        assert list(step.values()) == row[: len(step)].tolist()
    if isinstance(game, Leaving):
        assert len(actions[-1]) == 1, "somebody left"


def test_it_plays_wrapped_battles() -> None:
    """With the observation as a plain array, where the mask is in the info alone."""
    wrapped = supersuit.observation_lambda_v0(
        parallel_env("3m"), lambda seen, space: seen["observation"], lambda space: space["observation"]
    )
    policy = Policy(*frozen(parallel_env("3m")))
    assert taken(policy, wrapped, 3) == taken(policy, parallel_env("3m"), 3)


def test_without_a_seed_draws_differ() -> None:
    policy, env = Policy(*frozen(Pursuit()), sampled=True), Pursuit()
    drawn = set()
    for _ in range(10):
        policy.begin(env)
        drawn.add(str(policy.act(*env.reset(seed=1))))
    assert len(drawn) > 1


def test_another_size_is_refused() -> None:
    policy = Policy(*frozen(parallel_env("3m")))
    wanted = (
        "wants 3 agents, 30 observation values, 9 actions; .* has 8 agents, 80 observation values, 14 actions"
    )
    with pytest.raises(ValueError, match=wanted):
        policy.begin(parallel_env("8m"))
    with pytest.raises(ValueError, match=r"fc1\.weight: wanted float32 \(16, 43\), got"):
        Policy(*frozen(parallel_env("3m"), obs_dim=31)[:1], frozen(parallel_env("3m"))[1])


@pytest.mark.parametrize(
    ("value", "message"), [(np.nan, "wanted finite observations"), (0.0, "agent 0 has no")]
)
def test_what_cannot_be_decided_on_is_refused(value: float, message: str) -> None:
    env = parallel_env("3m")
    policy = Policy(*frozen(env))
    policy.begin(env, 1)
    observations, infos = env.reset(seed=1)
    observations["ally_0"]["observation"][3] = value
    observations["ally_0"]["action_mask"][:] = 0 if value == 0 else 1
    with pytest.raises(ValueError, match=f"step 0: .*{message}"):
        policy.act(observations, infos)


@pytest.mark.parametrize("cut", [0, 1, 100, -1])
def test_a_half_written_checkpoint_is_not_loaded(tmp_path: Path, cut: int) -> None:
    path = publish(tmp_path)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(CorruptError, match="wanted SHA-256"):
        Policy.load(path)
    publish(tmp_path / "other")
    manifest = path.with_suffix(".json")
    manifest.write_text(manifest.read_text()[:cut])
    with pytest.raises(CorruptError, match="not a checkpoint manifest"):
        Policy.load(path)


def test_another_simulator_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = publish(tmp_path)
    monkeypatch.setattr(load, "SIMULATOR_VERSION", "999")
    with pytest.warns(UserWarning, match="version 999 is installed"):
        Policy.load(path)


def test_the_readme_plays_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = (
        block
        for block in re.findall(r"^```python\n(.*?)^```$", README, re.S | re.M)
        if "Policy.load" in block
    )
    path = publish(tmp_path, 1000, "3m")
    (tmp_path / "checkpoints").rename(tmp_path / "here")
    assert f"here/{path.name}" in code
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert len(capsys.readouterr().out.splitlines()) > 5
