"""Pictures of a battle, as text and as pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PIXELS_PER_CELL = 16
LETTERS = {
    "baneling": "b",
    "colossus": "c",
    "hydralisk": "h",
    "marauder": "a",
    "marine": "m",
    "medivac": "v",
    "spine_crawler": "p",
    "stalker": "s",
    "zealot": "z",
    "zergling": "l",
}
"""What each unit type is called where there is room for one letter."""
_GROUND, _VOID = (52, 60, 52), (20, 22, 24)
_COLOURS = {"ally": (86, 156, 214), "enemy": (209, 84, 78)}
_TRACER = (255, 226, 150)

Units = Sequence[Mapping[str, Any]]
"""Records as `BattleEnv.snapshot` returns them"""
Image = NDArray[np.uint8]


class Shot(NamedTuple):
    """An attack: places of two units in a snapshot."""

    attacker: int
    target: int


def draw_ansi(units: Units, pathing: NDArray[np.bool_]) -> str:
    """One character per cell, north first: allies in lower case, enemies in upper case."""
    rows = [["." if cell else " " for cell in column] for column in pathing.T]
    for unit in units:
        if unit["alive"]:
            letter = LETTERS[unit["unit_type"]]
            rows[int(unit["y"])][int(unit["x"])] = letter if unit["team"] == "ally" else letter.upper()
    bars = "\n".join(
        f"{unit['team']:>5} {unit['id']:<2} {unit['unit_type']:<13}"
        f"{unit['health']:6.1f} {unit['shield']:6.1f}"
        for unit in units
    )
    return "\n".join("".join(row) for row in reversed(rows)) + "\n" + bars


def draw_rgb(units: Units, pathing: NDArray[np.bool_], shots: Sequence[Shot] = ()) -> Image:
    """Image [H, W, 3], north up; a disc is as bright as its unit is whole."""
    cells = np.where(pathing.T[::-1, :, None], _GROUND, _VOID).astype(np.uint8)
    image = cells.repeat(PIXELS_PER_CELL, axis=0).repeat(PIXELS_PER_CELL, axis=1)
    for unit in units:
        if unit["alive"]:
            _draw_disc(image, unit)
    for shot in shots:
        _draw_line(image, units[shot.attacker], units[shot.target])
    return image


def _draw_disc(image: Image, unit: Mapping[str, Any]) -> None:
    row, column = _pixel(image, unit)
    radius = unit["radius"] * PIXELS_PER_CELL
    top, left = max(0, int(row - radius) - 1), max(0, int(column - radius) - 1)
    window = image[top : int(row + radius) + 2, left : int(column + radius) + 2]
    rows, columns = np.indices(window.shape[:2])
    # How much of each pixel the disc covers, so that its edge is smooth.
    cover = np.clip(radius - np.hypot(rows + top - row, columns + left - column) + 0.5, 0, 1)[..., None]
    vitality = (unit["health"] + unit["shield"]) / (unit["health_max"] + unit["shield_max"])
    colour = np.array(_COLOURS[unit["team"]]) * (0.35 + 0.65 * vitality)
    window[:] = cover * colour + (1 - cover) * window


def _draw_line(image: Image, start: Mapping[str, Any], end: Mapping[str, Any]) -> None:
    a, b = np.array(_pixel(image, start)), np.array(_pixel(image, end))
    along = np.linspace(0, 1, 1 + int(np.abs(b - a).max()))[:, None]
    rows, columns = np.clip((a + along * (b - a)).astype(int), 0, np.array(image.shape[:2]) - 1).T
    image[rows, columns] = _TRACER


def _pixel(image: Image, unit: Mapping[str, Any]) -> tuple[float, float]:
    """Row and column of a unit's centre."""
    return len(image) - unit["y"] * PIXELS_PER_CELL, unit["x"] * PIXELS_PER_CELL
