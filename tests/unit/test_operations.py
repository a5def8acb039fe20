"""docs/operations.md promises nothing that no test shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from liir_common.errors import LiirError

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/operations.md").read_text()


def section(title: str) -> str:
    return TEXT.partition(f"## {title}\n")[2].partition("\n## ")[0]


def rows(text: str, columns: int) -> list[list[str]]:
    """Cells of the table with so many columns, without its head."""
    found = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [cells for cells in found if len(cells) == columns][1:]


@pytest.mark.parametrize(
    ("title", "least"), [("What dies, what happens, what is never lost", 12), ("On a Ray cluster", 4)]
)
def test_every_row_of_what_dies_names_tests_that_exist(title: str, least: int) -> None:
    table = rows(section(title), 4)
    assert len(table) >= least
    for what, _, _, tests in table:
        named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", tests)
        assert named, what
        for path, name in named:
            assert f"def {name}(" in (ROOT / path).read_text(), f"{what}: {path} has no {name}"


def test_every_exit_code_is_explained() -> None:
    codes = {kind.exit_code for kind in LiirError.__subclasses__()} - {LiirError.exit_code}
    explained = rows(section("What dies, what happens, what is never lost"), 2)
    assert {int(code) for code, _ in explained} == codes
