"""Replays: what is recorded is what was played, and every format shows it."""

from __future__ import annotations

import io
import itertools
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from liir_common import checkpoint
from liir_common.battle.env import parallel_env
from liir_common.battle.render import Blast
from liir_common.battle.snapshots import UnitRecord
from liir_common.cli import app
from liir_common.errors import ConfigError, CorruptError
from liir_common.replay import load
from liir_common.replay.animation import draw_frames
from liir_common.replay.load import find_checkpoint, load_checkpoint
from liir_common.replay.page import page_data, write_page
from liir_common.replay.record import Recording, record, target_number
from liir_common.replay.write import write
from liir_common.rollout.fused import FusedPlayer
from liir_common.types import Exploration, Ticket
from tests.replays import BOUND, HIDDEN, publish
from tests.samples import trajectories_equal

OPTIONS = {"reward_only_positive": True, "state_last_action": False}
SAMPLED = Exploration.SOFTMAX_FLOOR


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run")
    for episode in (100, 200, 300):
        publish(path, episode)
    return path


@pytest.fixture(scope="module")
def sampled(run_dir: Path) -> Recording:
    return record(*load_checkpoint(find_checkpoint(None, run_dir)), seed=5, sampled=True)


@pytest.mark.parametrize("exploration", [Exploration.GREEDY, SAMPLED])
def test_the_battle_is_the_one_that_actors_play(run_dir: Path, exploration: Exploration) -> None:
    manifest, tensors = load_checkpoint(find_checkpoint(None, run_dir))
    recording = record(manifest, tensors, 5, exploration is SAMPLED)
    player = FusedPlayer("2s3z", dict(OPTIONS), HIDDEN)
    player.load(checkpoint.section(tensors, "policy"))
    ticket = Ticket(0, manifest.policy_version, 5, exploration, 0.0)
    assert trajectories_equal(recording.trajectory, player.play(ticket))


def test_frames_are_those_of_the_environment(sampled: Recording) -> None:
    env = parallel_env("2s3z", **OPTIONS)
    env.reset(seed=5)
    assert sampled.frames[0] == env.snapshot()
    for actions, frame in zip(sampled.trajectory.actions, sampled.frames[1:], strict=True):
        env.step(dict(zip(env.agents, actions, strict=True)))
        assert frame == env.snapshot()
    assert not env.agents, "the recording ends with the episode"


def test_probabilities_are_those_the_actions_were_drawn_with(sampled: Recording) -> None:
    trajectory = sampled.trajectory
    assert np.array_equal(sampled.probabilities > 0, trajectory.mask[:-1])
    taken = np.take_along_axis(sampled.probabilities, trajectory.actions[..., None].astype(int), -1)[..., 0]
    np.testing.assert_allclose(np.log(taken), trajectory.log_mu, atol=1e-4)
    assert taken.min() < 0.5, "a policy this random takes unlikely actions"


def test_greedy_actions_are_the_most_likely(run_dir: Path) -> None:
    greedy = record(*load_checkpoint(find_checkpoint(None, run_dir)), seed=5)
    assert np.array_equal(greedy.probabilities.argmax(-1), greedy.trajectory.actions)


def is_near(unit: UnitRecord, x: float, y: float, reach: float) -> bool:
    """Whether a unit may have been within reach of a place during the step that ended with it here."""
    furthest = 8 * 2.9531 / 16
    return math.hypot(unit["x"] - x, unit["y"] - y) <= reach + unit["radius"] + furthest


@pytest.mark.parametrize("map_name", ["2s3z", "MMM", "1c3s5z", "so_many_baneling", "bane_vs_bane"])
def test_every_loss_of_life_has_a_shot_or_a_blast_before_it(tmp_path: Path, map_name: str) -> None:
    """Missiles may fly into the next step, and a colossus' beams hit up to 13 loops after the attack began,
    so a shot in this step or in the last two explains a loss, of its target or beside it."""
    recording = record(*load_checkpoint(publish(tmp_path, map_name=map_name)), seed=5, sampled=True)
    losses = 0
    for t, (before, after) in enumerate(itertools.pairwise(recording.frames)):
        recent = [shot for shots in recording.shots[max(0, t - 2) : t + 1] for shot in shots]
        hit = {shot.target for shot in recent}
        swept = [after[s.target] for s in recent if after[s.attacker]["unit_type"] == "colossus"]
        for i, (old, new) in enumerate(zip(before, after, strict=True)):
            if new["health"] + new["shield"] < old["health"] + old["shield"] - 0.2:
                losses += 1
                blasted = any(is_near(new, *blast) for blast in recording.blasts[t])
                beside = any(is_near(new, target["x"], target["y"], 2.5) for target in swept)
                assert i in hit or blasted or beside, f"{old} lost life and nobody shot"
    assert losses > 10
    n = len(recording.trajectory.actions[0])
    assert all((shot.attacker < n) != (shot.target < n) for shots in recording.shots for shot in shots)
    burst = [u for u in recording.frames[-1] if u["unit_type"] == "baneling" and not u["alive"]]
    assert sorted(blast[:2] for blasts in recording.blasts for blast in blasts) == sorted(
        (u["x"], u["y"]) for u in burst
    )
    assert bool(burst) is map_name.startswith(("so_many", "bane"))


def test_blasts_are_drawn(sampled: Recording) -> None:
    """In the second half of the step, over as much ground as they reach."""
    blasts: list[list[Blast]] = [[Blast(12.0, 20.0, 2.2)], []]
    few = replace(sampled, frames=sampled.frames[:3], shots=sampled.shots[:2], blasts=blasts)
    none = replace(few, blasts=[[], []])
    changed = [
        (image != plain).any(-1).sum()
        for image, plain in zip(draw_frames(few, 4), draw_frames(none, 4), strict=True)
    ]
    assert changed == [0, 0, pytest.approx(math.pi * (2.2 * 24) ** 2, rel=0.05), changed[2], 0, 0, 0, 0, 0]
    assert page_data(few)["blasts"] == [[[12.0, 20.0, 2.2]], []]


def test_a_medivac_heals(sampled: Recording) -> None:
    """Its order on the page is no attack, though the game knows no other word for it."""
    unit: Any = sampled.frames[0][0] | {"unit_type": "medivac", "order": "attack", "target": 1}
    marine: Any = unit | {"unit_type": "marine"}
    one = replace(sampled, frames=[[unit, marine]])
    assert [situation[-2:] for situation in page_data(one)["frames"][0]] == [["heal", 1], ["attack", 6]]


@pytest.mark.parametrize(
    ("team", "unit_type", "place"),
    [("ally", "marine", 6), ("enemy", "marine", 1), ("ally", "medivac", 1), ("enemy", "medivac", 6)],
)
def test_targets_are_places_in_the_frame(sampled: Recording, team: str, unit_type: str, place: int) -> None:
    unit: Any = sampled.frames[0][0] | {"team": team, "unit_type": unit_type}
    assert target_number(unit | {"target": 1}, n_allies=5) == place
    assert target_number(unit | {"target": None}, n_allies=5) is None


class Scripts(HTMLParser):
    """The attributes and contents of a page's scripts, as a browser's parser would find them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[dict[str, str | None], str]] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "script":
            self.found.append((dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.lasttag == "script" and not self.found[-1][1]:
            self.found[-1] = (self.found[-1][0], data)


def test_the_page_carries_the_recording_and_nothing_breaks_out(sampled: Recording) -> None:
    page = write_page(sampled)
    scripts = Scripts(page)
    assert "b" not in scripts.tags, "the name of the run became an element"
    assert [json.loads(text) for attrs, text in scripts.found if attrs.get("id") == "recording"] == [
        json.loads(json.dumps(page_data(sampled)))
    ]
    assert json.loads(scripts.found[0][1])["run"] == "</script><b>run"
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import|https?:""", page)


def test_the_page_has_probability_and_r_in_of_each_available_action(sampled: Recording) -> None:
    data, trajectory = page_data(sampled), sampled.trajectory
    assert sampled.intrinsic is not None
    assert np.abs(sampled.intrinsic).max() <= BOUND
    for t in range(trajectory.length):
        for i, choices in enumerate(data["choices"][t]):
            available = np.flatnonzero(trajectory.mask[t, i]) if trajectory.alive[t, i] else []
            assert [choice[0] for choice in choices] == list(available)
            for action, probability, r_in in choices:
                assert probability == pytest.approx(sampled.probabilities[t, i, action], abs=1e-4)
                assert r_in == pytest.approx(sampled.intrinsic[t, i, action], abs=1e-4)
    dead = np.argwhere(~trajectory.alive[:-1])
    assert len(dead), "somebody dies in this battle"
    assert all(data["choices"][t][i] == [] for t, i in dead)


def test_a_method_without_intrinsic_reward_has_a_page_without_it(tmp_path: Path) -> None:
    recording = record(*load_checkpoint(publish(tmp_path, method="central_v")))
    data = page_data(recording)
    assert recording.intrinsic is None
    assert not data["hasIntrinsic"]
    assert {len(choice) for step in data["choices"] for agent in step for choice in agent} == {2}


def test_a_value_based_method_shows_q_values_and_draws_as_its_tests_do(tmp_path: Path) -> None:
    manifest, tensors = load_checkpoint(publish(tmp_path, method="iql"))
    recording = record(manifest, tensors, seed=5, sampled=True)
    player = FusedPlayer("2s3z", dict(OPTIONS), HIDDEN)
    player.load(checkpoint.section(tensors, "policy"))
    ticket = Ticket(0, manifest.policy_version, 5, Exploration.EPSILON_GREEDY, 0.05)
    assert trajectories_equal(recording.trajectory, player.play(ticket))
    assert recording.probabilities is None
    assert recording.q_values is not None
    assert recording.q_values.min() < 0, "Q values, not probabilities"
    data = page_data(recording)
    assert data["hasQ"]
    action, q_value = data["choices"][0][0][-1]
    assert q_value == pytest.approx(recording.q_values[0, 0, action], abs=1e-4)
    greedy = record(manifest, tensors, seed=5)
    best = np.where(greedy.trajectory.mask[:-1], greedy.q_values, -np.inf).argmax(-1)
    assert np.array_equal(best, greedy.trajectory.actions)


def test_another_version_of_the_simulator_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    path = publish(tmp_path)
    load_checkpoint(path)
    assert not recwarn.list
    monkeypatch.setattr(load, "SIMULATOR_VERSION", "999")
    arguments = ["replay", "--checkpoint", str(path), "-o", str(tmp_path / "battle.html")]
    with pytest.warns(
        UserWarning, match=r"trained with version \S+ of the battle .* version 999 is installed"
    ):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_animations_show_the_whole_battle(sampled: Recording, tmp_path: Path) -> None:
    few = replace(sampled, frames=sampled.frames[:5], shots=sampled.shots[:4], blasts=sampled.blasts[:4])
    write(few, tmp_path / "battle.gif")
    write(few, tmp_path / "battle.mp4")
    with Image.open(tmp_path / "battle.gif") as gif:
        seconds = 0.0
        for i in range(gif.n_frames):
            gif.seek(i)
            seconds += gif.info["duration"] / 1000
        assert seconds == pytest.approx(4 / 2.8 + 1.5, abs=0.1)
    with av.open(io.BytesIO((tmp_path / "battle.mp4").read_bytes())) as video:
        images = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert len(images) / 22.4 == pytest.approx(4 / 2.8 + 1.5, abs=0.1)
        assert images[0].shape == (18 * 24, 28 * 24, 3), "the lane, without what lies around it"
        change = np.abs(images[0].astype(int) - images[-1]).max(-1)
        assert 20 < (change > 60).sum() < 0.2 * change.size, "units moved, the ground did not"


def test_the_best_checkpoint_is_the_one_that_wins_most(run_dir: Path, tmp_path: Path) -> None:
    assert find_checkpoint(None, run_dir).stem == "checkpoint-000000300"
    (tmp_path / "evaluations.csv").write_text(
        "episode,greedy_win_rate,sampled_win_rate,greedy_return_mean\n"
        "100,0.9,1.0,20\n200,1.0,0.85,18\n300,1.0,0.85,17\n400,1.0,1.0,20\n900,1.0,0.8,20\n1000,0.95,1.0,20\n"
    )
    (tmp_path / "checkpoints").mkdir()
    for episode in (100, 200, 300, 900, 1000):  # 400 was deleted
        (tmp_path / "checkpoints" / f"checkpoint-{episode:09d}.json").touch()
    assert find_checkpoint(None, tmp_path, best=True).stem == "checkpoint-000000200"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((None, None), "wanted either --checkpoint FILE or --run-dir"),
        ((Path("a"), Path("b")), "wanted either --checkpoint FILE or --run-dir"),
        ((Path("a"), None, True), "--best chooses among"),
        ((None, Path("nowhere")), "nowhere holds no checkpoint"),
        ((None, Path("nowhere"), True), "nowhere holds no tested checkpoint"),
    ],
)
def test_what_cannot_be_found_says_why(arguments: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        find_checkpoint(*arguments)


def test_unreadable_checkpoints_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*none\.json: No such file"):
        load_checkpoint(tmp_path / "none.safetensors")
    weights = publish(tmp_path)
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    with pytest.raises(CorruptError, match="wanted SHA-256"):
        load_checkpoint(weights)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"map_name": "3m"}, "3m does not fit a policy trained on 2s3z: policy parameter fc1"),
        ({"map_name": "4m"}, "unknown map '4m'"),
        ({"seed": -1}, r"a seed wants an integer in \[0, 2\*\*64\), got -1"),
    ],
)
def test_battles_that_cannot_be_played_are_refused(run_dir: Path, change: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        record(*load_checkpoint(find_checkpoint(None, run_dir)), **change)


def test_command(run_dir: Path, tmp_path: Path) -> None:
    page = tmp_path / "battle.html"
    arguments = ["replay", "--run-dir", str(run_dir), "--seed", "5", "--sampled", "-o", str(page)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert re.search(r"battle\.html: 2s3z, (not )?won after \d+ steps", result.output)
    assert json.loads(Scripts(page.read_text()).found[0][1])["sampled"] is True


@pytest.mark.parametrize(
    ("output", "message"), [("battle.txt", "one of .html, .gif, .mp4"), ("no/battle.gif", "no is no folder")]
)
def test_command_refuses_outputs_before_it_plays(output: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CliRunner().invoke(app, ["replay", "-o", output], catch_exceptions=False)
