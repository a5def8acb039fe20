"""The battle itself: compiled kernels that start a battle and play one environment step of eight loops.

The rules are those of StarCraft II as far as they are public; `parameters` names what is not. What SMAC v1
adds is who may do what, the reward and the end of the episode.
"""

import numpy as np

from liir_common import rng, seeds
from liir_common.battle.motion import separate, separate_many, squared_distance, walk
from liir_common.battle.nearby import NOBODY, only
from liir_common.battle.tables import (
    ATTACK,
    ATTACK_MOVE,
    FIRST_ATTACK,
    IDLE,
    MOVE,
    SET_SIZE,
    apart,
    inlined,
    kernel,
)
from liir_common.battle.units import (
    BEAM_LENGTH,
    BEAM_WIDTH,
    ENERGY_MAX,
    ENERGY_REGENERATION,
    FIRING_DELAY,
    HEALING,
    HEALING_COST,
    HEALING_RESERVE,
    LOOPS_PER_SECOND,
    MINIMUM_DAMAGE,
    SHIELD_DELAY,
    SHIELD_REGENERATION,
)

SIMULATOR_VERSION = "2"
"""Changes whenever the same seed and actions would give other bytes."""

STEPS, TERMINATED, TRUNCATED, WON, DEAD_ALLIES, DEAD_ENEMIES, LOST = range(7)
"""Places in `Battle.status`."""

NO_OP, STOP, NORTH, SOUTH, EAST, WEST = range(FIRST_ATTACK)

CHASE_LIMIT = 21.0
HELP_RADIUS, HELP_PERIOD = 4.0, 2.0 * LOOPS_PER_SECOND
_SHIELD_PER_LOOP = SHIELD_REGENERATION / LOOPS_PER_SECOND
_SHIELD_DELAY = SHIELD_DELAY * LOOPS_PER_SECOND
_DELAY_LOW = FIRING_DELAY[0] * LOOPS_PER_SECOND
_DELAY_SPAN = FIRING_DELAY[1] * LOOPS_PER_SECOND - _DELAY_LOW
_HEALED_PER_LOOP = HEALING / LOOPS_PER_SECOND
_ENERGY_PER_LOOP = ENERGY_REGENERATION / LOOPS_PER_SECOND
_NEVER = -1e9
_HALF = np.uint64(1 << 63)


@kernel
def reset(tables, battle, seed):
    """Put every unit back to its place and start the random stream anew; enemies have their head start."""
    rules, n_allies = tables.rules[0], tables.rules[0].n_allies
    battle.stream[0] = rng.derive(seed, seeds.BATTLE)
    battle.clock[0] = 0.0
    battle.status[:] = 0
    battle.last_actions[:] = -1
    for i in range(len(battle.units)):
        battle.x[i], battle.y[i] = tables.specs[i].spawn_x, tables.specs[i].spawn_y
        battle.alive[i] = True
        _spawn(battle.units[i], tables.specs[i], i >= n_allies)
    if rules.goal_span_x != 0.0 or rules.goal_span_y != 0.0:
        share = rng.uniform(battle.stream)
        for i in range(n_allies, len(battle.units)):
            battle.units[i].goal_x += share * rules.goal_span_x
            battle.units[i].goal_y += share * rules.goal_span_y
    if rules.hunts:
        for i in range(n_allies, len(battle.units)):
            battle.units[i].order, battle.units[i].target = ATTACK, _prey(rules, battle, i)
    # A constant would have all of it compiled once more.
    upwards = np.bool_(True)
    for _ in range(rules.head_start):
        _play_loop(tables, battle, upwards)


@inlined
def _prey(rules, battle, i):
    """The agent that enemy i is sent to attack."""
    if not rules.hunt_nearest:
        return np.int64(rng.uniform(battle.stream) * rules.n_allies)
    prey = 0
    for j in range(rules.n_allies):
        if squared_distance(battle, i, j) < squared_distance(battle, i, prey):
            prey = j
    return prey


@inlined
def _spawn(unit, spec, is_enemy):
    unit.health, unit.shield, unit.energy = spec.health, spec.shield, spec.energy
    unit.ready_at = unit.hit_at = unit.free_at = 0.0
    unit.hurt_at = unit.help_at = unit.walked_at = _NEVER
    unit.pace = unit.heading_x = unit.heading_y = 0.0
    unit.goal_x, unit.goal_y = spec.goal_x, spec.goal_y
    unit.missile_x = unit.missile_y = 0.0
    unit.order = ATTACK_MOVE if is_enemy else IDLE
    unit.target = unit.aim = unit.attacker = unit.missile_target = -1
    unit.hits = 0


@kernel
def step(tables, battle, actions):
    """Play one step with one available action per agent and return the team's reward.

    The caller sees to it that the actions are available and that the episode has not ended.
    """
    rules, status = tables.rules[0], battle.status
    dead_allies, dead_enemies = status[DEAD_ALLIES], status[DEAD_ENEMIES]
    allies = _vitality(battle.units, 0, rules.n_allies)
    enemies = _vitality(battle.units, rules.n_allies, len(battle.units))
    upwards = rng.next_u64(battle.stream) < _HALF
    for loop in range(rules.step_mul):
        if loop == rules.order_latency:
            _give_orders(tables, battle, actions)
        _play_loop(tables, battle, upwards)
    for i in range(rules.n_allies):
        battle.last_actions[i] = actions[i]
    status[STEPS] += 1
    _judge(tables, battle)
    return _reward(
        rules,
        status,
        allies - _vitality(battle.units, 0, rules.n_allies),
        enemies - _vitality(battle.units, rules.n_allies, len(battle.units)),
        status[DEAD_ALLIES] - dead_allies,
        status[DEAD_ENEMIES] - dead_enemies,
    )


@inlined
def _vitality(units, first, last):
    total = 0.0
    for i in range(first, last):
        total += units[i].health + units[i].shield
    return total


@inlined
def _judge(tables, battle):
    """SMAC v1: a win needs a living ally, and only a game that has not ended can reach the limit."""
    rules, status = tables.rules[0], battle.status
    allies_gone = status[DEAD_ALLIES] == rules.n_allies
    enemies_gone = status[DEAD_ENEMIES] == rules.n_enemies
    lost, won = allies_gone and not enemies_gone, enemies_gone and not allies_gone
    if rules.has_healers:
        # Nobody but healers is a defeat, asked first; a single healer left of the enemies is a victory.
        lost |= _count_fighters(tables, battle, 0, rules.n_allies) == 0
        healer_left = _count_fighters(tables, battle, rules.n_allies, len(battle.units)) == 0
        won |= healer_left and status[DEAD_ENEMIES] == rules.n_enemies - 1
        won = won and not lost
    status[LOST], status[WON] = lost, won
    status[TERMINATED] = lost or won or (allies_gone and enemies_gone)
    status[TRUNCATED] = not status[TERMINATED] and status[STEPS] >= rules.limit


@inlined
def _count_fighters(tables, battle, first, last):
    count = 0
    for i in range(first, last):
        count += battle.alive[i] and not tables.specs[i].heals
    return count


@inlined
def _reward(rules, status, lost_by_allies, lost_by_enemies, dead_allies, dead_enemies):
    """SMAC v1's reward of one step; shields that come back count against damage."""
    won, lost = status[WON], status[LOST]
    if rules.reward_sparse:
        return (won - lost) / rules.reward_divisor
    reward = lost_by_enemies + rules.reward_death_value * dead_enemies
    if rules.reward_only_positive:
        reward = abs(reward)
    else:
        reward -= rules.reward_negative_scale * (lost_by_allies + rules.reward_death_value * dead_allies)
    reward += rules.reward_win * won + rules.reward_defeat * lost
    return reward / rules.reward_divisor


@inlined
def _give_orders(tables, battle, actions):
    for i in range(tables.rules[0].n_allies):
        if battle.alive[i]:
            if actions[i] >= FIRST_ATTACK:
                _order_attack(tables, battle, i, actions[i] - FIRST_ATTACK)
            else:
                _order_move(tables, battle, i, actions[i])


@inlined
def _order_attack(tables, battle, i, number):
    """Attack that enemy; for a healer, treat that ally. What a weapon cannot hit, the game orders in vain."""
    rules, unit, spec = tables.rules[0], battle.units[i], tables.specs[i]
    target = rules.n_allies + number
    if rules.has_healers:
        if spec.heals:
            target = number
        elif tables.pairs[spec.kind, tables.specs[target].kind].damage == 0.0:
            return
    if unit.order == ATTACK and unit.target == target and not rules.repeated_order_restarts:
        return
    _interrupt(rules, unit, spec)
    unit.order, unit.target = ATTACK, target


@inlined
def _order_move(tables, battle, i, action):
    unit = battle.units[i]
    _interrupt(tables.rules[0], unit, tables.specs[i])
    unit.target = -1
    unit.order = IDLE if action == STOP else MOVE
    if unit.order == MOVE:
        unit.free_at = battle.clock[0]
        length = tables.rules[0].move_amount
        unit.goal_x = battle.x[i] + length * ((action == EAST) - (action == WEST))
        unit.goal_y = battle.y[i] + length * ((action == NORTH) - (action == SOUTH))


@inlined
def _interrupt(rules, unit, spec):
    """A new order always stops an attack before its first hit, and by the rules also between hits."""
    if unit.hits == spec.hits or rules.new_order_cancels_hits:
        unit.hits = 0


@inlined
def _play_loop(tables, battle, upwards):
    """Let every living unit act once, upwards or downwards.

    Each step tosses a coin for it: of two units each is first with probability 1/2, as in the game's random
    order, and the processor can guess what comes next.
    """
    now, n = battle.clock[0], len(battle.units)
    walkers = NOBODY
    for k in range(n):
        # Unsigned, so that no index needs a test for being negative.
        i = np.uint64(k if upwards else n - 1 - k)
        if battle.alive[i]:
            walkers |= np.uint64(_act(tables, battle, i, now, upwards)) * only(i)
    if tables.rules[0].has_missiles:
        _fly_missiles(tables, battle, now)
    if tables.rules[0].has_areas:
        _blast_all(tables, battle, now)
    if n <= SET_SIZE:
        separate(tables, battle, walkers)
    else:
        separate_many(tables, battle, now)
    battle.clock[0] = now + 1.0


@inlined
def _act(tables, battle, i, now, upwards):
    """What one unit does in one loop; whether it walks."""
    unit, spec = battle.units[i], tables.specs[i]
    # No branch, which the processor would often guess wrongly.
    shield = unit.shield + _SHIELD_PER_LOOP * (now >= unit.hurt_at + _SHIELD_DELAY)
    unit.shield = shield if shield < spec.shield else spec.shield
    if spec.regeneration > 0.0:
        unit.health = min(spec.health, unit.health + spec.regeneration)
    if unit.hits > 0:
        if now >= unit.hit_at:
            _release(tables, battle, i, now)
        return False
    # Most of the time in a fight: neither walking nor firing is possible yet.
    if now < unit.free_at and now < unit.ready_at:
        return False
    if tables.rules[0].has_healers and spec.heals:
        return _treat(tables, battle, i, now)
    if unit.order == ATTACK_MOVE:
        _acquire(tables, battle, i, now, upwards)
    if unit.target >= 0:
        return _attack(tables, battle, i, now)
    if unit.order == IDLE:
        return False
    return walk(tables, battle, i, unit.goal_x - battle.x[i], unit.goal_y - battle.y[i], now)


@inlined
def _acquire(tables, battle, i, now, upwards):
    """Keep the target while it may be kept, else take the nearest within the scan range.

    Equal distances are decided by where the look begins, and so by the step's coin toss.
    """
    unit, kind, rules = battle.units[i], tables.specs[i].kind, tables.rules[0]
    if unit.target >= 0:
        target = np.uint64(unit.target)
        if battle.alive[target]:
            distance2 = squared_distance(battle, i, target)
            if distance2 <= tables.pairs[kind, tables.specs[target].kind].hold2:
                return
            if rules.chase_attacker and unit.target == unit.attacker and distance2 <= CHASE_LIMIT**2:
                return
        unit.target = -1
    if np.int64(now + i) % rules.rescan_period:
        return
    if not _count_near(battle, i, rules.n_allies, rules.widest_scan2):
        return
    nearest2 = np.inf
    for k in range(rules.n_allies):
        j = np.uint64(k if upwards else rules.n_allies - 1 - k)
        if battle.alive[j]:
            distance2 = squared_distance(battle, i, j)
            if distance2 < nearest2 and distance2 <= tables.pairs[kind, tables.specs[j].kind].scan2:
                nearest2 = distance2
                unit.target = j


@inlined
def _count_near(battle, i, last, radius2):
    """How many of the first `last` units are that near to i, dead or alive: a quick test in front of
    loops that would seldom find anybody."""
    count = 0
    for j in range(last):
        x, y = battle.x[j] - battle.x[i], battle.y[j] - battle.y[i]
        count += x * x + y * y <= radius2
    return count


@inlined
def _attack(tables, battle, i, now):
    """Attack the target if it is in reach and the weapon is ready, wait if it is not, else walk up.

    Whether it walks.
    """
    unit, spec = battle.units[i], tables.specs[i]
    target = np.uint64(unit.target)
    if not battle.alive[target]:
        _rest(tables.rules[0], battle, i)
        return False
    x, y = battle.x[target] - battle.x[i], battle.y[target] - battle.y[i]
    if x * x + y * y > tables.pairs[spec.kind, tables.specs[target].kind].reach2:
        return walk(tables, battle, i, x, y, now)
    if now >= unit.ready_at:
        if tables.rules[0].has_areas:
            if spec.blast > 0.0:
                _die(tables, battle, i)
                return False
            unit.missile_x, unit.missile_y = battle.x[target], battle.y[target]
        if not tables.rules[0].cooldown_from_release:
            _cool_down(tables.rules[0], battle, i, spec.period, now)
        unit.hit_at = now + spec.damage_point
        unit.hits = spec.hits
        unit.aim = unit.target
        if now >= unit.hit_at:
            _release(tables, battle, i, now)
    return False


@inlined
def _cool_down(rules, battle, i, period, since):
    """The weapon may fire again a period and a random delay after `since`."""
    delay = rng.uniform(battle.stream)
    if rules.integer_delay:
        delay = np.floor(delay * (_DELAY_SPAN + 1.0)) / _DELAY_SPAN
    battle.units[i].ready_at = since + period + _DELAY_LOW + _DELAY_SPAN * delay


@inlined
def _rest(rules, battle, i):
    """The target is gone: an agent's unit does nothing more, an enemy stays and looks for others."""
    unit = battle.units[i]
    unit.order, unit.target = IDLE, -1
    if i >= rules.n_allies:
        unit.order, unit.goal_x, unit.goal_y = ATTACK_MOVE, battle.x[i], battle.y[i]


@inlined
def _release(tables, battle, i, now):
    """The next hit of the attack under way; a dead target ends the attack."""
    unit, spec = battle.units[i], tables.specs[i]
    if not battle.alive[unit.aim] and not (spec.beams and unit.hits == spec.hits):
        unit.hits = 0
        return
    if tables.rules[0].cooldown_from_release and unit.hits == spec.hits:
        _cool_down(tables.rules[0], battle, i, spec.period, unit.hit_at)
    unit.hits -= 1
    unit.hit_at += spec.hit_interval
    if tables.rules[0].stand_after_hit:
        unit.free_at = now + spec.backswing
    if spec.beams:
        _beam(tables, battle, i, now)
    elif spec.missile_speed > 0.0:
        unit.missile_x, unit.missile_y, unit.missile_target = battle.x[i], battle.y[i], unit.aim
    else:
        _hit(tables, battle, i, unit.aim, now)


@inlined
def _hit(tables, battle, attacker, victim, now):
    """Damage goes to the shield first; what is left of it loses the armor and goes to life."""
    target, spec = battle.units[victim], tables.specs[victim]
    damage = tables.pairs[tables.specs[attacker].kind, spec.kind].damage
    absorbed = min(damage, target.shield)
    target.shield -= absorbed
    if damage > absorbed:
        target.health -= max(MINIMUM_DAMAGE, damage - absorbed - spec.armor)
    target.hurt_at = now
    target.attacker = attacker
    if target.health <= 0.0:
        _die(tables, battle, victim)
    elif target.order == ATTACK_MOVE and target.target < 0:
        _respond(tables, battle, victim, now)


_strike = apart(_hit.py_func)


@inlined
def _die(tables, battle, i):
    unit, rules = battle.units[i], tables.rules[0]
    unit.health = unit.shield = 0.0
    battle.alive[i] = False
    unit.hits = tables.specs[i].blast > 0.0
    battle.status[DEAD_ALLIES if i < rules.n_allies else DEAD_ENEMIES] += 1


@apart
def _respond(tables, battle, victim, now):
    """An enemy without a target takes the one that hit it, and calls others that have none."""
    caller, rules = battle.units[victim], tables.rules[0]
    attacker = caller.attacker
    if not rules.chase_attacker:
        return
    if _can_hit(tables, victim, attacker):
        caller.target = attacker
    if not rules.call_for_help or now < caller.help_at + HELP_PERIOD:
        return
    caller.help_at = now
    for i in range(rules.n_allies, len(battle.units)):
        friend = battle.units[i]
        waits = battle.alive[i] and friend.order == ATTACK_MOVE and friend.target < 0
        if waits and squared_distance(battle, victim, i) <= HELP_RADIUS**2 and _can_hit(tables, i, attacker):
            friend.target = friend.attacker = attacker


@inlined
def _can_hit(tables, attacker, target):
    return tables.pairs[tables.specs[attacker].kind, tables.specs[target].kind].damage > 0.0


@inlined
def _first_enemy(rules, i):
    """Where the team begins that i fights; the other ends there or is the last."""
    return rules.n_allies if i < rules.n_allies else 0


@inlined
def _last_enemy(rules, i):
    return rules.n_allies + rules.n_enemies if i < rules.n_allies else rules.n_allies


@apart
def _beam(tables, battle, i, now):
    """At the first hit the beams have swept what stands beside the target, at the second they end on it."""
    unit, spec, rules = battle.units[i], tables.specs[i], tables.rules[0]
    if unit.hits == 0:
        for _ in range(spec.beams):
            if battle.alive[unit.aim]:
                _strike(tables, battle, i, unit.aim, now)
        return
    x, y = unit.missile_x - battle.x[i], unit.missile_y - battle.y[i]
    distance = np.sqrt(x * x + y * y)
    if distance > 0.0:
        x, y = x / distance, y / distance
    for j in range(_first_enemy(rules, i), _last_enemy(rules, i)):
        dx, dy = battle.x[j] - unit.missile_x, battle.y[j] - unit.missile_y
        # Along the sweep, beyond its ends, and away from it.
        beyond = max(0.0, abs(dy * x - dx * y) - 0.5 * BEAM_LENGTH)
        away = dx * x + dy * y
        within = 0.5 * BEAM_WIDTH + tables.specs[j].radius
        if j != unit.aim and beyond * beyond + away * away <= within * within and _can_hit(tables, i, j):
            for _ in range(spec.beams):
                if battle.alive[j]:
                    _strike(tables, battle, i, j, now)


@apart
def _blast_all(tables, battle, now):
    """Blasts of the units that died in this loop, and of those that the blasts kill."""
    rules, more = tables.rules[0], True
    while more:
        more = False
        for i in range(len(battle.units)):
            unit, spec = battle.units[i], tables.specs[i]
            if battle.alive[i] or unit.hits == 0 or spec.blast == 0.0:
                continue
            unit.hits = 0
            for j in range(_first_enemy(rules, i), _last_enemy(rules, i)):
                within = spec.blast + tables.specs[j].radius
                if battle.alive[j] and squared_distance(battle, i, j) <= within * within:
                    _strike(tables, battle, i, j, now)
                    more |= not battle.alive[j]


@apart
def _treat(tables, battle, i, now):
    """What a healer does in one loop; whether it moves."""
    unit = battle.units[i]
    unit.energy = min(ENERGY_MAX, unit.energy + _ENERGY_PER_LOOP)
    if unit.order == ATTACK_MOVE or (unit.order == IDLE and tables.rules[0].medivac_autocast):
        unit.target = _patient(tables, battle, i)
    x, y = unit.goal_x - battle.x[i], unit.goal_y - battle.y[i]
    if unit.target >= 0:
        patient, spec = battle.units[unit.target], tables.specs[unit.target]
        x, y = battle.x[unit.target] - battle.x[i], battle.y[unit.target] - battle.y[i]
        if not battle.alive[unit.target]:
            unit.order, unit.target = IDLE, -1
            return False
        if x * x + y * y <= tables.pairs[tables.specs[i].kind, spec.kind].reach2:
            healed = min(_HEALED_PER_LOOP, spec.health - patient.health, unit.energy / HEALING_COST)
            patient.health += healed
            unit.energy -= healed * HEALING_COST
            return False
    elif unit.order == IDLE:
        return False
    return walk(tables, battle, i, x, y, now)


@inlined
def _patient(tables, battle, i):
    """Whom a healer treats of its own accord: of the hurt nearby the one with the least share of life, and of
    equals the nearest; a treatment under way goes on while there is energy. -1 for nobody."""
    unit, rules = battle.units[i], tables.rules[0]
    if unit.target >= 0 and unit.energy > 0.0 and _may_treat(tables, battle, i, unit.target):
        return unit.target
    if unit.energy < HEALING_RESERVE:
        return -1
    first = 0 if i < rules.n_allies else rules.n_allies
    last = rules.n_allies if i < rules.n_allies else len(battle.units)
    patient, least, nearest2 = -1, 1.0, np.inf
    for j in range(first, last):
        if _may_treat(tables, battle, i, j):
            share, distance2 = battle.units[j].health / tables.specs[j].health, squared_distance(battle, i, j)
            if share < least or (share == least and distance2 < nearest2):
                patient, least, nearest2 = j, share, distance2
    return patient


@inlined
def _may_treat(tables, battle, i, j):
    """Whether j is alive, biological, hurt and within the search range of healer i."""
    spec = tables.specs[j]
    near = squared_distance(battle, i, j) <= tables.pairs[tables.specs[i].kind, spec.kind].scan2
    return near and battle.alive[j] and spec.biological and battle.units[j].health < spec.health


@inlined
def _fly_missiles(tables, battle, now):
    """Missiles home in on their targets; they outlive the unit that launched them."""
    for k in range(len(battle.units)):
        i = np.uint64(k)
        unit = battle.units[i]
        if unit.missile_target >= 0:
            j = unit.missile_target
            if not battle.alive[j]:
                unit.missile_target = _redirect(tables, battle, i)
                continue
            x, y = battle.x[j] - unit.missile_x, battle.y[j] - unit.missile_y
            distance, reach = np.sqrt(x * x + y * y), tables.specs[i].missile_speed
            if distance <= reach:
                _hit(tables, battle, i, j, now)
                unit.missile_target = -1
            else:
                unit.missile_x += x / distance * reach
                unit.missile_y += y / distance * reach


@inlined
def _redirect(tables, battle, i):
    """Next target of a missile whose target died: -1, or by the rules the nearest unit of that team."""
    rules = tables.rules[0]
    if not rules.redirect_missiles:
        return -1
    unit, nearest, nearest2 = battle.units[i], -1, np.inf
    hits_allies = unit.missile_target < rules.n_allies
    for j in range(
        0 if hits_allies else rules.n_allies, rules.n_allies if hits_allies else len(battle.units)
    ):
        distance2 = (battle.x[j] - unit.missile_x) ** 2 + (battle.y[j] - unit.missile_y) ** 2
        if battle.alive[j] and distance2 < nearest2:
            nearest, nearest2 = j, distance2
    return nearest
