"""The ground of SMAC v1's maps, and the ways around its obstacles.

Cells are unit squares numbered (x, y) from the south-west corner. The figures are those of the map archives.
How the game makes a pathing grid of them is known for the lane only (an API bitmap), and inferred elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

MAP_SIZE = 32
_MARGIN = 2
"""Cells along the map's edge where no ground unit stands."""
GROUND, CLIFFS, AIR = range(3)
"""Layers: units of one layer collide and share the cells that they can enter."""

Grid = NDArray[np.bool_]
_EDGE = "heights and the pathing at the edge are inferred"


@dataclass(frozen=True)
class Terrain:
    """Where units can be on a map; all arrays are [32, 32] by (x, y)."""

    pathing: Grid
    """Where ground units can stand; what SMAC v1 shows and judges moves by"""
    ridge: Grid
    """What only units that walk cliffs can enter besides"""
    level: NDArray[np.float64]
    """Cliff level: 0 for the void, 1, 2, and values between on ramps"""
    has_obstacles: bool = False
    """Whether a straight line between two places may leave the ground"""
    uncertain: str = _EDGE
    """What no source settles about it"""

    @property
    def layers(self) -> Grid:
        """[3, 32, 32], the cells that GROUND, CLIFFS and AIR units can enter.

        How near to the map's edge aircraft may go is not known; one cell is kept.
        """
        air = np.zeros_like(self.pathing)
        air[1:-1, 1:-1] = True
        return np.stack([self.pathing, self.pathing | self.ridge, air])

    @property
    def height(self) -> NDArray[np.float64]:
        """[32, 32], height as SMAC v1 normalises it: the byte of the game's API through 255.

        A level is 2 high and level 1 lies at 8, as on other maps of the game; a byte spans heights from -16
        to 16. That these maps follow suit is inferred.
        """
        return np.round((6 + 2 * self.level + 16) / 32 * 255) / 255


def _cells(south: int, rows: str) -> Grid:
    """The grid of rows "first-last" from `south` upwards; "+" joins stretches of a row, "*" repeats it."""
    grid = np.zeros((MAP_SIZE, MAP_SIZE), np.bool_)
    y = south
    for row in rows.split():
        stretches, _, repeats = row.partition("*")
        for _ in range(int(repeats or 1)):
            for stretch in stretches.split("+"):
                first, last = stretch.split("-")
                grid[int(first) : int(last) + 1, y] = True
            y += 1
    return grid


def _flat(level: Grid, pathing: Grid, has_obstacles: bool = False, uncertain: str = _EDGE) -> Terrain:
    return Terrain(pathing, np.zeros_like(pathing), level.astype(float), has_obstacles, uncertain)


def _ravine() -> Terrain:
    """A plateau above low ground: a cliff between them, and a ramp at each end."""
    low = _cells(5, "3-28 2-29 1-30 0-31*10 1-30 2-29 3-28")
    plateau = _cells(13, "7-24*8")
    level = low.astype(float) + plateau
    for step in range(3):
        for x in (4 + step, 27 - step):
            level[x, 13:19] = 1 + (step + 1) / 4
    pathing = _cells(5, "4-27 3-28 2-29*5 2-3+28-29 2-29*6 7-24 8-23")
    return Terrain(
        pathing,
        ridge=_cells(12, "4-27") & ~pathing,
        level=level,
        has_obstacles=True,
        uncertain="heights and the pathing at the cliff and the edge are inferred",
    )


TERRAINS: Mapping[str, Terrain] = {
    "lane": _flat(_cells(7, "0-31*18"), _cells(7, "2-29*18"), uncertain="heights are inferred"),
    "open": _flat(_cells(0, "0-31*32"), _cells(_MARGIN, "2-29*28")),
    "octagon": _flat(
        _cells(5, "9-22 8-23 7-24 6-25 5-26*14 6-25 7-24 8-23 9-22"),
        _cells(5, "10-21 9-22 8-23 7-24 6-25 5-26*12 6-25 7-24 8-23 9-22 10-21"),
    ),
    "pentagon": _flat(
        _cells(7, "7-20*14 8-19 9-18 10-17 11-16"), _cells(7, "8-19 7-20*12 8-19 9-18 10-17 11-16 12-15")
    ),
    "rounded_square": _flat(
        _cells(7, "9-20 8-21 7-22*10 8-21 9-20"), _cells(7, "10-19 9-20 8-21 7-22*8 8-21 9-20 10-19")
    ),
    "ravine": _ravine(),
    "corridor": _flat(
        _cells(
            1,
            "1-14*2 1-13 1-12*6 1-13 1-14 1-15 10-26 11-27 12-28 12-29 11-30*6 12-30 13-30 14-30 15-30 "
            "16-30 17-30 18-30 19-30",
        ),
        _cells(
            2,
            "2-12*9 2-13 2-14 11-25 12-26 13-27 13-28 12-29 11-29*4 12-29 13-29 14-29 15-29 16-29 17-29 "
            "18-29 19-29",
        ),
        has_obstacles=True,
    ),
    "baneling_path": _flat(
        _cells(
            1,
            "1-8 1-9 1-12*3 1-13 1-16*2 2-16 3-17 3-20*2 6-20 7-20*2 7-21 8-26 9-26 12-26 13-27 13-30*2 "
            "14-30 15-30 18-30 19-30*3 20-30 21-30",
        ),
        _cells(
            2,
            "2-8 2-11 2-12*3 2-15 2-16 3-16*2 3-19 4-20 7-20*3 8-20 9-25 10-26 13-26*2 13-29 14-29 15-29 "
            "16-29 19-29*3 20-29 21-29",
        ),
        has_obstacles=True,
    ),
}

_CLEARANCE = 0.4
"""How far the ground must be open on both sides of a way, so that it holds from all over a cell."""


@cache
def routes(terrain: str) -> NDArray[np.int16]:
    """The next waypoint for ground units: [1024, 1024] by (from, to), cells numbered 32 x + y.

    -1 where the way is straight (or none is known), else the cell whose centre to walk to: the first bend of
    the shortest way over open ground. A way to a cell that cannot be entered leads to the nearest one that
    can. Terrains without obstacles have an empty table.
    """
    pathing = TERRAINS[terrain].pathing
    if not TERRAINS[terrain].has_obstacles:
        return np.zeros((0, 0), np.int16)
    cells = np.argwhere(pathing)
    bends = np.argwhere(_bends(pathing))
    bend_to_cell = _lengths(pathing, bends, cells)
    between = _lengths(pathing, bends, bends)
    for middle in range(len(bends)):
        between = np.minimum(between, between[:, middle, None] + between[None, middle])
    onward = (between[:, :, None] + bend_to_cell[None]).min(axis=1)
    # Who stands on a bend needs another one.
    ahead = np.where(bend_to_cell > 0, bend_to_cell, np.inf)
    first = np.array([(lengths[:, None] + onward).argmin(axis=0) for lengths in ahead.T])
    straight = np.isfinite(_lengths(pathing, cells, cells))
    ids = cells @ (MAP_SIZE, 1)
    table = np.full((MAP_SIZE**2, MAP_SIZE**2), -1, np.int16)
    table[np.ix_(ids, ids)] = np.where(straight, -1, (bends @ (MAP_SIZE, 1))[first])
    return np.ascontiguousarray(table[:, _nearest_open(pathing)])


def _bends(pathing: Grid) -> Grid:
    """Cells around which a shortest way can turn: those at a convex corner of an obstacle."""
    padded = np.pad(pathing, 1)
    found = np.zeros_like(pathing)
    for dx in (0, 2):
        for dy in (0, 2):
            beside = padded[dx : dx + MAP_SIZE, 1:-1] & padded[1:-1, dy : dy + MAP_SIZE]
            found |= pathing & beside & ~padded[dx : dx + MAP_SIZE, dy : dy + MAP_SIZE]
    return found


def _lengths(pathing: Grid, starts: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.float64]:
    """[starts, ends], distances of cells with a clear straight way between them; others are infinite."""
    way = (ends[None] - starts[:, None]).astype(float)
    length = np.hypot(way[..., 0], way[..., 1])
    aside = _CLEARANCE * np.stack([-way[..., 1], way[..., 0]], -1) / np.maximum(length, 1.0)[..., None]
    clear = np.ones(length.shape, np.bool_)
    for share in np.linspace(0.0, 1.0, 2 * MAP_SIZE):
        centre = starts[:, None] + 0.5 + share * way
        for side in (-1, 0, 1):
            at = (centre + side * aside).astype(np.int64)
            clear &= pathing[at[..., 0], at[..., 1]]
    return np.where(clear, length, np.inf)


def _nearest_open(pathing: Grid) -> NDArray[np.int64]:
    """[1024], for every cell the number of the nearest that ground units can enter."""
    open_cells = np.argwhere(pathing)
    everywhere = np.argwhere(np.ones_like(pathing))
    gaps = ((everywhere[:, None] - open_cells[None]) ** 2).sum(axis=-1)
    nearest: NDArray[np.int64] = (open_cells @ (MAP_SIZE, 1))[gaps.argmin(axis=1)]
    return nearest
