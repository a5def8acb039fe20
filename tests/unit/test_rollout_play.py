"""From a configuration to a player: what is made, what is refused, what is imported."""

import subprocess
import sys

import pytest

from liir_common.config import EnvConfig
from liir_common.errors import ConfigError
from liir_common.rollout.bench import bench_rollout, multiply_add_peak, multiply_adds_per_step
from liir_common.rollout.fused import FusedPlayer
from liir_common.rollout.loop import LoopPlayer
from liir_common.rollout.play import env_spec, make_player, warm_up
from liir_common.rollout.policy import random_weights
from liir_common.types import Exploration, Ticket
from tests.samples import trajectories_equal

PURSUIT = EnvConfig(kind="pettingzoo", factory="liir_common.pursuit:parallel_env", options={"horizon": 9})


def pettingzoo(factory: str) -> EnvConfig:
    return EnvConfig(kind="pettingzoo", factory=factory)


def test_battles_are_fused_and_other_games_stepped() -> None:
    assert isinstance(make_player(EnvConfig(map="3m")), FusedPlayer)
    assert isinstance(make_player(EnvConfig(map="3m"), fused=False), LoopPlayer)
    assert isinstance(make_player(PURSUIT), LoopPlayer)


@pytest.mark.parametrize("env", [EnvConfig(map="3m"), EnvConfig(map="8m"), PURSUIT])
def test_spec_is_the_players(env: EnvConfig) -> None:
    assert env_spec(env) == make_player(env).spec


def test_options_reach_the_factory_and_the_spec() -> None:
    spec = env_spec(PURSUIT)
    assert spec.episode_limit == 9
    assert spec.options == '{"horizon":9}'
    assert spec.name == PURSUIT.factory


def test_stepped_games_are_pure_in_their_ticket() -> None:
    players = make_player(PURSUIT, 16), make_player(PURSUIT, 16)
    for player in players:
        player.load(random_weights(player.spec, 16, seed=0))
    tickets = [Ticket.for_training(1, i, 0, Exploration.SOFTMAX_FLOOR, 0.3) for i in range(20)]
    forwards = [players[0].play(ticket) for ticket in tickets]
    backwards = [players[1].play(ticket) for ticket in reversed(tickets)]
    assert all(trajectories_equal(a, b) for a, b in zip(forwards, reversed(backwards), strict=True))
    assert len({played.obs.tobytes() for played in forwards}) > 10


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        ("", "wanted module:function, got ''"),
        ("liir_common.pursuit", "wanted module:function, got 'liir_common.pursuit'"),
        ("liir_common.nowhere:parallel_env", "cannot import .*: No module named 'liir_common.nowhere'"),
        ("liir_common.pursuit:nothing", "cannot import .*: module .* has no attribute 'nothing'"),
        ("builtins:dict", r"wants to return a ParallelEnv, got \{\}"),
    ],
)
def test_a_factory_that_cannot_be_used_is_explained(factory: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_player(pettingzoo(factory))


def test_options_that_a_factory_does_not_take_are_explained() -> None:
    env = PURSUIT.model_copy(update={"options": {"horizont": 9}})
    with pytest.raises(
        ConfigError, match=r"not work with env.options .*unexpected keyword argument 'horizont'"
    ):
        env_spec(env)


def test_an_unknown_map_is_refused() -> None:
    with pytest.raises(ValueError, match="3m"):
        make_player(EnvConfig(map="3n"))


def test_actors_import_no_torch_ray_or_grpc() -> None:
    code = (
        "import sys, liir_common.rollout.play, liir_common.rollout.bench;"
        "print(sorted({'torch', 'ray', 'grpc', 'services'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_warm_up_leaves_nothing_to_compile() -> None:
    warm_up(EnvConfig(map="3m"))
    code = (
        "from liir_common.config import EnvConfig; from liir_common.rollout import changes, fused, play;"
        "play.warm_up(EnvConfig(map='3m')); stats = [fused._play_episode.stats, changes._pack.stats];"
        "print(*(f(s).total() for s in stats for f in (lambda s: s.cache_hits, lambda s: s.cache_misses)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "0", "1", "0"]


def test_bench_measures_what_it_says() -> None:
    result = bench_rollout(EnvConfig(map="3m"), episodes=20, repeats=3)
    assert result["multiply_adds_per_step"] == 3 * 64 * (30 + 6 * 64 + 9)
    assert result["floor_steps_per_s"] == result["multiply_add_peak_per_s"] / result["multiply_adds_per_step"]
    assert result["env_steps_per_s"] > 0
    assert result["env_steps_per_s"] == pytest.approx(
        result["fraction_of_floor"] * result["floor_steps_per_s"]
    )


def test_multiply_adds_are_those_of_the_weights() -> None:
    spec = env_spec(EnvConfig(map="8m"))
    matrices = {name: w for name, w in random_weights(spec, 64, 0).items() if w.ndim == 2}
    one_hot = 64 * (spec.n_actions + spec.n_agents)
    per_agent = sum(w.size for w in matrices.values()) - one_hot
    assert multiply_adds_per_step(spec, 64) == spec.n_agents * per_agent


def test_the_peak_is_a_rate() -> None:
    assert multiply_add_peak(repeats=3) > 0
