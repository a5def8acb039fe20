"""The command line is what the documents say."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from liir_common.cli import app

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "configs").glob("*.yaml")]
# The processes' own entry points parse what follows these.
PASS_ON = {"learner", "actors", "evaluator"}


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
