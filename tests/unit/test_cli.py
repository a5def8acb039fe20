"""The command line is what the documents say."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from liir_common.cli import app
from liir_common.errors import ConfigError, StorageError
from liir_common.files import read_table
from services.learner import bench
from tests.trained import add_evaluations, make_run

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "configs").glob("*.yaml")]
RESULTS = ROOT / "docs" / "results"
# The processes' own entry points parse what follows these.
PASS_ON = {"learner", "actors", "evaluator"}


def liir(*arguments: object) -> str:
    """What a command prints; it has to succeed."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def quoted() -> Iterator[str]:
    """Every command that the documents quote; a|b are two."""
    for text in TEXTS:
        for line in re.findall(r"(?:`|^)liir ([a-z][^`\n#…]*)", text.read_text(), re.M):
            words = [word.split("|") for word in line.split()]
            yield from (" ".join(choice) for choice in itertools.product(*words))


@pytest.mark.parametrize("line", sorted(set(quoted())))
def test_every_quoted_command_and_option_exists(line: str) -> None:
    command, words = typer.main.get_command(app), line.split()
    while hasattr(command, "commands") and words:
        assert words[0] in command.commands, f"liir {line}: no command {words[0]!r}"
        command = command.commands[words.pop(0)]
    if command.name not in PASS_ON:
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("-")} <= known


@pytest.mark.parametrize("name", ["sim", "rollout"])
def test_a_benchmark_prints_one_json_object(name: str) -> None:
    result = CliRunner().invoke(app, ["bench", name, "--map", "3m", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["env_steps_per_s"] > 0


def test_bench_learner_prints_what_it_documents(monkeypatch: pytest.MonkeyPatch) -> None:
    # Two threads on a busy machine wait for each other, thousands of times.
    monkeypatch.setattr(bench, "bench_learner", partial(bench.bench_learner, threads=(1,), repeats=1))
    options = ("--map", "3m", "--steps", 2, "--set", "algorithm.policy_hidden=8")
    measured = json.loads(liir("bench", "learner", *options, "--json"))
    assert measured.keys() == {"env_steps", "flops", "threads"}
    assert 32 * 2 <= measured["env_steps"] <= 32 * 3
    assert measured["threads"].keys() == {"1"}
    figures = {"update_ms", "cpu_ms", "floor_ms", "ratio", "matmul_gflops", "square_gflops"}
    assert measured["threads"]["1"].keys() == figures


@pytest.mark.parametrize(
    ("name", "function", "options", "wanted"),
    [
        ("wire", "services.learner.bench_wire.bench_wire", ["--streams", "3"], ("8m", 3)),
        ("policy", "services.learner.bench_wire.bench_policy", ["--streams", "3"], ("8m", 3)),
        ("beside", "services.learner.bench_wire.bench_beside", ["--rate", "2.5"], ("8m", 2.5)),
        (
            "train",
            "liir_common.bench.bench_train",
            ["--env-steps", "2000", "--set", "seed=7"],
            ("8m", 2000, ["seed=7"]),
        ),
        ("start", "liir_common.bench.bench_start", ["--set", "seed=7"], ("8m", ["seed=7"])),
        (
            "death",
            "liir_common.bench.bench_death",
            ["--deaths", "2", "--set", "seed=7"],
            ("8m", 2, ["seed=7"]),
        ),
        (
            "resume",
            "liir_common.bench.bench_resume",
            ["--episodes", "40", "--repeats", "2", "--set", "seed=7"],
            ("8m", 40, 2, ["seed=7"]),
        ),
    ],
)
def test_a_benchmark_gets_its_options(
    name: str, function: str, options: list[str], wanted: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What they measure takes minutes, and has tests of its own."""
    monkeypatch.setattr(function, lambda *given: {"given": list(given)})
    printed = json.loads(liir("bench", name, "--map", "8m", *options, "--json"))
    assert printed == {"given": list(wanted)}


def evaluated(folder: Path) -> list[Path]:
    """Two runs that win half and a fifth of their tests, less at first."""
    return [
        add_evaluations(make_run(folder / "a", "seed=1", episodes=()), [0] + [10] * 10),
        add_evaluations(make_run(folder / "b", "seed=2", episodes=()), [0] + [4] * 10),
    ]


def test_figure_3_is_drawn_from_run_directories(tmp_path: Path) -> None:
    printed = liir("figure", "3", *evaluated(tmp_path), "-o", tmp_path / "out")
    (row,) = read_table(tmp_path / "out" / "figure3.csv")
    assert (row["map"], row["method"], row["seeds"]) == ("3m", "liir", "2")
    assert float(row["final"]) == pytest.approx(0.35)
    assert (tmp_path / "out" / "figure3.md").read_text() in printed
    assert (tmp_path / "out" / "figure3.png").read_bytes().startswith(b"\x89PNG")


def test_figure_3_is_asked_for_the_lowest_level_from_a_step_of_a_map_on(tmp_path: Path) -> None:
    runs = evaluated(tmp_path)
    printed = liir("figure", "3", *runs, "--from", "3m=2000", "-o", tmp_path / "out")
    assert printed.count("| 2,000 | 50.0 | 50.0 |") == printed.count("| 2,000 | 20.0 | 20.0 |") == 1
    with pytest.raises(ConfigError, match="--from names 8m, of which there is no run"):
        liir("figure", "3", *runs, "--from", "3m=2000,8m=2000", "-o", tmp_path / "out")
    with pytest.raises(ConfigError, match="wanted MAP=NUMBER, separated by commas, got '2000'"):
        liir("figure", "3", *runs, "--from", "2000", "-o", tmp_path / "out")


@pytest.mark.parametrize("name", sorted(path.parent.name for path in RESULTS.glob("*/figure3.md")))
def test_the_kept_results_give_the_tables_beside_them(name: str, tmp_path: Path) -> None:
    """By the command in their README, which is for bash."""
    folder = RESULTS / name
    quoted = re.search(r"^liir (figure 3 (?:.*\\\n)*.*)", (folder / "README.md").read_text(), re.M)
    assert quoted, f"{folder} does not say how its figure is drawn"
    command = f"'{sys.executable}' -m liir_common.cli {quoted[1]} -o '{tmp_path}'"
    subprocess.run(["bash", "-c", command], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    for table in ("figure3.md", "figure3.csv"):
        assert (tmp_path / table).read_text() == (folder / table).read_text()


@pytest.mark.parametrize(("number", "map_name"), [("4", "3m"), ("5", "2s3z")])
def test_figures_4_and_5_show_the_battle_that_is_asked_for(
    number: str, map_name: str, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run", f"env.map={map_name}", episodes=(100, 200))
    options = ("--checkpoint", 100, "--episode", 3, "--marks", "2,5", "--sampled")
    printed = liir("figure", number, "--run-dir", run, *options, "-o", tmp_path)
    assert printed.splitlines() == ["step 2: marked", "step 5: marked", str(tmp_path / f"figure{number}.png")]
    kept = json.loads((tmp_path / f"figure{number}.json").read_text())
    assert {
        "checkpoint": 100,
        "map": map_name,
        "test_episode": 3,
        "actions": "sampled",
    }.items() <= kept.items()
    assert list(kept["marks"]) == ["2", "5"]
    assert (tmp_path / f"figure{number}.png").read_bytes().startswith(b"\x89PNG")


def test_the_cosine_is_printed_and_kept(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", episodes=(100, 200))
    printed = liir("figure", "cosine", "--run-dir", run, "--episodes", 5, "--sampled", "-o", tmp_path)
    assert printed == (tmp_path / "cosine.txt").read_text()
    kept = json.loads((tmp_path / "cosine.json").read_text())
    assert {"checkpoint": 200, "map": "3m", "episodes": 5, "actions": "sampled"}.items() <= kept.items()
    assert len(kept["readings"]) == 5
    assert all(reading.keys() == {"cosine", "vectors", "values"} for reading in kept["readings"].values())


def test_a_report_is_written_into_its_run_and_gathered(tmp_path: Path) -> None:
    first, second = evaluated(tmp_path)
    printed = liir("report", first, second, "-o", tmp_path / "out")
    for run, best in ((first, 0.5), (second, 0.2)):
        assert str(run) in printed
        assert json.loads((run / "summary.json").read_text())["best_greedy"] == best
        assert (run / "winrate.png").read_bytes().startswith(b"\x89PNG")
    rows = read_table(tmp_path / "out" / "runs.csv")
    assert [(row["run"], row["best_greedy"]) for row in rows] == [("a", "0.5"), ("b", "0.2")]
    assert len(read_table(tmp_path / "out" / "results.csv")) == 22
    with pytest.raises(ConfigError, match="holds no run"):
        liir("report", tmp_path / "out")


@pytest.mark.parametrize("command", ["certs", "figure", "report"])
def test_what_cannot_be_written_is_explained(tmp_path: Path, command: str) -> None:
    run_dir = make_run(tmp_path / "run")
    taken = tmp_path / "taken"
    taken.write_text("a file, where a folder is to be made")
    arguments = {
        "certs": ["certs"],
        "figure": ["figure", "cosine", "--run-dir", run_dir, "--episodes", 1],
        "report": ["report", run_dir],
    }[command]
    result = CliRunner().invoke(app, [*map(str, arguments), "-o", str(taken)])
    assert isinstance(result.exception, StorageError), result.exception
    assert re.fullmatch(f"cannot use {taken}.*: .*; mend that, then call this again", str(result.exception))
    assert taken.is_file()


def test_an_archive_that_finds_no_room_is_explained(tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "run")
    command = [sys.executable, "-m", "liir_common.cli", "backup", "--run-dir", str(run_dir)]
    with open("/dev/full", "wb") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert result.stderr.startswith("error: cannot write to standard output: No space left on device; free ")
    assert result.returncode == StorageError.exit_code
