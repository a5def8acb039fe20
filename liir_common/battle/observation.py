"""What SMAC v1 shows: observations, global state and action masks, value for value in its layout."""

import numpy as np

from liir_common.battle.engine import NO_OP, STEPS, STOP
from liir_common.battle.tables import FIRST_ATTACK, SHOOT_RANGE, SIGHT, inlined, kernel

MAP_SIZE = 32.0
_CENTRE = MAP_SIZE / 2.0
# Products instead of quotients, which take several times as long; float32 shows no difference.
_PER_SIGHT = 1.0 / SIGHT


@kernel
def observe(tables, battle, obs, state, mask, alive):
    """Write the situation into obs [n, O], state [S], mask [n, A] and alive [n]."""
    obs[:] = 0.0
    mask[:] = False
    for i in range(tables.rules[0].n_allies):
        alive[i] = battle.units[i].alive
        if alive[i]:
            _write_mask(tables, battle, i, mask[i])
            _write_observation(tables, battle, i, obs[i], mask[i])
        else:
            mask[i, NO_OP] = True
        if tables.rules[0].obs_timestep_number:
            obs[i, -1] = battle.status[STEPS] / tables.rules[0].limit
    _write_state(tables, battle, state)


@inlined
def _write_mask(tables, battle, i, mask):
    """Moves look one cell ahead; attacks need a living enemy in SMAC v1's shoot range."""
    x, y, n_allies = battle.x[i], battle.y[i], tables.rules[0].n_allies
    mask[STOP] = True
    for k in range(4):
        mask[STOP + 1 + k] = _can_stand(tables.pathing, x + (k == 2) - (k == 3), y + (k == 0) - (k == 1))
    for j in range(tables.rules[0].n_enemies):
        enemy = n_allies + j
        distance2 = (battle.x[enemy] - x) ** 2 + (battle.y[enemy] - y) ** 2
        mask[FIRST_ATTACK + j] = battle.units[enemy].alive and distance2 <= SHOOT_RANGE**2


@inlined
def _can_stand(pathing, x, y):
    cell_x, cell_y = int(x), int(y)
    return 0 <= cell_x < pathing.shape[0] and 0 <= cell_y < pathing.shape[1] and pathing[cell_x, cell_y]


@inlined
def _write_observation(tables, battle, i, obs, mask):
    rules, units, specs = tables.rules[0], battle.units, tables.specs
    at = 4
    for k in range(at):
        obs[k] = mask[STOP + 1 + k]
    width = 4 + rules.obs_all_health * (1 + rules.enemy_shields) + rules.enemy_bits
    for j in range(rules.n_enemies):
        other, spec = units[rules.n_allies + j], specs[rules.n_allies + j]
        if _write_seen(battle, i, rules.n_allies + j, obs, at):
            obs[at] = mask[FIRST_ATTACK + j]
            if rules.obs_all_health:
                _write_health(other, spec, rules.enemy_shields, obs, at + 4)
            if rules.enemy_bits:
                obs[at + width - rules.enemy_bits + spec.type_bit] = 1.0
        at += width
    health = rules.obs_all_health * (1 + rules.ally_shields)
    width = 4 + health + rules.ally_bits + rules.obs_last_action * rules.n_actions
    for j in range(rules.n_allies):
        if j != i:
            other, spec = units[j], specs[j]
            if _write_seen(battle, i, j, obs, at):
                obs[at] = 1.0
                if rules.obs_all_health:
                    _write_health(other, spec, rules.ally_shields, obs, at + 4)
                if rules.ally_bits:
                    obs[at + 4 + health + spec.type_bit] = 1.0
                if rules.obs_last_action and battle.last_actions[j] >= 0:
                    obs[at + 4 + health + rules.ally_bits + battle.last_actions[j]] = 1.0
            at += width
    if rules.obs_own_health:
        _write_health(units[i], specs[i], rules.ally_shields, obs, at)
        at += 1 + rules.ally_shields
    if rules.ally_bits:
        obs[at + specs[i].type_bit] = 1.0


@inlined
def _write_seen(battle, i, j, obs, at):
    """Where unit j is for unit i, if it is alive and nearer than the sight range; whether it is."""
    if not battle.units[j].alive:
        return False
    x, y = battle.x[j] - battle.x[i], battle.y[j] - battle.y[i]
    distance2 = x * x + y * y
    if distance2 >= SIGHT**2:
        return False
    obs[at + 1] = np.sqrt(distance2) * _PER_SIGHT
    obs[at + 2] = x * _PER_SIGHT
    obs[at + 3] = y * _PER_SIGHT
    return True


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
        if units[i].alive:
            state[at] = units[i].health * specs[i].per_health
            if is_ally:
                state[at + 1] = max(0.0, units[i].ready_at - battle.clock[0]) / specs[i].cooldown_norm
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
