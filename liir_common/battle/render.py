"""Pictures of a battle, as text and as pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

PIXELS_PER_CELL = 16
_GROUND, _VOID = (52, 60, 52), (20, 22, 24)
_COLOURS = {"ally": (86, 156, 214), "enemy": (209, 84, 78)}


def draw_ansi(units: Sequence[Mapping[str, Any]], pathing: NDArray[np.bool_]) -> str:
    """One character per cell, north first: allies in lower case, enemies in upper case."""
    rows = [["." if cell else " " for cell in column] for column in pathing.T]
    for unit in units:
        if unit["alive"]:
            letter = unit["unit_type"][0]
            rows[int(unit["y"])][int(unit["x"])] = letter if unit["team"] == "ally" else letter.upper()
    bars = "\n".join(
        f"{unit['team']:>5} {unit['id']:<2} {unit['unit_type']:<9}{unit['health']:6.1f} {unit['shield']:6.1f}"
        for unit in units
    )
    return "\n".join("".join(row) for row in reversed(rows)) + "\n" + bars


def draw_rgb(units: Sequence[Mapping[str, Any]], pathing: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Image [H, W, 3], north up; a disc is as bright as its unit is whole."""
    cells = np.where(pathing.T[::-1, :, None], _GROUND, _VOID).astype(np.uint8)
    image = cells.repeat(PIXELS_PER_CELL, axis=0).repeat(PIXELS_PER_CELL, axis=1)
    rows, columns = np.indices(image.shape[:2])
    x, y = columns / PIXELS_PER_CELL, len(pathing) - rows / PIXELS_PER_CELL
    for unit in units:
        if unit["alive"]:
            disc = np.hypot(x - unit["x"], y - unit["y"]) <= unit["radius"]
            vitality = (unit["health"] + unit["shield"]) / (unit["health_max"] + unit["shield_max"])
            image[disc] = np.array(_COLOURS[unit["team"]]) * (0.35 + 0.65 * vitality)
    return image
