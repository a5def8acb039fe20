"""Plans of sweeps: which runs, with which settings, and what belongs to a run that is there already."""

import subprocess
from pathlib import Path

import pytest
import yaml

from liir_common import config, results
from liir_common.errors import ConfigError
from liir_common.files import Table, csv_text, read_table
from liir_common.sweep import Sweep, is_complete, plan
from tests.trained import add_evaluations, make_run
from tests.unit.test_files import files_of_at_most

ROOT = Path(__file__).parents[2]
SWEEP = {
    "base": {"preset": "strong", "algorithm": {"entropy": 0.02, "gamma": 0.9}},
    "maps": {"3m": {}, "8m": {"training": {"total_env_steps": 500}, "algorithm": {"gamma": 0.95}}},
    "methods": {"liir": {}, "lambda0": {"algorithm": {"name": "liir", "lambda": 0, "gamma": 0.97}}},
    "seeds": [1, 2],
}


def write(folder: Path, sweep: object) -> Path:
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump(sweep, sort_keys=False))
    return path


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    return write(tmp_path, SWEEP)


def test_the_grid_is_complete_and_method_is_stronger_than_map_than_base(sweep: Path) -> None:
    runs = {run.name: run.config for run in plan(sweep)}
    assert list(runs)[:4] == ["3m-liir-seed1", "3m-liir-seed2", "3m-lambda0-seed1", "3m-lambda0-seed2"]
    assert len(runs) == 8
    plain, control = runs["8m-liir-seed2"], runs["8m-lambda0-seed1"]
    assert (plain.env.map, plain.seed, plain.training.total_env_steps) == ("8m", 2, 500)
    assert (plain.algorithm.name, plain.algorithm.gamma, plain.algorithm.entropy) == ("liir", 0.95, 0.02)
    assert (control.algorithm.name, control.algorithm.lambda_, control.algorithm.gamma) == ("liir", 0, 0.97)
    assert plain.learner.port == plain.learner.metrics_port == plain.actors.metrics_port == 0


def test_a_part_is_named_on_the_command_line(sweep: Path) -> None:
    (run,) = plan(sweep, ["lambda0"], ["8m"], [7], ["training.total_env_steps=9"])
    assert (run.name, run.config.training.total_env_steps) == ("8m-lambda0-seed7", 9)


def test_the_environment_has_no_say(sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIIR_TRAINING__LAG", "1")
    assert {run.config.training.lag for run in plan(sweep)} == {0}


def test_what_is_not_there_is_named(sweep: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown method vdn; this sweep has liir, lambda0"):
        plan(sweep, methods=["vdn"])
    with pytest.raises(ConfigError, match="unknown map 5m; this sweep has 3m, 8m"):
        plan(sweep, maps=["5m"])
    with pytest.raises(ConfigError, match="cannot read the sweep"):
        plan(tmp_path / "nowhere.yaml")
    with pytest.raises(ConfigError, match=r"magic on 3m: (.|\n)*'liir'(.|\n)*got 'magic'"):
        plan(write(tmp_path, SWEEP | {"methods": {"magic": {}}}))
    with pytest.raises(ConfigError, match="is not a sweep"):
        plan(write(tmp_path, {"maps": {"3m": {}}}))


def test_the_papers_comparison_has_its_budgets_and_controls() -> None:
    path = ROOT / "configs" / "figure3.yaml"
    tree = yaml.safe_load(path.read_text())
    assert set(tree["methods"]) == {
        "liir",
        "iql",
        "iac",
        "central_v",
        "coma",
        "qmix",
        "vdn",
        "lambda0",
        "frozen_eta",
        "liir_paper",
    }
    runs = plan(path)
    assert len(runs) == 10 * 4 * 5
    budgets = {run.map: run.config.training.total_env_steps for run in runs}
    assert budgets == {"3m": 3_000_000, "8m": 3_000_000, "2s3z": 10_000_000, "3s5z": 10_000_000}
    # A comparison compares the method: between a control and LIIR one setting differs.
    of = {run.method: run.config.algorithm.model_dump() for run in runs}
    changed = {key for key, value in of["liir"].items() if of["lambda0"][key] != value}
    assert changed == {"lambda_"}
    assert {key for key, value in of["liir"].items() if of["frozen_eta"][key] != value} == {"freeze_eta"}
    released = config.load(settings=["preset=paper"])
    for run in runs:
        if run.method == "liir_paper":
            assert (run.config.algorithm, run.config.env.options) == (
                released.algorithm,
                released.env.options,
            )


def test_figure_2_trains_five_seeds_and_an_untrained_control() -> None:
    runs = plan(ROOT / "configs" / "figure2.yaml")
    assert {(run.method, run.seed) for run in runs} == {
        (method, seed) for method in ("liir", "untrained") for seed in range(1, 6)
    }
    assert {run.config.algorithm.freeze_eta for run in runs if run.method == "untrained"} == {True}


def test_seeds_share_a_digest_and_settings_do_not(sweep: Path) -> None:
    digests: dict[tuple[str, str], set[str]] = {}
    for run in plan(sweep):
        digest = results.config_digest(run.config.tree())
        digests.setdefault((run.map, run.method), set()).add(digest)
    assert [len(found) for found in digests.values()] == [1] * 4
    assert len(set.union(*digests.values())) == 4


def test_complete_means_trained_and_tested(sweep: Path, tmp_path: Path) -> None:
    (run,) = plan(sweep, ["liir"], ["3m"], [1], ["training.total_env_steps=1000"])
    folder = make_run(tmp_path / "run", episodes=())
    assert not is_complete(folder, run.config)
    table = Table(folder / "metrics.csv")
    table.append({"learner_step": 1, "env_steps": 999, "episodes": 250})
    add_evaluations(folder, [1])
    assert not is_complete(folder, run.config)
    table.append({"learner_step": 2, "env_steps": 1001, "episodes": 290})
    assert not is_complete(folder, run.config)  # two checkpoints, one tested
    (folder / "checkpoints").mkdir(exist_ok=True)
    (folder / "checkpoints" / "deleted.csv").write_text("100,lost\n200,0123\n")
    assert not is_complete(folder, run.config)  # the first is both, given up and tested
    (folder / "checkpoints" / "deleted.csv").write_text("200,lost\n")
    assert is_complete(folder, run.config)
    (folder / "checkpoints" / "deleted.csv").unlink()
    (folder / "evaluations.csv").unlink()
    add_evaluations(folder, [1, 2])
    assert is_complete(folder, run.config)


def test_a_run_with_other_settings_is_never_mixed_in(sweep: Path, tmp_path: Path) -> None:
    runs = plan(sweep, ["liir"], ["3m"], [1])
    folder = tmp_path / "out" / "3m-liir-seed1"
    make_run(folder, "algorithm.entropy=0.02", "algorithm.gamma=0.9", "learner.port=7", episodes=())
    Sweep(runs, tmp_path / "out")  # where it listened does not matter
    make_run(folder, "algorithm.entropy=0.5", "algorithm.gamma=0.9", episodes=())
    with pytest.raises(ConfigError, match=r"other settings \(algorithm\.entropy: 0\.5 there, 0\.02 wanted\)"):
        Sweep(runs, tmp_path / "out")


def test_rows_of_other_parts_stay_also_with_a_column_of_an_earlier_build(sweep: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    for seed in (1, 2):
        settings = ("algorithm.entropy=0.02", "algorithm.gamma=0.9", f"seed={seed}")
        add_evaluations(make_run(folder / f"3m-liir-seed{seed}", *settings, episodes=()), [seed])
    old = [row | {"policy_version": 7} for row in results.rows(folder / "3m-liir-seed1")]
    (folder / "results.csv").write_text(csv_text(old))
    Sweep(plan(sweep, ["liir"], ["3m"], [2]), folder)._write()
    kept = read_table(folder / "results.csv")
    assert [(row["seed"], row["greedy_wins"]) for row in kept] == [("1", "1"), ("2", "2")]
    assert tuple(kept[0]) == results.COLUMNS


def test_only_a_larger_budget_belongs_to_a_run_that_is_there(sweep: Path, tmp_path: Path) -> None:
    settings = ["algorithm.entropy=0.02", "algorithm.gamma=0.9"]
    make_run(tmp_path / "out/3m-liir-seed1", *settings, "training.total_env_steps=1000", episodes=())
    Sweep(plan(sweep, ["liir"], ["3m"], [1], ["training.total_env_steps=1001"]), tmp_path / "out")
    with pytest.raises(ConfigError, match=r"training\.total_env_steps: 1000 there, 999 wanted"):
        Sweep(plan(sweep, ["liir"], ["3m"], [1], ["training.total_env_steps=999"]), tmp_path / "out")


def test_a_run_of_an_older_build_is_compared_with_the_defaults_of_what_it_did_not_know(
    sweep: Path, tmp_path: Path
) -> None:
    folder = make_run(
        tmp_path / "out/3m-liir-seed1", "algorithm.entropy=0.02", "algorithm.gamma=0.9", episodes=()
    )
    tree = yaml.safe_load((folder / "config.yaml").read_text())
    del tree["algorithm"]["ratio_bound"]
    (folder / "config.yaml").write_text(yaml.safe_dump(tree))
    Sweep(plan(sweep, ["liir"], ["3m"], [1]), tmp_path / "out")


def test_a_run_gets_tokens_and_no_settings_from_the_environment(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[dict[str, str]] = []

    def popen(command: list[str], env: dict[str, str], **_: object) -> object:
        given.append(env)
        raise KeyboardInterrupt

    monkeypatch.setattr("liir_common.sweep.subprocess.Popen", popen)
    monkeypatch.setenv("LIIR_TOKENS", "reader secret")
    monkeypatch.setenv("LIIR_SEED", "3")
    with pytest.raises(KeyboardInterrupt):
        Sweep(plan(sweep), tmp_path / "out")._begin(plan(sweep)[0])
    assert {name for name in given[0] if name.startswith("LIIR_")} == {"LIIR_TOKENS"}


def test_a_table_that_cannot_be_written_now_stops_no_run(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run,) = plan(sweep, ["liir"], ["3m"], [1])
    runs = Sweep([run], tmp_path / "out")
    with subprocess.Popen(["true"]) as process:
        runs._running[run.name] = run, process
    with files_of_at_most(0):
        runs._command(run, resumed=False)  # writes nothing, so another run may begin
        runs._collect()
        assert "are not as new as the runs: [Errno 27] File too large" in capsys.readouterr().err
        with pytest.raises(OSError, match="File too large"):
            runs._write()
    assert [outcome.status for outcome in runs._outcomes] == ["untested"]
