"""The configuration: sources in order, presets, and errors that say what to do."""

from pathlib import Path

import pytest

from liir_common import config
from liir_common.errors import ConfigError


def test_command_line_beats_environment_beats_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "run.yaml"
    file.write_text("seed: 3\ntraining: {total_env_steps: 10, batch_episodes: 4, save_interval: 9}\n")
    monkeypatch.setenv("LIIR_TRAINING__BATCH_EPISODES", "5")
    monkeypatch.setenv("LIIR_TRAINING__SAVE_INTERVAL", "7")
    resolved = config.load(file, ["training.save_interval=2"])
    assert resolved.seed == 3
    assert resolved.training.total_env_steps == 10
    assert resolved.training.batch_episodes == 5
    assert resolved.training.save_interval == 2


def test_preset_fills_what_is_not_written() -> None:
    paper = config.load(None, ["preset=paper", "algorithm.gae_lambda=0"])
    assert paper.algorithm.policy_optimizer.name == "rmsprop"
    assert paper.algorithm.gae_lambda == 0
    assert paper.env.options["reward_only_positive"] is False
    strong = config.load()
    assert strong.algorithm.policy_optimizer.name == "adam"
    assert strong.env.options["reward_only_positive"] is True


def optimizers(name: str) -> dict[str, object]:
    """All three have one rate and one clip; the eps of the others would freeze η."""
    common = {"name": name, "lr": 5e-4, "eps": 1e-5, "alpha": 0.99, "clip": 10.0}
    return {"policy_optimizer": common, "critic_optimizer": common, "eta_optimizer": common | {"eps": 1e-10}}


BOTH: dict[str, object] = {
    "lambda": 0.01,
    "freeze_eta": False,
    "gamma": 0.99,
    "limit_is_terminal": True,
    "r_in_gain": 0.1,
    "policy_hidden": 64,
}
STRONG = (
    BOTH
    | optimizers("adam")
    | {
        "gae_lambda": 0.95,
        "target_interval": 0,
        "normalize_advantages": True,
        "normalize_values": True,
        "policy_epochs": 4,
        "ratio_clip": 0.2,
        "critic_epochs": 4,
        "entropy": 0.03,
        "orthogonal_init": True,
        "policy_gain": 3.0,
        "exploration": {"start": 0.5, "end": 0.05, "steps": 300_000},
        "r_in_bound": 1.0,
    }
)
PAPER = (
    BOTH
    | optimizers("rmsprop")
    | {
        "gae_lambda": 0.8,
        "target_interval": 200,
        "normalize_advantages": False,
        "normalize_values": False,
        "policy_epochs": 1,
        "critic_epochs": 1,
        "entropy": 0.0,
        "orthogonal_init": False,
        "exploration": {"start": 0.5, "end": 0.01, "steps": 50_000},
        "r_in_bound": 10.0,
    }
)


@pytest.mark.parametrize("method", ["liir", "central_v", "iac"])
@pytest.mark.parametrize(
    ("preset", "positive", "values"), [("strong", True, STRONG), ("paper", False, PAPER)]
)
def test_presets_are_what_the_documentation_says(
    method: str, preset: str, positive: bool, values: dict[str, object]
) -> None:
    """The table in docs/algorithm.md, with what `paper` changes of the authors' release."""
    tree = config.load(None, [f"preset={preset}", f"algorithm={method}"]).tree()
    assert {key: tree["algorithm"][key] for key in values} == values
    assert tree["env"]["options"] == {"reward_only_positive": positive, "state_last_action": False}


def test_without_a_preset_liir_is_strong() -> None:
    none = config.load(None, ["preset=none"])
    assert none.algorithm == config.load(None, ["preset=strong"]).algorithm
    assert none.env.options == {}


PYMARL: dict[str, object] = {
    "normalize_advantages": False,
    "normalize_values": False,
    "policy_epochs": 1,
    "entropy": 0.0,
    "orthogonal_init": False,
    "policy_optimizer": optimizers("rmsprop")["policy_optimizer"],
}
COMA = PYMARL | {
    "gae_lambda": 0.8,
    "critic_epochs": 8,
    "target_interval": 25,
    "critic_optimizer": optimizers("rmsprop")["critic_optimizer"],
    "exploration": {"start": 0.5, "end": 0.01, "steps": 100_000},
}
OF_VALUES = PYMARL | {
    "gae_lambda": 0.0,
    "target_interval": 6,
    "exploration": {"start": 1.0, "end": 0.05, "steps": 50_000},
    "replay": {"episodes": 5000, "batch_episodes": 32, "episodes_per_update": 8},
    "mixer_width": 32,
    "hypernet_width": 64,
}


@pytest.mark.parametrize("preset", ["strong", "paper"])
@pytest.mark.parametrize(
    ("method", "values"), [("coma", COMA), ("iql", OF_VALUES), ("vdn", OF_VALUES), ("qmix", OF_VALUES)]
)
def test_other_methods_have_pymarls_values_with_either_preset(
    preset: str, method: str, values: dict[str, object]
) -> None:
    tree = config.load(None, [f"preset={preset}", f"algorithm={method}"]).tree()["algorithm"]
    assert {key: tree[key] for key in values} == values


def test_algorithm_may_be_its_name(tmp_path: Path) -> None:
    assert config.load(None, ["algorithm=central_v"]).algorithm.name == "central_v"
    file = tmp_path / "run.yaml"
    file.write_text("algorithm: qmix\n")
    assert config.load(file).algorithm.name == "qmix"
    for settings in (["algorithm.gamma=0.9"], ["algorithm=qmix", "algorithm.gamma=0.9"]):
        algorithm = config.load(file, settings).algorithm
        assert (algorithm.name, algorithm.gamma) == ("qmix", 0.9)
    assert config.load(file, ["algorithm=iac"]).algorithm.name == "iac"


def test_env_may_be_its_kind(tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text("env: smac\n")
    assert config.load(file).env.label == "smac-3m"
    env = config.load(file, ["env.map=8m"]).env
    assert (env.kind, env.map, env.label) == ("smac", "8m", "smac-8m")
    assert config.load(None, ["env=smac", "env.map=8m"]).env == env
    assert config.load(None, ["env.map=8m"]).env.label == "8m"


def test_security_may_be_the_folder_of_a_role(tmp_path: Path) -> None:
    for role in ("reader", "actor"):
        (tmp_path / role).mkdir()
    file, reader = tmp_path / "run.yaml", str(tmp_path / "reader")
    file.write_text(f"security: {reader}\n")
    security = config.load(file).security
    assert security == config.SecurityConfig.of(reader)
    assert (security.ca, security.client_ca) == (f"{reader}/ca.pem", f"{reader}/ca.pem")
    assert (security.cert, security.key, security.tokens) == tuple(
        f"{reader}/{name}" for name in ("cert.pem", "key.pem", "tokens")
    )
    assert config.load(file, ["security.tokens=/own"]).security == security.model_copy(
        update={"tokens": "/own"}
    )
    actor = config.SecurityConfig.of(tmp_path / "actor")
    assert config.load(file, [f"security={tmp_path / 'actor'}"]).security == actor
    with pytest.raises(ConfigError, match="wanted the folder of a role"):
        config.load(None, [f"security={tmp_path / 'operator'}"])


def test_another_rate_for_eta_leaves_its_eps_alone() -> None:
    """With the eps of the other optimisers η would hardly move."""
    assert config.load(None, ["algorithm.eta_optimizer.lr=0.1"]).algorithm.eta_optimizer.eps == 1e-10


def test_presets_set_options_of_smacs_rules_only() -> None:
    settings = ["env=pettingzoo", "env.factory=games.pursuit:parallel_env", "env.options.horizon=9"]
    for preset in ("strong", "paper", "none"):
        env = config.load(None, [f"preset={preset}", *settings]).env
        assert (env.options, env.label) == ({"horizon": 9}, "pursuit")
    assert config.load(None, ["env=smac"]).env.options == config.load().env.options != {}


@pytest.mark.parametrize("preset", ["strong", "paper"])
def test_methods_bring_their_settings_and_leave_the_reward_to_the_preset(preset: str) -> None:
    coma, qmix, iac, central_v = (
        config.load(None, [f"preset={preset}", f"algorithm={name}"])
        for name in ("coma", "qmix", "iac", "central_v")
    )
    assert coma.algorithm.policy_optimizer.name == qmix.algorithm.policy_optimizer.name == "rmsprop"
    assert (coma.algorithm.policy_epochs, coma.algorithm.entropy) == (1, 0)
    assert (qmix.algorithm.exploration.start, qmix.algorithm.exploration.end) == (1, 0.05)
    assert qmix.algorithm.replay.episodes_per_update == 8
    assert qmix.env == coma.env == iac.env
    assert iac.algorithm == central_v.algorithm.model_copy(update={"name": "iac"})
    assert config.load(None, ["algorithm=qmix", "algorithm.gae_lambda=0.5"]).algorithm.gae_lambda == 0.5


def test_how_actors_choose_follows_from_the_method() -> None:
    behaviours = {
        name: str(config.load(None, [f"algorithm={name}"]).algorithm.behaviour)
        for name in ("liir", "central_v", "iac", "coma", "iql", "vdn", "qmix")
    }
    assert {name for name, how in behaviours.items() if how == "epsilon_greedy"} == {"iql", "vdn", "qmix"}
    assert set(behaviours.values()) == {"epsilon_greedy", "softmax_floor"}


def test_tree_round_trip_ignores_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    resolved = config.load(None, ["seed=9", "algorithm.lambda=0.5"])
    monkeypatch.setenv("LIIR_SEED", "1")
    assert config.from_tree(resolved.tree()) == resolved


def test_security_names_files_wherever_it_is_set_and_is_not_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIIR_SECURITY__CA", "ca.pem")
    resolved = config.load(None, ["security.tokens=sub/tokens"])
    assert resolved.security.ca == str(tmp_path / "ca.pem")
    assert resolved.security.tokens == str(tmp_path / "sub" / "tokens")
    assert resolved.security.cert == ""
    assert resolved.tree().keys() - resolved.shared_tree().keys() == {"security"}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("trainig.lag=1", "did you mean 'training'"),
        ("training.lagg=1", "did you mean 'lag'"),
        ("algorithm.lamda=1", "did you mean 'lambda'"),
        ("training.lag=2", "training.lag: Input should be less than or equal to 1; got 2"),
        ("training.total_env_steps=many", "training.total_env_steps"),
        ("preset=strongest", "'strong', 'paper' or 'none'"),
        ("actors.count=true", "actors.count: Value error, wanted a number, got true"),
        ("algorithm.entropy=false", "algorithm.entropy: Value error, wanted a number, got false"),
        ("algorithm.entropy=.inf", "algorithm.entropy: Input should be a finite number"),
        ("algorithm.replay.episodes=31", "batch_episodes wants to be at most episodes (31), got 32"),
        ("algorithm={name: coma, limit_is_terminal: false}", "coma wants limit_is_terminal"),
        ("seed", "--set wants key.sub=value, got 'seed'"),
        ("_file.seed=1", "--set wants key.sub=value, got '_file.seed=1'"),
        ("seed=[", "not YAML"),
    ],
)
def test_mistakes_are_explained(setting: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.load(None, [setting])
    assert message in str(caught.value)


def test_unreadable_files_are_explained(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        config.load(tmp_path / "missing.yaml")
    bad = tmp_path / "bad.yaml"
    bad.write_text("- a\n- b\n")
    with pytest.raises(ConfigError, match="wanted a mapping"):
        config.load(bad)
    bad.write_text("1: 2")
    with pytest.raises(ConfigError, match=r"wanted a mapping of settings by name, got keys \[1\]"):
        config.load(bad)
    bad.write_text("a: [")
    with pytest.raises(ConfigError, match="not YAML"):
        config.load(bad)


def test_misspelt_variables_are_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIIR_TOKENS", "reader secret")
    config.load()
    monkeypatch.setenv("LIIR_TRAININGS__LAG", "1")
    with pytest.raises(ConfigError, match=r"variable LIIR_TRAININGS__LAG; did you mean LIIR_TRAINING\?"):
        config.load()


def test_variables_of_kubernetes_are_no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {
        "LIIR_SERVICE_HOST": "10.0.0.1",
        "LIIR_GRPC_SERVICE_PORT": "6000",
        "LIIR_GRPC_SERVICE_PORT_API": "6000",
        "LIIR_PORT": "tcp://10.0.0.1:6000",
        "LIIR_GRPC_PORT_6000_TCP_ADDR": "10.0.0.1",
    }
    for name, value in told.items():
        monkeypatch.setenv(name, value)
    config.load()
    monkeypatch.setenv("LIIR_LEARNER_PORT", "6000")
    with pytest.raises(ConfigError, match="variable LIIR_LEARNER_PORT; did you mean LIIR_LEARNER"):
        config.load()


def test_exploration_falls_linearly_and_stays() -> None:
    exploration = config.ExplorationConfig(start=0.5, end=0.1, steps=100)
    assert exploration.epsilon(0) == 0.5
    assert exploration.epsilon(50) == pytest.approx(0.3)
    assert exploration.epsilon(1000) == pytest.approx(0.1)
    assert config.ExplorationConfig(start=0.5, end=0.1, steps=0).epsilon(0) == pytest.approx(0.1)


def test_every_shipped_configuration_loads() -> None:
    # Those of figures are sweeps: see test_sweep.py.
    files = [path for path in sorted(Path("configs").glob("*.yaml")) if not path.stem.startswith("figure")]
    assert files
    for file in files:
        config.load(file)


@pytest.mark.parametrize("preset", ["strong", "paper", "none"])
def test_only_old_samples_have_their_ratio_truncated(preset: str) -> None:
    settings = [f"preset={preset}"]
    assert config.load(settings=settings).algorithm.ratio_bound == 0
    for one in ("1", "1.0"):
        assert config.load(settings=[*settings, f"training.lag={one}"]).algorithm.ratio_bound == 1
    chosen = config.load(settings=[*settings, "training.lag=1", "algorithm.ratio_bound=2"])
    assert chosen.algorithm.ratio_bound == 2


def test_a_kept_tree_is_all_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIIR_TRAINING__LAG", "1")
    assert config.from_tree({"seed": 2}).training.lag == 0
    assert config.load().training.lag == 1


def test_a_section_in_the_environment_is_json_or_its_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIIR_ENV", '{"map": "8m"}')
    assert config.load().env.map == "8m"
    monkeypatch.setenv("LIIR_ENV", "8m")
    with pytest.raises(ConfigError, match=r'not JSON \(.*"env".*; set its keys, as in LIIR_ENV__MAP'):
        config.load()
