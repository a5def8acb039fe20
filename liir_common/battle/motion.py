"""How units move: the walk of one loop, around obstacles and along walls, and the pushing apart of discs.

Compiled parts of the kernels in `engine`.
"""

import numpy as np

from liir_common.battle.tables import IDLE, apart, inlined
from liir_common.battle.terrain import GROUND, MAP_SIZE


@inlined
def squared_distance(battle, i, j):
    """From the centre of i to that of j."""
    x, y = battle.x[j] - battle.x[i], battle.y[j] - battle.y[i]
    return x * x + y * y


@inlined
def walk(tables, battle, i, x, y, now):
    """One loop of walking along (x, y), the way to the goal; a goal nearer than that is reached.

    Whether it walks.
    """
    unit, spec, distance2 = battle.units[i], tables.specs[i], x * x + y * y
    if now < unit.free_at or distance2 == 0.0:
        return False
    if tables.rules[0].has_obstacles and spec.layer == GROUND:
        x, y = _around(tables, battle, i, x, y)
        distance2 = x * x + y * y
    speed = spec.speed
    if tables.rules[0].has_healers:
        # Only aircraft take more than a loop to get going.
        unit.pace = speed = min(
            speed, (unit.pace if unit.walked_at == now - 1.0 else 0.0) + spec.acceleration
        )
    share = min(1.0, speed / np.sqrt(distance2))
    unit.heading_x, unit.heading_y = x * share, y * share
    unit.walked_at = now
    _displace(tables, battle, i, unit.heading_x, unit.heading_y)
    return True


@apart
def _around(tables, battle, i, x, y):
    """The way to the next bend, or (x, y) where nothing stands in that way."""
    to_x = min(max(int(battle.x[i] + x), 0), MAP_SIZE - 1)
    to_y = min(max(int(battle.y[i] + y), 0), MAP_SIZE - 1)
    start = int(battle.x[i]) * MAP_SIZE + int(battle.y[i])
    bend = tables.routes[start, to_x * MAP_SIZE + to_y]
    if bend < 0:
        return x, y
    return bend // MAP_SIZE + 0.5 - battle.x[i], bend % MAP_SIZE + 0.5 - battle.y[i]


@inlined
def _displace(tables, battle, i, x, y):
    """Move a unit, axis by axis, as far as the ground allows; so units slide along walls."""
    cells = tables.layers[tables.specs[i].layer]
    if cells[_cell(battle.x[i] + x), _cell(battle.y[i])]:
        battle.x[i] += x
    if cells[_cell(battle.x[i]), _cell(battle.y[i] + y)]:
        battle.y[i] += y


@inlined
def _cell(position):
    """The cell of a position along one axis; the map's size is a power of two, so masking keeps within it."""
    return np.uint32(np.int64(position) & (MAP_SIZE - 1))


@inlined
def separate(tables, battle, now):
    """Push overlapping discs apart; only units that walked in this loop can have made an overlap."""
    for i in range(len(battle.units)):
        if battle.units[i].walked_at == now and battle.units[i].alive:
            contact2 = tables.contact2[tables.specs[i].kind]
            # Everybody touches himself.
            if _count_touched(battle, i, contact2) > 1:
                _separate_one(tables, battle, i, contact2, now)


@inlined
def _count_touched(battle, i, contact2):
    """How many units overlap i, dead or alive and i among them: a quick test for the common case."""
    count = 0
    for j in range(len(contact2)):
        count += squared_distance(battle, i, j) < contact2[j]
    return count


@inlined
def _separate_one(tables, battle, i, contact2, now):
    for j in range(len(contact2)):
        distance2 = squared_distance(battle, i, j)
        if distance2 < contact2[j] and j != i and battle.units[j].alive:
            both_walked = battle.units[j].walked_at == now
            if not (both_walked and j < i):
                contact = tables.pairs[tables.specs[i].kind, tables.specs[j].kind].contact
                _part(tables, battle, i, j, np.sqrt(distance2), contact, both_walked)


@inlined
def _part(tables, battle, i, j, distance, contact, both_walked):
    """Unit i walked into unit j: walkers and idle friends give way half, all others stand firm."""
    rules, overlap, x, y = tables.rules[0], contact - distance, 1.0, 0.0
    if distance > 0.0:
        x, y = (battle.x[i] - battle.x[j]) / distance, (battle.y[i] - battle.y[j]) / distance
    is_friend = (i < rules.n_allies) == (j < rules.n_allies)
    if both_walked:
        _give_way(tables, battle, i, x, y, 0.5 * overlap)
        _give_way(tables, battle, j, -x, -y, 0.5 * overlap)
    elif rules.push_idle and is_friend and battle.units[j].order == IDLE:
        _give_way(tables, battle, i, x, y, 0.5 * overlap)
        _displace(tables, battle, j, -0.5 * overlap * x, -0.5 * overlap * y)
    else:
        _give_way(tables, battle, i, x, y, overlap)


@inlined
def _give_way(tables, battle, i, x, y, overlap):
    """Back off along (x, y), away from the blocker, and go around it on the side of the heading."""
    unit, slide = battle.units[i], 0.0
    if unit.heading_x * x + unit.heading_y * y < 0.0:
        leftward = unit.heading_y * x - unit.heading_x * y >= 0.0
        slide = tables.rules[0].slide if leftward else -tables.rules[0].slide
    _displace(tables, battle, i, overlap * (x - slide * y), overlap * (y + slide * x))
