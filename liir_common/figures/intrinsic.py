"""Figures 4 and 5: each agent's intrinsic reward along one test battle, and the field at marked steps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from liir_common.battle.snapshots import UnitRecord
from liir_common.errors import ConfigError
from liir_common.figures.run import Battle, Frozen, battles, taken
from liir_common.files import write_atomic
from liir_common.types import FloatArray

_COLOURS = {"ally": "C0", "enemy": "C3"}


def marked_steps(battle: Battle, r_in: FloatArray) -> dict[int, str]:
    """The steps worth a look, with why: the first death on either side and the largest |r_in| taken.

    A death belongs to the step in which it happened; `r_in` [T, n] is that of the actions taken.
    """
    marks: dict[int, list[str]] = {}
    for team in ("ally", "enemy"):
        dead = [any(u["team"] == team and not u["alive"] for u in units) for units in battle.units]
        if any(dead):
            marks.setdefault(dead.index(True) - 1, []).append(f"first {team} dies")
    step, agent = np.unravel_index(np.nanargmax(np.abs(r_in)), r_in.shape)
    marks.setdefault(int(step), []).append(f"largest |r_in|: agent {agent}")
    return {step: ", ".join(reasons) for step, reasons in sorted(marks.items())}


def write_figure(
    frozen: Frozen, name: str, output: Path, index: int = 0, mode: str = "greedy", marks: Sequence[int] = ()
) -> dict[str, Any]:
    """Play test battle `index` and write NAME.png and NAME.json into `output`; returns the JSON.

    `marks` replaces the steps that `marked_steps` chooses.

    Raises:
        ConfigError: the run plays no battle, or a mark is not a step of it.
    """
    (battle,) = battles(frozen, range(index, index + 1), mode)
    r_in = taken(battle.r_in, battle.trajectory)
    steps = len(r_in)
    if any(not 0 <= mark < steps for mark in marks):
        raise ConfigError(f"marks want steps from 0 to {steps - 1} of this battle, got {list(marks)}")
    chosen = dict.fromkeys(marks, "marked") or marked_steps(battle, r_in)
    figures = frozen.about() | {
        "map": frozen.config.env.map,
        "test_episode": index,
        "actions": mode,
        "won": bool(battle.trajectory.info["won"]),
        "marks": chosen,
        "health": [[u["health"] for u in units if u["team"] == "ally"] for units in battle.units[:-1]],
        "action": battle.trajectory.actions.tolist(),
        "r_in": [[None if np.isnan(value) else float(value) for value in row] for row in r_in],
    }
    output.mkdir(parents=True, exist_ok=True)
    write_atomic(output / f"{name}.json", json.dumps(figures).encode())
    _draw(battle, r_in, chosen, f"{frozen.run}, checkpoint {frozen.episode}", output / f"{name}.png")
    return figures


def _draw(battle: Battle, r_in: FloatArray, marks: dict[int, str], title: str, output: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(7, 4 * len(marks)), 5.5), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=[3, 2]))
    axes = above.subplots()
    for agent, values in enumerate(r_in.T):
        axes.plot(values, marker=".", label=f"agent {agent}")
    for step in marks:
        axes.axvline(step, color="grey", ls=":", lw=1)
    axes.set(title=title, xlabel="step", ylabel="r_in of the action taken")
    axes.legend()
    panels = below.subplots(1, len(marks), squeeze=False)[0]
    for panel, (step, why) in zip(panels, marks.items(), strict=True):
        _draw_units(panel, battle.units[step], _view(battle))
        panel.set_title(f"step {step}: {why}", fontsize=8)
    figure.savefig(output, dpi=120)


def _view(battle: Battle) -> tuple[float, float, float, float]:
    """West, east, south and north end of where units are during the battle, with room for text."""
    xs, ys = zip(*((u["x"], u["y"]) for units in battle.units for u in units), strict=True)
    return min(xs) - 4, max(xs) + 4, min(ys) - 1, max(ys) + 1


def _draw_units(axes: Any, units: Sequence[UnitRecord], view: tuple[float, float, float, float]) -> None:
    """Living units where they stand, with team, number and health (and shield)."""
    from matplotlib.patches import Circle

    west, east, south, north = view
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal", xticks=[], yticks=[])
    for unit in units:
        if not unit["alive"]:
            continue
        colour, at = _COLOURS[unit["team"]], (unit["x"], unit["y"])
        whole = (unit["health"] + unit["shield"]) / (unit["health_max"] + unit["shield_max"])
        axes.add_patch(
            Circle(at, unit["radius"], facecolor=colour, alpha=0.25 + 0.75 * whole, edgecolor=colour)
        )
        shield = f"+{unit['shield']:.0f}" if unit["shield_max"] else ""
        text = f"{unit['id']}: {unit['health']:.0f}{shield}"
        offset, side = ((-6, 0), "right") if unit["team"] == "ally" else ((6, 0), "left")
        axes.annotate(
            text, at, offset, textcoords="offset points", ha=side, va="center", fontsize=7, color=colour
        )
