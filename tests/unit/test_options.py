"""What a run may be resumed with."""

from pathlib import Path

import pytest
import yaml

from liir_common import options
from liir_common.errors import ConfigError, CorruptError
from tests.trained import make_run


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("seed=9", "seed: 1 there, 9 wanted"),
        ("env.map=8m", "env.map: '3m' there, '8m' wanted"),
        ("training.lag=1", "training.lag: 0 there, 1 wanted"),
        ("training.batch_episodes=16", "training.batch_episodes: 32 there, 16 wanted"),
        ("algorithm=central_v", "algorithm.name: 'liir' there, 'central_v' wanted"),
        ("algorithm.policy_optimizer.lr=0.1", "algorithm.policy_optimizer.lr: 0.0005 there, 0.1 wanted"),
    ],
)
def test_a_run_goes_on_with_what_it_began_with(setting: str, message: str, tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "run", episodes=())
    before = (run_dir / "config.yaml").read_bytes()
    with pytest.raises(ConfigError, match=f"was begun with other settings .*{message}"):
        options.load_run_config(None, [setting], run_dir, resume=True)
    assert (run_dir / "config.yaml").read_bytes() == before


def test_where_and_how_far_a_run_goes_on_may_change(tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "run", episodes=())
    settings = ["actors.count=3", "learner.port=0", "checkpoints.keep_newest=5", "training.save_interval=7"]
    resumed = options.load_run_config(None, [*settings, "training.total_env_steps=9"], run_dir, resume=True)
    assert (resumed.actors.count, resumed.training.total_env_steps) == (3, 9)


def test_a_run_of_an_older_build_has_the_defaults_of_what_it_did_not_know(tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "run", episodes=())
    tree = yaml.safe_load((run_dir / "config.yaml").read_text())
    del tree["algorithm"]["ratio_bound"]
    (run_dir / "config.yaml").write_text(yaml.safe_dump(tree))
    assert options.load_run_config(None, [], run_dir, resume=True).algorithm.ratio_bound == 0


@pytest.mark.parametrize("text", ["seed: [", "- 1"])
def test_a_damaged_configuration_is_explained(text: str, tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "run", episodes=())
    (run_dir / "config.yaml").write_text(text)
    with pytest.raises(CorruptError, match=r"config\.yaml is damaged"):
        options.load_run_config(None, [], run_dir, resume=True)
