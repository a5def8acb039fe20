"""Pictures of a battle, as text and as pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
_TRACER, _LIFE, _SHIELD = (255, 226, 150), (96, 200, 120), (120, 190, 255)
_BLAST = 0.35
"""Opacity of a blast"""

Units = Sequence[Mapping[str, Any]]
"""Records as `BattleEnv.snapshot` returns them"""
Image = NDArray[np.uint8]


class Shot(NamedTuple):
    """An attack: places of two units in a snapshot."""

    attacker: int
    target: int


class Blast(NamedTuple):
    """Where a unit burst, and how far that reached."""

    x: float
    y: float
    radius: float


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


def draw_rgb(
    units: Units,
    pathing: NDArray[np.bool_],
    shots: Sequence[Shot] = (),
    blasts: Sequence[Blast] = (),
    scale: int = PIXELS_PER_CELL,
) -> Image:
    """Image [H, W, 3] with `scale` pixels per cell, north up.

    A disc is as bright as its unit is whole; the bars above it are life and shield.
    """
    cells = np.where(pathing.T[::-1, :, None], _GROUND, _VOID).astype(np.uint8)
    image = cells.repeat(scale, axis=0).repeat(scale, axis=1)
    alive = [unit for unit in units if unit["alive"]]
    for blast in blasts:
        _paint_disc(image, _pixel(image, blast._asdict(), scale), blast.radius * scale, _TRACER, _BLAST)
    for unit in alive:
        _draw_disc(image, unit, scale)
    for shot in shots:
        _draw_line(image, units[shot.attacker], units[shot.target], scale)
    for unit in alive:
        _draw_bars(image, unit, scale)
    return image


def _draw_disc(image: Image, unit: Mapping[str, Any], scale: int) -> None:
    vitality = (unit["health"] + unit["shield"]) / (unit["health_max"] + unit["shield_max"])
    colour = np.array(_COLOURS[unit["team"]]) * (0.35 + 0.65 * vitality)
    _paint_disc(image, _pixel(image, unit, scale), unit["radius"] * scale, colour)


def _paint_disc(
    image: Image, centre: tuple[float, float], radius: float, colour: ArrayLike, opacity: float = 1.0
) -> None:
    row, column = centre
    top, left = max(0, int(row - radius) - 1), max(0, int(column - radius) - 1)
    window = image[top : int(row + radius) + 2, left : int(column + radius) + 2]
    rows, columns = np.indices(window.shape[:2])
    # How much of each pixel the disc covers, so that its edge is smooth.
    cover = np.clip(radius - np.hypot(rows + top - row, columns + left - column) + 0.5, 0, 1)[..., None]
    window[:] = opacity * cover * np.asarray(colour) + (1 - opacity * cover) * window


def _draw_bars(image: Image, unit: Mapping[str, Any], scale: int) -> None:
    (row, column), radius = _pixel(image, unit, scale), unit["radius"] * scale
    thick, width = max(2, scale // 8), int(2 * radius)
    top, left = int(row - radius) - thick, max(0, int(column - radius))
    for name, colour in (("health", _LIFE), ("shield", _SHIELD)):
        if unit[f"{name}_max"]:
            top -= thick
            bar = image[max(0, top) : max(0, top + thick - 1), left : left + width]
            bar[:] = _VOID
            bar[:, : round(width * unit[name] / unit[f"{name}_max"])] = colour


def _draw_line(image: Image, start: Mapping[str, Any], end: Mapping[str, Any], scale: int) -> None:
    a, b = np.array(_pixel(image, start, scale)), np.array(_pixel(image, end, scale))
    along = np.linspace(0, 1, 1 + int(np.abs(b - a).max()))[:, None]
    rows, columns = np.clip((a + along * (b - a)).astype(int), 0, np.array(image.shape[:2]) - 1).T
    image[rows, columns] = _TRACER


def _pixel(image: Image, unit: Mapping[str, Any], scale: int) -> tuple[float, float]:
    """Row and column of a unit's centre."""
    return len(image) - unit["y"] * scale, unit["x"] * scale
