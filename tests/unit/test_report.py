"""Summary and curve of a run, from its files alone."""

import json
from pathlib import Path

import pytest
import yaml

from liir_common import config
from liir_common.errors import ConfigError
from liir_common.files import Table, read_table
from liir_common.report import curve_labels, print_summary, summarise, write_report, write_results
from liir_common.results import COLUMNS, read_curves


def make_run(path: Path, greedy: list[float]) -> Path:
    path.mkdir()
    Table(path / "metrics.csv").append({"learner_step": 7, "env_steps": 900, "episodes": 56})
    table = Table(path / "evaluations.csv")
    for index, rate in reversed(list(enumerate(greedy, start=1))):  # reports may come in any order
        table.append(
            {
                "episode": 100 * index,
                "env_steps": 1000 * index,
                "seconds": 2.0 * index,
                "greedy_wins": round(40 * rate),
                "greedy_episodes": 40,
                "greedy_win_rate": rate,
                "sampled_wins": round(20 * rate),
                "sampled_episodes": 40,
                "sampled_win_rate": rate / 2,
            }
        )
    return path


def make_result(path: Path, *settings: str, rates: list[float]) -> Path:
    run = make_run(path, rates)
    (run / "config.yaml").write_text(yaml.safe_dump(config.load(None, settings).tree()))
    (run / "run.json").write_text(json.dumps({"git": "abc"}))
    return run


def test_levels_want_one_and_three_in_a_row(tmp_path: Path) -> None:
    summary = summarise(make_run(tmp_path / "run", [0.0, 0.95, 0.5, 0.9, 1.0, 0.9, 0.2]))
    assert (summary.learner_steps, summary.env_steps, summary.episodes) == (7, 900, 56)
    assert summary.first_win_rate_90_env_steps == 2000
    assert summary.first_win_rate_90_seconds == 4.0
    assert summary.reached_90_env_steps == 4000
    assert summary.best_greedy == 1.0
    assert summary.last_ten_greedy == pytest.approx(4.45 / 7)
    assert summary.last_ten_sampled == pytest.approx(4.45 / 14)


def test_last_ten_means_ten(tmp_path: Path) -> None:
    summary = summarise(make_run(tmp_path / "run", [0.0] * 4 + [0.5] + [1.0] * 9))
    assert (summary.last_ten_greedy, summary.last_ten_sampled) == pytest.approx((0.95, 0.475))


def test_a_summary_shows_the_sizes_of_the_networks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run", [0.5])
    (run / "run.json").write_text(json.dumps({"parameters": {"theta": 28297, "eta": 12000}}))
    print_summary(run, summarise(run))
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["parameters", "of", "theta", "28297"] in shown
    assert ["parameters", "of", "eta", "12000"] in shown
    assert ["best", "greedy", "0.5"] in shown


def test_a_run_without_evaluations_has_no_curve(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [])
    summary = write_report(run)
    assert summary.reached_90_env_steps is None
    assert summary.last_ten_greedy is None
    assert not (run / "winrate.png").exists()


def test_the_curve_is_a_picture(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [0.0, 0.5, 1.0])
    write_report(run)
    assert (run / "winrate.png").read_bytes().startswith(b"\x89PNG")


def test_results_gather_runs_by_method(tmp_path: Path) -> None:
    methods = {"a": [], "b": ["algorithm.lambda=0"], "c": ["algorithm.name=central_v"]}
    runs = [make_result(tmp_path / name, *settings, rates=[0.5, 1.0]) for name, settings in methods.items()]
    write_results(runs, tmp_path / "results")
    rows = read_table(tmp_path / "results" / "runs.csv")
    assert [row["method"] for row in rows] == ["liir", "liir, λ = 0", "central_v"]
    assert {row["commit"] for row in rows} == {"abc"}
    curves = read_curves([tmp_path / "results" / "results.csv"])
    assert curves == read_curves(runs)
    assert [curve.method for curve in curves] == ["liir", "liir, λ = 0", "central_v"]
    assert [curve.rates for curve in curves] == [[0.5, 1.0]] * 3
    assert [curve.sampled_rates for curve in curves] == [[0.25, 0.5]] * 3
    assert config.load(tmp_path / "results" / "b.yaml", ["preset=none"]).algorithm.lambda_ == 0
    assert (tmp_path / "results" / "winrate.png").exists()


def test_results_of_runs_without_a_test_are_a_header(tmp_path: Path) -> None:
    run = make_result(tmp_path / "a", "evaluation.enabled=false", rates=[])
    write_results([run], tmp_path / "results")
    assert (tmp_path / "results" / "results.csv").read_text() == ",".join(COLUMNS) + "\n"


def test_runs_of_one_name_are_refused(tmp_path: Path) -> None:
    sweeps = tmp_path / "a", tmp_path / "b"
    for sweep in sweeps:
        sweep.mkdir()
    runs = [make_result(sweep / "3m-liir-seed1", rates=[0.5]) for sweep in sweeps]
    with pytest.raises(ConfigError, match="3m-liir-seed1 more than once"):
        write_results(runs, tmp_path / "results")


def test_a_map_is_named_with_the_game_that_it_is_of(tmp_path: Path) -> None:
    runs = [make_result(tmp_path / kind, f"env.kind={kind}", rates=[0.5]) for kind in ("battle", "smac")]
    write_results(runs, tmp_path / "results")
    assert [row["map"] for row in read_table(tmp_path / "results" / "runs.csv")] == ["3m", "smac-3m"]


def test_curves_of_one_method_are_named_by_the_settings_that_differ() -> None:
    settings = ([], [], ["algorithm.policy_optimizer.lr=0.1"], ["algorithm.name=central_v"])
    configs = [config.load(None, chosen).tree() for chosen in settings]
    plain, other = "liir, policy_optimizer.lr 0.0005", "liir, policy_optimizer.lr 0.1"
    assert curve_labels(configs) == [plain, plain, other, "central_v"]


def test_curves_of_several_maps_are_named_by_their_map() -> None:
    configs = [config.load(None, [f"env.map={name}"]).tree() for name in ("3m", "8m")]
    assert curve_labels(configs) == ["3m, liir", "8m, liir"]
