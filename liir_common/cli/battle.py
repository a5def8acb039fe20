"""`liir maps` and `liir calibrate`: the battle simulator."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from liir_common.cli.shared import Json
from liir_common.errors import ConfigError

app = typer.Typer()


@app.command()
def maps(as_json: Json = False) -> None:
    """List the battle maps: who fights whom, the limit in steps, and what no source settles."""
    from liir_common.battle.scenarios import SCENARIOS, describe

    rows = [describe(scenario) for scenario in SCENARIOS.values()]
    if as_json:
        print(json.dumps(rows))
        return
    from rich.console import Console
    from rich.table import Column, Table

    name = Column("map", no_wrap=True)
    table = Table(name, "agents", "enemies", "actions", "limit", "terrain", "uncertain")
    for row in rows:
        sides = [_roll(row["agents"]), _roll(row["enemies"])]
        table.add_row(
            row["map"], *sides, str(row["n_actions"]), str(row["limit"]), row["terrain"], row["uncertain"]
        )
    Console().print(table)


def _roll(units: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in units.items())


@app.command()
def calibrate(
    map_name: Annotated[
        str | None, typer.Option("--map", help="One map; all with targets if absent.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1)] = 2000,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, help="Of the first episode.")] = 0,
    as_json: Json = False,
) -> None:
    """Compare the simulator with what is published about SMAC v1 on StarCraft II."""
    from dataclasses import asdict

    from liir_common.battle.calibrate import TARGETS, format_rows
    from liir_common.battle.calibrate import calibrate as measure

    try:
        tables = {name: measure(name, episodes, seed) for name in ([map_name] if map_name else TARGETS)}
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if as_json:
        rows = {
            name: [
                asdict(row.target)
                | {
                    "measured": row.measured,
                    "standard_error": row.standard_error,
                    "difference": row.difference,
                }
                for row in table
            ]
            for name, table in tables.items()
        }
        print(json.dumps(rows))
    else:
        print("\n".join(format_rows(name, table) for name, table in tables.items()))
