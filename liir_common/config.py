"""The configuration of a run: pydantic models; YAML file < environment < command line.

Unknown keys are errors. A preset fills every value that was not written; `resolve` gives the complete
tree, which the run directory keeps and a resumed run reads back.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_settings import (
    BaseSettings,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from liir_common.errors import ConfigError
from liir_common.types import Exploration


class Section(BaseModel):
    """Base of all sections: frozen; unknown keys, infinite numbers and truth values for numbers refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _check_number(cls, value: Any, info: ValidationInfo) -> Any:
        field = cls.model_fields[info.field_name or ""]
        if isinstance(value, bool) and field.annotation in (int, float):
            raise ValueError(f"wanted a number, got {str(value).lower()}")
        return value


class EnvConfig(Section):
    """What is played."""

    kind: Literal["battle", "smac", "pettingzoo"] = "battle"
    """Our simulator, StarCraft II through the package smac, or any game with one team reward."""
    map: str = "3m"
    """Map of kinds battle (`liir maps`) and smac."""
    factory: str = ""
    """With kind pettingzoo: `module:function` that returns a ParallelEnv with one team reward."""
    options: dict[str, bool | int | float | str] = {}
    """Keyword arguments of the environment, for example reward_only_positive."""

    @property
    def label(self) -> str:
        """Short name for directories and metrics: 3m, smac-3m, or the module of the factory."""
        names = {
            "battle": self.map,
            "smac": f"smac-{self.map}",
            "pettingzoo": self.factory.partition(":")[0].rpartition(".")[2],
        }
        return names[self.kind]


class ExplorationConfig(Section):
    """ε of the behaviour policy, lowered linearly over environment steps."""

    start: float = Field(0.5, ge=0, le=1)
    end: float = Field(0.05, ge=0, le=1)
    steps: int = Field(300_000, ge=0)

    def epsilon(self, env_steps: int) -> float:
        """ε after `env_steps` steps of the run."""
        done = min(1.0, env_steps / self.steps) if self.steps else 1.0
        return self.start + (self.end - self.start) * done


class OptimizerConfig(Section):
    """One optimiser."""

    name: Literal["adam", "rmsprop"] = "adam"
    lr: float = Field(5e-4, gt=0)
    """Learning rate."""
    eps: float = Field(1e-5, gt=0)
    """What is added to the root of the mean square that a step is divided by."""
    alpha: float = Field(0.99, ge=0, lt=1)
    """Smoothing of RMSprop's mean square."""
    clip: float = Field(10.0, gt=0)
    """Largest norm of the gradient."""


class EtaOptimizerConfig(OptimizerConfig):
    """η's: the norm of its gradient is 1e-5 to 1e-3, so that the eps of the others would freeze it."""

    eps: float = Field(1e-10, gt=0)


class ReplayConfig(Section):
    """What value-based methods learn from."""

    episodes: int = Field(5000, ge=1)
    """The newest so many are kept."""
    batch_episodes: int = Field(32, ge=1)
    """Drawn at random for one update; there is none before so many are kept."""
    episodes_per_update: int = Field(8, ge=1)
    """Episodes collected for one update."""

    @model_validator(mode="after")
    def _holds_a_batch(self) -> Self:
        if self.batch_episodes > self.episodes:
            raise ValueError(
                f"batch_episodes wants to be at most episodes ({self.episodes}), got {self.batch_episodes}"
            )
        return self


class AlgorithmConfig(Section):
    """The learning rule; one model for all methods, so that comparisons share settings.

    A method reads what it has a use for. In the value-based ones, iql, vdn and qmix, the Q network counts
    as the policy and has the policy's optimiser.
    """

    name: Literal["liir", "central_v", "iac", "coma", "iql", "vdn", "qmix"] = "liir"
    lambda_: float = Field(0.01, ge=0, alias="lambda")
    """λ of Eq. (2): weight of the intrinsic reward; 0 is the control without it."""
    freeze_eta: bool = False
    """Control: η stays as initialised."""
    outer_samples: Literal["reuse", "fresh"] = "reuse"
    """Step 5 of Algorithm 1: reuse D with importance weights, or judge θ' on the next batch."""
    r_in_bound: float = Field(1.0, gt=0)
    """r_in is squashed to ± this value; the paper has no bound, and without one it grows for ever."""
    gamma: float = Field(0.99, ge=0, le=1)
    """γ, the discount of a step."""
    gae_lambda: float = Field(0.95, ge=0, le=1)
    """λ_g of the returns that values and advantages are made from; 0 is TD(0) as the paper prints it."""
    limit_is_terminal: bool = True
    """Treat the step limit as an end; otherwise bootstrap there."""
    normalize_advantages: bool = True
    """To mean 0 and deviation 1 over the agents and steps of a batch that count."""
    normalize_values: bool = True
    """Fit values to returns less their moving mean, through their moving deviation."""
    target_interval: int = Field(0, ge=0)
    """Learner steps between copies to the target networks; 0 means no target networks."""
    policy_epochs: int = Field(4, ge=1)
    """K policy steps per batch; the meta-gradient goes through the last."""
    critic_epochs: int = Field(4, ge=1)
    """Steps of every value function per batch, each on all of it."""
    ratio_clip: float = Field(0.2, gt=0)
    """PPO's clip of the importance ratio ρ in policy steps, where a batch gives several."""
    ratio_bound: float = Field(0.0, ge=0)
    """ρ is truncated here in v of Eq. (8), and in the policy step where a batch gives one; 0 is no bound, as
    the paper has it. `training.lag: 1`, whose samples are old, sets 1."""
    entropy: float = Field(0.03, ge=0)
    """Weight of the policy's mean entropy beside the return."""
    orthogonal_init: bool = True
    """Orthogonal matrices and zero biases at the start; otherwise uniform in ± 1 / √inputs."""
    policy_gain: float = Field(3.0, gt=0)
    """Gain of the policy head under orthogonal init; a small one saturates the GRU (docs/algorithm.md)."""
    r_in_gain: float = Field(0.1, gt=0)
    """Scale of the r_in head at the start."""
    policy_hidden: int = Field(64, ge=1)
    """Units of the policy's first layer and of its GRU."""
    policy_optimizer: OptimizerConfig = OptimizerConfig()
    eta_optimizer: EtaOptimizerConfig = EtaOptimizerConfig()
    critic_optimizer: OptimizerConfig = OptimizerConfig()
    exploration: ExplorationConfig = ExplorationConfig()
    meta_gradient: Literal["jvp", "difference"] = "jvp"
    """How c = <ũ, ∇log π> is computed: exact forward mode, or by central difference."""
    replay: ReplayConfig = ReplayConfig()
    mixer_width: int = Field(32, ge=1)
    """Hidden units of QMIX's mixer."""
    hypernet_width: int = Field(64, ge=1)
    """Hidden units of the networks that make the mixer's weights."""

    @property
    def value_based(self) -> bool:
        """Whether the policy's outputs are Q values, of which a softmax means nothing."""
        return self.name in ("iql", "vdn", "qmix")

    @property
    def behaviour(self) -> Exploration:
        """How actors choose actions."""
        return Exploration.EPSILON_GREEDY if self.value_based else Exploration.SOFTMAX_FLOOR

    def frozen_choice(self, sampled: bool) -> tuple[Exploration, float]:
        """How a frozen policy chooses, and its epsilon: the best action, or if `sampled` as it was trained.

        Then it draws from the policy; where values are learned, ε-greedy with the ε at which training ends.
        """
        if not sampled:
            return Exploration.GREEDY, 0.0
        return self.behaviour, self.exploration.end if self.value_based else 0.0

    @model_validator(mode="after")
    def _coma_sees_actions(self) -> Self:
        if self.name == "coma" and not self.limit_is_terminal:
            raise ValueError(
                "coma wants limit_is_terminal: its critic would value a joint action after the limit, "
                "which nobody takes"
            )
        return self


class TrainingConfig(Section):
    """How long and in what portions."""

    total_env_steps: int = Field(3_000_000, gt=0)
    batch_episodes: int = Field(32, ge=1)
    lag: int = Field(0, ge=0, le=1)
    """Learner steps that the actors' policy may be behind: 0 on-policy, 1 overlaps play and update."""
    checkpoint_interval: int = Field(100, ge=1)
    """Episodes between frozen checkpoints."""
    save_interval: int = Field(50, ge=1)
    """Learner steps between saves of the learner's own state."""


class CheckpointsConfig(Section):
    """Which frozen checkpoints stay, once they are tested; one that is not yet tested always does."""

    keep_newest: int = Field(0, ge=0)
    """So many newest ones, and what the other rules keep; 0 keeps all."""
    keep_every: int = Field(0, ge=0)
    """Every so many-th of all that were frozen; 0 for none."""
    keep_best: int = Field(1, ge=0)
    """So many best ones, as `client.merit` ranks them."""


class ActorsConfig(Section):
    """The fleet."""

    count: int = Field(32, ge=1)
    ray_address: str = ""
    """Ray cluster to join; empty starts one on this machine."""
    send_security: bool = False
    """Send the files of `security` to the actors through Ray; otherwise every node has them in its place."""
    compress: bool = False
    """Pack trajectories with zstd, for slow links: smaller than the changes of each step, and slower."""
    ticket_timeout_s: float = Field(120.0, gt=0)
    """A ticket that has not come back by then is given to another actor as well."""
    metrics_port: int = Field(9102, ge=0, le=65535)


class LearnerConfig(Section):
    """The learner process."""

    host: str = "127.0.0.1"
    port: int = Field(50051, ge=0, le=65535)
    """0 takes a free one; the run directory's endpoints.json says which."""
    metrics_port: int = Field(9101, ge=0, le=65535)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where learning runs; auto takes a GPU if torch finds one."""
    threads: int = Field(1, ge=1)
    """Of a learner step; actors play beside most of it, so more pay only where cores are idle then."""
    insecure: bool = False
    """Serve plaintext on an address that is not loopback."""
    stay: bool = False
    """Serve a complete run's checkpoints, too, until asked to end; actors and evaluator wait meanwhile."""


class EvaluationConfig(Section):
    """Tests of the frozen checkpoints."""

    enabled: bool = True
    """Without tests a run has no win rates, and `liir train` starts no evaluator."""
    episodes: int = Field(20, ge=1)
    """Greedy episodes per checkpoint; as many sampled ones are played beside them."""
    metrics_port: int = Field(9103, ge=0, le=65535)


class MetricsConfig(Section):
    """Prometheus endpoints of all processes; each section above has its port."""

    host: str = "127.0.0.1"
    """Address that /metrics is served on, without encryption and to whoever asks."""


def _absolute(path: str) -> str:
    return str(Path(path).expanduser().absolute()) if path else ""


FilePath = Annotated[str, AfterValidator(_absolute)]


class SecurityConfig(Section):
    """TLS and tokens of this process. It names files: no secret is ever part of a configuration.

    The name of a folder that holds them all, as `liir certs` makes one per role, may stand for the section.
    """

    ca: FilePath = ""
    """Client: CA certificates (PEM) that the learner's must come from; empty speaks plaintext."""
    cert: FilePath = ""
    """Own certificate (PEM, with its chain): the learner's, or what a client shows if asked."""
    key: FilePath = ""
    """Private key of the certificate (PEM)."""
    client_ca: FilePath = ""
    """Learner: CA certificates (PEM) that every client's must come from; empty asks for none."""
    tokens: FilePath = ""
    """Lines `ROLE TOKEN [EXPIRES]`; the variable LIIR_TOKENS may hold them instead."""

    @classmethod
    def of(cls, folder: str | Path) -> Self:
        """The files of a role's folder.

        Raises:
            ConfigError: there is no such folder.
        """
        return cls(**_files_of_role(folder))

    @model_validator(mode="after")
    def _check_pairs(self) -> Self:
        if bool(self.cert) != bool(self.key):
            raise ValueError("cert and key belong together, only one of them is set")
        if self.client_ca and not self.cert:
            raise ValueError("client_ca asks clients for certificates, which takes a cert and key of its own")
        return self


PLAINTEXT = SecurityConfig()


class Config(BaseSettings):
    """A whole run. Sources, strongest first: keyword arguments, LIIR_* environment, the file."""

    model_config = SettingsConfigDict(
        extra="forbid", frozen=True, env_prefix="LIIR_", env_nested_delimiter="__"
    )

    seed: int = Field(1, ge=0, lt=2**63)
    preset: Literal["strong", "paper", "none"] = "strong"
    """Fills whatever is not written: the learning rule and the reward that it was tuned with."""
    env: EnvConfig = EnvConfig()
    algorithm: AlgorithmConfig = AlgorithmConfig()
    training: TrainingConfig = TrainingConfig()
    checkpoints: CheckpointsConfig = CheckpointsConfig()
    actors: ActorsConfig = ActorsConfig()
    learner: LearnerConfig = LearnerConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    metrics: MetricsConfig = MetricsConfig()
    security: SecurityConfig = SecurityConfig()

    @model_validator(mode="before")
    @classmethod
    def _fill_preset(cls, data: dict[str, Any]) -> dict[str, Any]:
        data = _spelled_out(data)
        preset = str(data.get("preset", "strong"))
        filled = PRESETS.get(preset, {})
        of_method = METHOD_PRESETS.get(_named(data, "algorithm", "name"), {}) if preset != "none" else {}
        if _named(data, "training", "lag") in ("1", "1.0"):
            of_method = of_method | {"ratio_bound": 1.0}
        if _named(data, "env", "kind") == "pettingzoo":
            # Its options are SMAC's, which no other game takes.
            filled = {section: values for section, values in filled.items() if section != "env"}
        return merge(merge(filled, {"algorithm": of_method}), data)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Order of the sources; only `load` gives a file, and without one the arguments are all there is."""
        assert isinstance(init_settings, InitSettingsSource)
        from_file = init_settings.init_kwargs.pop("_file", None)
        if from_file is None:
            return (init_settings,)
        return init_settings, env_settings, InitSettingsSource(settings_cls, from_file)

    def tree(self) -> dict[str, Any]:
        """The complete configuration as plain values, under the names a YAML file uses."""
        return self.model_dump(mode="json", by_alias=True)

    def shared_tree(self) -> dict[str, Any]:
        """The same without `security`: what is told to others, whose files are elsewhere."""
        return self.model_dump(mode="json", by_alias=True, exclude={"security"})


_RMSPROP = {"name": "rmsprop", "lr": 5e-4, "alpha": 0.99, "eps": 1e-5, "clip": 10.0}
PRESETS: Mapping[str, dict[str, Any]] = {
    # What makes the method learn fast; the defaults of the models above are this preset.
    "strong": {"env": {"options": {"reward_only_positive": True, "state_last_action": False}}},
    # The paper's update with the released settings: one plain step a batch, own losses count.
    "paper": {
        "env": {"options": {"reward_only_positive": False, "state_last_action": False}},
        "algorithm": {
            "r_in_bound": 10.0,
            "gae_lambda": 0.8,
            "normalize_advantages": False,
            "normalize_values": False,
            "target_interval": 200,
            "policy_epochs": 1,
            "critic_epochs": 1,
            "entropy": 0.0,
            "orthogonal_init": False,
            "exploration": {"start": 0.5, "end": 0.01, "steps": 50_000},
            "policy_optimizer": _RMSPROP,
            "eta_optimizer": _RMSPROP | {"eps": 1e-10},
            "critic_optimizer": _RMSPROP,
        },
    },
}
_PYMARL = {
    "normalize_advantages": False,
    "normalize_values": False,
    "policy_epochs": 1,
    "entropy": 0.0,
    "orthogonal_init": False,
    "policy_optimizer": _RMSPROP,
    "critic_optimizer": _RMSPROP,
}
_PYMARL_Q = _PYMARL | {
    "gae_lambda": 0.0,
    "target_interval": 6,  # about 200 episodes
    "exploration": {"start": 1.0, "end": 0.05, "steps": 50_000},
}
METHOD_PRESETS: Mapping[str, dict[str, Any]] = {
    # Learning rules that the presets above do not speak of: PyMARL's, whatever the preset.
    "coma": _PYMARL
    | {
        "gae_lambda": 0.8,
        # PyMARL takes a critic step for every time step of a batch and copies after 200 of them.
        "critic_epochs": 8,
        "target_interval": 25,
        "exploration": {"start": 0.5, "end": 0.01, "steps": 100_000},
    },
    "iql": _PYMARL_Q,
    "vdn": _PYMARL_Q,
    "qmix": _PYMARL_Q,
}


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over` laid on top, section by section."""
    out = dict(base)
    for key, value in over.items():
        below = out.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            value = merge(below, value)
        out[key] = value
    return out


def leaves(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of a tree under their dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= leaves(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def differences(kept: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, str]:
    """What two trees say differently, in words, by dotted key; None is said where a key is missing."""
    there, here = leaves(kept), leaves(wanted)
    return {
        key: f"{key}: {there.get(key)!r} there, {here.get(key)!r} wanted"
        for key in there | here
        if there.get(key) != here.get(key)
    }


def load(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """Read a YAML file and lay `key.sub=value` settings over it.

    Raises:
        ConfigError: the file is missing or not YAML, a key is unknown, a value has the wrong type.
    """
    _check_environment()
    try:
        sources: dict[str, Any] = parse_settings(settings) | {"_file": _read(path) if path else {}}
        return Config(**sources)
    except ValidationError as error:
        raise ConfigError(_explain(error)) from None
    except SettingsError as error:
        raise ConfigError(
            f"the environment has a section that is not JSON ({error}); set its keys, as in LIIR_ENV__MAP=8m"
        ) from None


_OF_KUBERNETES = re.compile(
    r"LIIR_(\w+_)?(SERVICE_HOST=.*|SERVICE_PORT(_\w+)?=.*|PORT=\w+://.*|PORT_\d+_[A-Z]+(_\w+)?=.*)"
)
"""What every container is told of a service called liir or liir-something; its PORT is a URL."""


def _check_environment() -> None:
    """Refuse misspelt variables, of which pydantic takes no notice."""
    known = {f"LIIR_{name}".upper() for name in Config.model_fields} | {"LIIR_TOKENS"}
    for name, value in os.environ.items():
        if _OF_KUBERNETES.fullmatch(f"{name}={value}"):
            continue
        if name.upper().startswith("LIIR_") and name.upper().split("__")[0] not in known:
            close = difflib.get_close_matches(name.upper().split("__")[0], known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(sorted(known))}"
            raise ConfigError(f"the environment has the unknown variable {name}; {hint}")


def holds_run(run_dir: Path) -> bool:
    """Whether a run was begun there; its configuration is the last that it writes before it trains."""
    return (run_dir / "config.yaml").exists()


def from_tree(tree: Mapping[str, Any]) -> Config:
    """The configuration that `Config.tree` described; nothing else has a say.

    Raises:
        ConfigError: a key is unknown or missing, or a value has the wrong type.
    """
    try:
        return Config.model_validate(dict(tree))
    except ValidationError as error:
        raise ConfigError(_explain(error)) from None


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not YAML: {error}") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict) or not all(isinstance(key, str) for key in tree):
        got = f"keys {list(tree)}" if isinstance(tree, dict) else type(tree).__name__
        raise ConfigError(f"{path}: wanted a mapping of settings by name, got {got}")
    return _spelled_out(tree)


def _spelled_out(tree: dict[str, Any]) -> dict[str, Any]:
    """`algorithm: qmix` is short for `algorithm: {name: qmix}`, and `env: smac` for `env: {kind: smac}`.

    `security: FOLDER` is short for the names of the files that `liir certs` put there.
    """
    short = {"algorithm": "name", "env": "kind"}
    spelled = {
        key: {short[key]: value} if key in short and isinstance(value, str) else value
        for key, value in tree.items()
    }
    if isinstance(folder := tree.get("security"), str):
        spelled["security"] = _files_of_role(folder)
    return spelled


def _files_of_role(folder: str | Path) -> dict[str, str]:
    path = Path(folder).expanduser()
    if not path.is_dir():
        # Not quoted: somebody may have written a token there.
        raise ConfigError(
            "security: wanted the folder of a role, as `liir certs` makes it, or a section with names of "
            "files; got the name of no folder"
        )
    files = {"ca": "ca.pem", "client_ca": "ca.pem", "cert": "cert.pem", "key": "key.pem", "tokens": "tokens"}
    return {key: str(path / name) for key, name in files.items()}


def _named(data: Mapping[str, Any], section: str, key: str) -> str:
    """`data[section][key]` before validation, when anything may be missing."""
    values = data.get(section)
    return str(values.get(key, "")) if isinstance(values, Mapping) else ""


def parse_settings(settings: Sequence[str]) -> dict[str, Any]:
    """Tree of `key.sub=value` settings; values are YAML.

    Raises:
        ConfigError: a setting has another form.
    """
    tree: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key or key.startswith("_"):
            raise ConfigError(f"--set wants key.sub=value, got {setting!r}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {key}: the value {text!r} is not YAML: {error}") from None
        for part in reversed(key.split(".")):
            value = {part: value}
        tree = merge(tree, _spelled_out(value))
    return tree


def _explain(error: ValidationError) -> str:
    return "the configuration has errors:\n" + "\n".join(
        f"  {_explain_one(item)}" for item in error.errors(include_url=False)
    )


def _explain_one(item: Any) -> str:
    path = ".".join(str(part) for part in item["loc"])
    if item["type"] != "extra_forbidden":
        # Whoever writes a token where a file's name belongs should not find it in a log.
        got = "" if item["loc"][:1] == ("security",) else f"; got {item['input']!r}"
        return f"{path}: {item['msg']}{got}"
    known = _known_keys(item["loc"][:-1])
    close = difflib.get_close_matches(str(item["loc"][-1]), known, n=1)
    hint = f"did you mean {close[0]!r}?" if close else f"known here: {', '.join(sorted(known))}"
    return f"{path}: unknown key; {hint}"


def _known_keys(section: Sequence[str | int]) -> list[str]:
    model: type[BaseModel] = Config
    for part in section:
        field = next(f for name, f in model.model_fields.items() if part in (name, f.alias))
        assert isinstance(field.annotation, type)
        assert issubclass(field.annotation, BaseModel)
        model = field.annotation
    return [field.alias or name for name, field in model.model_fields.items()]
