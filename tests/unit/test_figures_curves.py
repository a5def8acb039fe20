"""Results files and figure 3, from runs whose win rates are known."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from liir_common.errors import ConfigError
from liir_common.figures.curves import (
    markdown,
    markdown_runs,
    mean_curve,
    points,
    tabulate,
    tabulate_runs,
    write_figure,
)
from liir_common.files import csv_text, read_table
from liir_common.results import COLUMNS, config_digest, read_curves, rows
from tests.trained import add_evaluations, make_run


def runs(folder: Path) -> list[Path]:
    """LIIR loses and then wins with seed 1, wins a fifth with seed 2; its control never wins."""
    return [
        add_evaluations(make_run(folder / "a", "seed=1", episodes=()), [0] * 10 + [20] * 10),
        add_evaluations(make_run(folder / "b", "seed=2", episodes=()), [4] * 15),
        add_evaluations(make_run(folder / "c", "algorithm.lambda=0", episodes=()), [0] * 3),
    ]


def test_a_results_file_and_run_directories_say_the_same(tmp_path: Path) -> None:
    found = runs(tmp_path)
    table = [row for run in found for row in rows(run)]
    assert tuple(table[0]) == COLUMNS
    (tmp_path / "results.csv").write_text(csv_text(table, COLUMNS))
    assert read_curves([tmp_path / "results.csv"]) == read_curves(found)
    first = read_curves(found)[0]
    assert (first.method, first.map, first.seed) == ("liir", "3m", 1)
    assert first.env_steps == [1000 * i for i in range(1, 21)]
    assert first.rates == [0.0] * 10 + [1.0] * 10


def test_a_results_file_with_a_column_of_an_earlier_build_is_read(tmp_path: Path) -> None:
    found = runs(tmp_path)[:1]
    old = [row | {"policy_version": 7} for row in rows(found[0])]
    (tmp_path / "results.csv").write_text(csv_text(old))
    assert read_curves([tmp_path / "results.csv"]) == read_curves(found)


def test_the_digest_is_of_what_the_numbers_depend_on(tmp_path: Path) -> None:
    digests = {row["config_digest"] for run in runs(tmp_path)[:2] for row in rows(run)}
    other = rows(runs(tmp_path / "again")[2])[0]["config_digest"]
    assert len(digests) == 1
    assert other not in digests
    tree = {"env": {}, "algorithm": {}, "training": {}, "evaluation": {"metrics_port": 1, "episodes": 20}}
    assert config_digest(tree | {"seed": 1, "learner": {"port": 2}}) == config_digest(
        tree | {"evaluation": {"metrics_port": 3, "episodes": 20}}
    )


def test_levels_are_means_over_ten_evaluations_and_over_seeds(tmp_path: Path) -> None:
    liir, control = tabulate(read_curves(runs(tmp_path)))
    assert (liir.method, liir.seeds, liir.env_steps) == ("liir", 2, 15_000)
    # What seed 1 has won after 15 000 steps, where seed 2 ends, is not compared with anything.
    assert (liir.final, liir.best) == pytest.approx((0.35, 0.35))
    assert liir.final_seeds == pytest.approx((0.2, 0.5))
    assert liir.final_episodes[0] < 0.35 < liir.final_episodes[1]
    assert (control.method, control.final, control.final_seeds) == ("liir, λ = 0", 0.0, None)
    assert control.final_episodes[1] == pytest.approx(0.060, abs=1e-3)  # 0 of 60


def test_best_is_not_final(tmp_path: Path) -> None:
    run = add_evaluations(make_run(tmp_path / "a", episodes=()), [20] * 10 + [0] * 10)
    (row,) = tabulate(read_curves([run]))
    assert (row.best, row.final) == pytest.approx((1, 0))


def test_the_goal_is_reached_by_ten_evaluations_together(tmp_path: Path) -> None:
    """Eight of ten at 100 % and two at 50 % are 90 %; nine evaluations say nothing yet."""
    found = [
        add_evaluations(make_run(tmp_path / "a", "seed=1", episodes=()), [0, 10, 10] + [20] * 8),
        add_evaluations(make_run(tmp_path / "b", "seed=2", episodes=()), [0] * 11),
        add_evaluations(make_run(tmp_path / "c", "seed=3", episodes=()), [20] * 9),
    ]
    (row,) = tabulate(read_curves(found[:2]))
    assert row.goal_env_steps == (11_000,)
    assert markdown([row]).endswith("| 11,000 (1 of 2) |\n")
    (row,) = tabulate(read_curves(found[2:]))
    assert markdown([row]).endswith("| – (0 of 1) |\n")


def lines_of_runs(found: list[Path], lowest_from: dict[str, int]) -> list[str]:
    """The table of runs without its head."""
    table = tabulate_runs(read_curves(found), lowest_from)
    return markdown_runs(table, lowest_from).splitlines()[2:]


def test_every_run_is_tabulated_to_its_own_end(tmp_path: Path) -> None:
    """Seed 1 wins 90 % twice in a row, then from the tenth evaluation on three times; 180 of 200 battles
    of evaluations 9 to 18, 156 of 12 to 21, 189 of 21 to 30, 196 of 22 to 31. Seed 2's first ten at 90 % are
    the lowest after."""
    wins = [0] * 5 + [20, 18, 0, 17, 18, 18, 18] + [20] * 5 + [9, 12, 8, 9] + [20] * 9 + [16]
    first, second = (make_run(tmp_path / f"{seed}", f"seed={seed}", episodes=()) for seed in (1, 2))
    found = [
        add_evaluations(first, wins, sampled=[won // 2 for won in wins]),
        add_evaluations(second, [0] + [18] * 10 + [20] * 10, sampled=[10] * 21),
    ]
    assert lines_of_runs(found, {"3m": 21_000}) == [
        "| 3m | liir | 1 | 31,000 | 10,000 | 18,000 | 78.0 | 21,000 | 94.5 | 47.0 | 98.0 | 49.0 |",
        "| 3m | liir | 2 | 21,000 | 2,000 | 11,000 | 90.0 | 21,000 | – | – | 100.0 | 50.0 |",
    ]
    assert "| 22,000 | 98.0 | 49.0 |" in lines_of_runs(found, {"3m": 22_000})[0]
    assert lines_of_runs(found, {})[0] == "| 3m | liir | 1 | 31,000 | 10,000 | 18,000 | 78.0 | 98.0 | 49.0 |"


def test_nine_evaluations_have_no_ten_together(tmp_path: Path) -> None:
    run = add_evaluations(make_run(tmp_path / "a", episodes=()), [18] * 9)
    (line,) = lines_of_runs([run], {"3m": 0})
    assert line == "| 3m | liir | 1 | 9,000 | 1,000 | – | – | 0 | – | – | 90.0 | 90.0 |"


def test_the_mean_ends_where_the_first_seed_does(tmp_path: Path) -> None:
    steps, mean, deviation = mean_curve(read_curves(runs(tmp_path)[:2]))
    assert (steps[0], steps[-1]) == (1000, 15_000)
    # Means of five evaluations: at first all lost and a fifth won, at 15 000 all won and a fifth won.
    assert (mean[0], mean[np.searchsorted(steps, 6000)]) == pytest.approx((0.1, 0.1))
    assert mean[-1] == pytest.approx(0.6)
    assert deviation[-1] == pytest.approx(np.std([1, 0.2], ddof=1))


def test_the_mean_does_not_look_ahead(tmp_path: Path) -> None:
    run = add_evaluations(make_run(tmp_path / "a", episodes=()), [0] * 4 + [20] * 4)
    steps, mean, _ = mean_curve(read_curves([run]))
    assert mean[steps <= 4000] == pytest.approx(0)
    assert mean[-1] == pytest.approx(0.8)


def test_every_point_has_its_interval(tmp_path: Path) -> None:
    found = list(points(read_curves(runs(tmp_path))))
    assert len(found) == 38
    assert all(float(p["wilson_low"]) <= p["wins"] / p["episodes"] <= float(p["wilson_high"]) for p in found)


def test_the_figure_is_a_picture_with_its_table(tmp_path: Path) -> None:
    text = write_figure(read_curves(runs(tmp_path)), tmp_path / "out")
    assert text == (tmp_path / "out" / "figure3.md").read_text()
    assert "\n| 3m | liir | 2 | 15,000 | – | – | – | 20.0 | 20.0 |\n" in text
    assert (tmp_path / "out" / "figure3.png").read_bytes().startswith(b"\x89PNG")
    assert "| 3m | liir | 2 | 15,000 | 35.0 | 20.0 to 50.0 |" in text
    assert [row["final"] for row in read_table(tmp_path / "out" / "figure3.csv")] == ["0.3500", "0.0000"]


def test_more_than_five_maps_go_on_in_another_row(tmp_path: Path) -> None:
    maps = ("3m", "8m", "2s3z", "3s5z", "MMM", "MMM2")
    found = [
        add_evaluations(make_run(tmp_path / name, f"env.map={name}", episodes=()), [4] * 3) for name in maps
    ]
    write_figure(read_curves(found), tmp_path / "six")
    write_figure(read_curves(found[:5]), tmp_path / "five")
    (height, width), one_row = (
        imread(tmp_path / folder / "figure3.png").shape[:2] for folder in ("six", "five")
    )
    assert (height, width) == (2 * one_row[0], one_row[1])


def test_what_cannot_be_a_curve_is_named(tmp_path: Path) -> None:
    first = runs(tmp_path)[0]
    with pytest.raises(ConfigError, match="seed 1, is there more than once"):
        read_curves([first, first])
    with pytest.raises(ConfigError, match=r"evaluations\.csv is not a results file: it lacks commit"):
        read_curves([first / "evaluations.csv"])
    with pytest.raises(ConfigError, match="got nothing there"):
        read_curves([tmp_path / "nowhere.csv"])
    with pytest.raises(ConfigError, match="holds no run"):
        read_curves([tmp_path])
    with pytest.raises(ConfigError, match="no evaluation in"):
        read_curves([make_run(tmp_path / "new", episodes=())])
