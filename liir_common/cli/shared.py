"""What several commands have in common."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

import typer

from liir_common.errors import ConfigError, storage_explained

Map = Annotated[str, typer.Option("--map", help="Battle map.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def names(text: str) -> list[str]:
    """The names in `text`, separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def numbers(text: str) -> list[int]:
    """The numbers in `text`, separated by commas.

    Raises:
        ConfigError: there is something else.
    """
    try:
        return [int(name) for name in names(text)]
    except ValueError:
        raise ConfigError(f"wanted whole numbers separated by commas, got {text!r}") from None


def by_map(text: str) -> dict[str, int]:
    """The numbers in `text`, MAP=NUMBER separated by commas, by map.

    Raises:
        ConfigError: there is something else.
    """
    try:
        return {name: int(number) for name, number in (part.split("=") for part in names(text))}
    except ValueError:
        raise ConfigError(f"wanted MAP=NUMBER, separated by commas, got {text!r}") from None


def written(output: Path) -> AbstractContextManager[None]:
    """A block that writes to `output`; what the operating system refuses is an error with code 6."""
    return storage_explained(output, "call this again")


def print_result(result: dict[str, Any], as_json: bool) -> None:
    """Show what a benchmark measured."""
    if as_json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        if isinstance(value, dict):
            for key, inner in value.items():
                print_result({f"{name} {key} {k}": v for k, v in inner.items()}, as_json=False)
        else:
            print(f"{name:32} {value:,.4g}" if isinstance(value, float) else f"{name:32} {value}")
