"""How units move: the walk of one loop, around obstacles and along walls, and the pushing apart of discs.

Compiled parts of the kernels in `engine`.
"""

import numpy as np

from liir_common.battle.nearby import above, holds, lowest, members, near
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
    share = speed / np.sqrt(distance2)
    if share > 1.0:
        share = 1.0
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
    """The cell of a position along one axis; beyond the map that at its border, which no layer can enter."""
    return np.uint32(min(max(int(position), 0), MAP_SIZE - 1))


@inlined
def separate(tables, battle, walkers):
    """Push overlapping discs apart; only units that walked in this loop can have made an overlap.

    For battles of SET_SIZE units at most. `walkers` is the set of those who walked; some may have died since.
    """
    living = members(battle.alive, 0)
    left = walkers & living
    while left:
        i = lowest(left)
        left &= above(i)
        # Walkers below i have had their turn with it.
        others = living & (above(i) | ~walkers)
        contact2 = tables.contact2[tables.specs[i].kind]
        touched = near(battle, i, contact2, 0, len(battle.units)) & others
        while touched:
            j = lowest(touched)
            _part(tables, battle, i, j, holds(walkers, j))
            touched = near(battle, i, contact2, 0, len(battle.units)) & others & above(j)


@apart
def separate_many(tables, battle, now):
    """What `separate` does, one by one: for battles of any size."""
    for i in range(len(battle.units)):
        if battle.units[i].walked_at == now and battle.alive[i]:
            contact2 = tables.contact2[tables.specs[i].kind]
            for j in range(len(battle.units)):
                both_walked = battle.units[j].walked_at == now
                had_turn = both_walked and j <= i
                if squared_distance(battle, i, j) < contact2[j] and battle.alive[j] and not had_turn:
                    _part(tables, battle, i, j, both_walked)


@inlined
def _part(tables, battle, i, j, both_walked):
    """Unit i walked into unit j: walkers and idle friends give way half, all others stand firm."""
    rules, distance, x, y = tables.rules[0], np.sqrt(squared_distance(battle, i, j)), 1.0, 0.0
    overlap = tables.pairs[tables.specs[i].kind, tables.specs[j].kind].contact - distance
    if distance > 0.0:
        x, y = (battle.x[i] - battle.x[j]) / distance, (battle.y[i] - battle.y[j]) / distance
    is_friend = (i < rules.n_allies) == (j < rules.n_allies)
    is_shared = both_walked or (rules.push_idle and is_friend and battle.units[j].order == IDLE)
    share = 0.5 * overlap if is_shared else overlap
    _give_way(tables, battle, i, x, y, share, True)
    if is_shared:
        _give_way(tables, battle, j, -x, -y, share, both_walked)


@inlined
def _give_way(tables, battle, i, x, y, overlap, walks):
    """Back off along (x, y), away from the blocker; who walks goes around it on the side of the heading."""
    unit = battle.units[i]
    is_headed = walks and unit.heading_x * x + unit.heading_y * y < 0.0
    # No branch, which the processor would often guess wrongly.
    slide = np.copysign(tables.rules[0].slide * is_headed, unit.heading_y * x - unit.heading_x * y + 0.0)
    _displace(tables, battle, i, overlap * (x - slide * y), overlap * (y + slide * x))
