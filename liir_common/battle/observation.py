"""What SMAC v1 shows: observations, global state and action masks, value for value in its layout."""

import numpy as np

from liir_common.battle.engine import NO_OP, NORTH, STEPS, STOP, WEST
from liir_common.battle.nearby import above, lowest, members, near, only
from liir_common.battle.tables import FIRST_ATTACK, SHOOT_RANGE, SIGHT, SURROUNDINGS, inlined, kernel

MAP_SIZE = 32.0
_CENTRE = MAP_SIZE / 2.0
# Products instead of quotients, which take several times as long; they differ in the last bit at most.
_PER_SIGHT = 1.0 / SIGHT
SIGHT2, SHOOT_RANGE2 = SIGHT**2, SHOOT_RANGE**2
_MOVES = WEST - STOP
_SURROUNDINGS = np.array(SURROUNDINGS)


@kernel
def observe(tables, battle, obs, state, mask, alive):
    """Write the situation into obs [n, O], state [S], mask [n, A] and alive [n]."""
    obs[:] = 0.0
    mask[:] = False
    n_allies = tables.rules[0].n_allies
    allies = members(battle.alive, 0) & ~above(n_allies - 1)
    enemies = members(battle.alive, n_allies)
    for i in range(n_allies):
        alive[i] = battle.alive[i]
        if alive[i]:
            at = _write_moves(tables, battle, i, obs[i], mask[i])
            at = _write_enemies(tables, battle, i, enemies, obs[i], mask[i], at)
            at = _write_allies(tables, battle, i, allies, obs[i], at)
            _write_self(tables, battle, i, obs[i], at)
        else:
            mask[i, NO_OP] = True
        if tables.rules[0].obs_timestep_number:
            obs[i, -1] = battle.status[STEPS] / tables.rules[0].limit
    if tables.rules[0].obs_instead_of_state:
        for i in range(len(obs)):
            for k in range(obs.shape[1]):
                state[i * obs.shape[1] + k] = obs[i, k]
    else:
        _write_state(tables, battle, state)


@inlined
def _write_moves(tables, battle, i, obs, mask):
    """A unit may move where the ground is open half a move ahead; the observation starts with that.

    Returns where the next features go.
    """
    rules, probe = tables.rules[0], 0.5 * tables.rules[0].move_amount
    mask[STOP] = True
    for k in range(_MOVES):
        x = battle.x[i] + probe * ((k == 2) - (k == 3))
        y = battle.y[i] + probe * ((k == 0) - (k == 1))
        mask[NORTH + k] = obs[k] = _is_open(tables.pathing, int(x), int(y), False)
    at = _MOVES
    if rules.obs_pathing_grid:
        for k in range(len(_SURROUNDINGS)):
            x, y = _cell_around(rules, battle, i, k)
            obs[at + k] = _is_open(tables.pathing, x, y, True)
        at += len(_SURROUNDINGS)
    if rules.obs_terrain_height:
        for k in range(len(_SURROUNDINGS)):
            x, y = _cell_around(rules, battle, i, k)
            inside = 0 <= x < tables.height.shape[0] and 0 <= y < tables.height.shape[1]
            obs[at + k] = tables.height[x, y] if inside else 1.0
        at += len(_SURROUNDINGS) + 1
        obs[at - 1] = tables.height[int(battle.x[i]), int(battle.y[i])]
    return at


@inlined
def _cell_around(rules, battle, i, k):
    """The cell of the k-th place that is probed around unit i, maybe off the map."""
    x = int(battle.x[i]) + rules.move_amount * _SURROUNDINGS[k, 0]
    y = int(battle.y[i]) + rules.move_amount * _SURROUNDINGS[k, 1]
    return int(x), int(y)


@inlined
def _is_open(pathing, x, y, outside):
    if 0 <= x < pathing.shape[0] and 0 <= y < pathing.shape[1]:
        return pathing[x, y]
    return outside


@inlined
def _write_enemies(tables, battle, i, living, obs, mask, at):
    """Features and attack availability of the living enemies; returns where the next features go."""
    rules = tables.rules[0]
    width = 4 + rules.obs_all_health * (1 + rules.enemy_shields) + rules.enemy_bits
    heals = rules.has_healers and tables.specs[i].heals
    if heals:
        _mask_heals(tables, battle, i, mask)
    seen = near(battle, i, SIGHT2, rules.n_allies, len(battle.units)) & living
    while seen:
        k = lowest(seen)
        seen &= above(k)
        # Unsigned, so that no index needs a test for being negative.
        j, start = np.uint32(rules.n_allies + k), np.uint32(at + k * width)
        distance2 = _write_place(battle, i, j, obs, start)
        # SMAC v1 looks a healer's slots up as if they were attacks.
        if heals:
            obs[start] = mask[FIRST_ATTACK + k]
        else:
            mask[FIRST_ATTACK + k] = obs[start] = distance2 <= SHOOT_RANGE2
        if rules.obs_all_health:
            _write_health(battle.units[j], tables.specs[j], rules.enemy_shields, obs, start + 4)
        if rules.enemy_bits:
            obs[start + width - rules.enemy_bits + tables.specs[j].type_bit] = 1.0
    return at + rules.n_enemies * width


@inlined
def _mask_heals(tables, battle, i, mask):
    """A healer's attack actions are for allies: all that are near and no healers, even in full health."""
    for j in range(min(tables.rules[0].n_allies, tables.rules[0].n_enemies)):
        x, y = battle.x[j] - battle.x[i], battle.y[j] - battle.y[i]
        is_near = x * x + y * y <= SHOOT_RANGE2
        mask[FIRST_ATTACK + j] = is_near and battle.alive[j] and not tables.specs[j].heals


@inlined
def _write_allies(tables, battle, i, living, obs, at):
    """Features of all other living allies; returns where the next features go."""
    rules = tables.rules[0]
    bits = 4 + rules.obs_all_health * (1 + rules.ally_shields)
    width = bits + rules.ally_bits + rules.obs_last_action * rules.n_actions
    seen = near(battle, i, SIGHT2, 0, rules.n_allies) & living & ~only(i)
    while seen:
        j = lowest(seen)
        seen &= above(j)
        start = np.uint32(at + (j - (j > i)) * width)
        _write_place(battle, i, j, obs, start)
        obs[start] = 1.0
        if rules.obs_all_health:
            _write_health(battle.units[j], tables.specs[j], rules.ally_shields, obs, start + 4)
        if rules.ally_bits:
            obs[start + bits + tables.specs[j].type_bit] = 1.0
        if rules.obs_last_action and battle.last_actions[j] >= 0:
            obs[start + bits + rules.ally_bits + battle.last_actions[j]] = 1.0
    return at + (rules.n_allies - 1) * width


@inlined
def _write_place(battle, i, j, obs, at):
    """Where unit j is for unit i; returns the squared distance."""
    x, y = battle.x[j] - battle.x[i], battle.y[j] - battle.y[i]
    distance2 = x * x + y * y
    obs[at + 1] = np.sqrt(distance2) * _PER_SIGHT
    obs[at + 2] = x * _PER_SIGHT
    obs[at + 3] = y * _PER_SIGHT
    return distance2


@inlined
def _write_self(tables, battle, i, obs, at):
    rules, spec = tables.rules[0], tables.specs[i]
    if rules.obs_own_health:
        _write_health(battle.units[i], spec, rules.ally_shields, obs, at)
        at += 1 + rules.ally_shields
    if rules.ally_bits:
        obs[at + spec.type_bit] = 1.0


@inlined
def _write_health(unit, spec, shields, out, at):
    out[at] = unit.health * spec.per_health
    if shields:
        out[at + 1] = unit.shield * spec.per_shield


@inlined
def _write_state(tables, battle, state):
    rules, units, specs = tables.rules[0], battle.units, tables.specs
    state[:] = 0.0
    at = 0
    for i in range(len(units)):
        is_ally = i < rules.n_allies
        shields, bits = (
            (rules.ally_shields, rules.ally_bits) if is_ally else (rules.enemy_shields, rules.enemy_bits)
        )
        width = 3 + is_ally + shields + bits
        if battle.alive[i]:
            state[at] = units[i].health * specs[i].per_health
            if is_ally:
                waits = max(0.0, units[i].ready_at - battle.clock[0])
                state[at + 1] = (units[i].energy if specs[i].heals else waits) / specs[i].cooldown_norm
            state[at + 1 + is_ally] = (battle.x[i] - _CENTRE) / MAP_SIZE
            state[at + 2 + is_ally] = (battle.y[i] - _CENTRE) / MAP_SIZE
            if shields:
                state[at + 3 + is_ally] = units[i].shield * specs[i].per_shield
            if bits:
                state[at + width - bits + specs[i].type_bit] = 1.0
        at += width
    if rules.state_last_action:
        for i in range(rules.n_allies):
            if battle.last_actions[i] >= 0:
                state[at + battle.last_actions[i]] = 1.0
            at += rules.n_actions
    if rules.state_timestep_number:
        state[at] = battle.status[STEPS] / rules.limit
