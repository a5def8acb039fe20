"""The battle itself: compiled kernels that start a battle and play one environment step of eight loops.

The rules are those of StarCraft II as far as they are public; `parameters` names what is not. What SMAC v1
adds is who may do what, the reward and the end of the episode.
"""

import numpy as np

from liir_common import rng, seeds
from liir_common.battle.tables import FIRST_ATTACK, inlined, kernel
from liir_common.battle.units import (
    FIRING_DELAY,
    LOOPS_PER_SECOND,
    MINIMUM_DAMAGE,
    SHIELD_DELAY,
    SHIELD_REGENERATION,
)

SIMULATOR_VERSION = "1"
"""Changes whenever the same seed and actions would give other bytes."""

STEPS, TERMINATED, TRUNCATED, WON, DEAD_ALLIES, DEAD_ENEMIES = range(6)
"""Places in `Battle.status`."""

LOOPS_PER_STEP = 8
NO_OP, STOP, NORTH, SOUTH, EAST, WEST = range(FIRST_ATTACK)
IDLE, MOVE, ATTACK, ATTACK_MOVE = range(4)
"""Only a unit that attack-moves picks targets of its own: all enemies do, no ally does."""
ORDERS = ("idle", "move", "attack", "attack_move")

MOVE_AMOUNT = 2.0
CHASE_LIMIT = 21.0
HELP_RADIUS, HELP_PERIOD = 4.0, 2.0 * LOOPS_PER_SECOND
_SHIELD_PER_LOOP = SHIELD_REGENERATION / LOOPS_PER_SECOND
_SHIELD_DELAY = SHIELD_DELAY * LOOPS_PER_SECOND
_DELAY_LOW = FIRING_DELAY[0] * LOOPS_PER_SECOND
_DELAY_SPAN = FIRING_DELAY[1] * LOOPS_PER_SECOND - _DELAY_LOW
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
        _spawn(battle.units[i], tables.specs[i], i >= n_allies)
    for _ in range(rules.head_start):
        _play_loop(tables, battle, True)


@inlined
def _spawn(unit, spec, is_enemy):
    unit.health, unit.shield, unit.energy = spec.health, spec.shield, 0.0
    unit.ready_at = unit.hit_at = unit.free_at = 0.0
    unit.hurt_at = unit.help_at = unit.walked_at = _NEVER
    unit.heading_x = unit.heading_y = 0.0
    unit.goal_x, unit.goal_y = spec.goal_x, spec.goal_y
    unit.missile_x = unit.missile_y = 0.0
    unit.order = ATTACK_MOVE if is_enemy else IDLE
    unit.target = unit.aim = unit.attacker = unit.missile_target = -1
    unit.hits = 0
    unit.alive = True


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
    for loop in range(LOOPS_PER_STEP):
        if loop == rules.order_latency:
            _give_orders(tables, battle, actions)
        _play_loop(tables, battle, upwards)
    for i in range(rules.n_allies):
        battle.last_actions[i] = actions[i]
    status[STEPS] += 1
    _judge(rules, status)
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
def _judge(rules, status):
    """SMAC v1: a win needs a living ally, and only a game that has not ended can reach the limit."""
    allies_gone = status[DEAD_ALLIES] == rules.n_allies
    enemies_gone = status[DEAD_ENEMIES] == rules.n_enemies
    status[TERMINATED] = allies_gone or enemies_gone
    status[WON] = enemies_gone and not allies_gone
    status[TRUNCATED] = not status[TERMINATED] and status[STEPS] >= rules.limit


@inlined
def _reward(rules, status, lost_by_allies, lost_by_enemies, dead_allies, dead_enemies):
    """SMAC v1's reward of one step; shields that come back count against damage."""
    won = status[WON] == 1
    lost = status[DEAD_ENEMIES] < rules.n_enemies and status[DEAD_ALLIES] == rules.n_allies
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
    rules = tables.rules[0]
    for i in range(rules.n_allies):
        unit = battle.units[i]
        if unit.alive:
            if actions[i] >= FIRST_ATTACK:
                _order_attack(
                    rules, battle.clock[0], unit, tables.specs[i], rules.n_allies + actions[i] - FIRST_ATTACK
                )
            else:
                _order_move(tables, battle, i, actions[i])


@inlined
def _order_attack(rules, now, unit, spec, target):
    if unit.order == ATTACK and unit.target == target and not rules.repeated_order_restarts:
        return
    _interrupt(rules, now, unit, spec)
    unit.order, unit.target = ATTACK, target


@inlined
def _order_move(tables, battle, i, action):
    unit, now = battle.units[i], battle.clock[0]
    _interrupt(tables.rules[0], now, unit, tables.specs[i])
    unit.target = -1
    unit.order = IDLE if action == STOP else MOVE
    if unit.order == MOVE:
        unit.free_at = now
        unit.goal_x = battle.x[i] + MOVE_AMOUNT * ((action == EAST) - (action == WEST))
        unit.goal_y = battle.y[i] + MOVE_AMOUNT * ((action == NORTH) - (action == SOUTH))


@inlined
def _interrupt(rules, now, unit, spec):
    """A new order always stops an attack before its first hit, and by the rules also between hits."""
    if unit.hits == spec.hits and rules.cooldown_from_release:
        unit.ready_at = now
    if unit.hits == spec.hits or rules.new_order_cancels_hits:
        unit.hits = 0


@inlined
def _play_loop(tables, battle, upwards):
    """Let every living unit act once, upwards or downwards.

    Each step tosses a coin for it: of two units each is first with probability 1/2, as in the game's random
    order, and the processor can guess what comes next.
    """
    now, n = battle.clock[0], len(battle.units)
    walkers = 0
    for k in range(n):
        # Unsigned, so that no index needs a test for being negative.
        i = np.uint64(k if upwards else n - 1 - k)
        if battle.units[i].alive:
            walkers += _act(tables, battle, i, now, upwards)
    if tables.rules[0].has_missiles:
        _fly_missiles(tables, battle, now)
    if walkers:
        _separate(tables, battle, now)
    battle.clock[0] = now + 1.0


@inlined
def _act(tables, battle, i, now, upwards):
    """What one unit does in one loop; whether it walks."""
    unit, spec = battle.units[i], tables.specs[i]
    if unit.shield < spec.shield and now >= unit.hurt_at + _SHIELD_DELAY:
        unit.shield = min(spec.shield, unit.shield + _SHIELD_PER_LOOP)
    if spec.regeneration > 0.0:
        unit.health = min(spec.health, unit.health + spec.regeneration)
    if unit.hits > 0:
        if now >= unit.hit_at:
            _release(tables, battle, i, now)
        return False
    # Most of the time in a fight: neither walking nor firing is possible yet.
    if now < unit.free_at and now < unit.ready_at:
        return False
    if unit.order == ATTACK_MOVE:
        _acquire(tables, battle, i, now, upwards)
    if unit.target >= 0:
        return _attack(tables, battle, i, now)
    if unit.order == IDLE:
        return False
    return _walk(tables, battle, i, unit.goal_x - battle.x[i], unit.goal_y - battle.y[i], now)


@inlined
def _acquire(tables, battle, i, now, upwards):
    """Keep the target while it may be kept, else take the nearest within the scan range.

    Equal distances are decided by where the look begins, and so by the step's coin toss.
    """
    units, unit, kind, rules = battle.units, battle.units[i], tables.specs[i].kind, tables.rules[0]
    if unit.target >= 0:
        if units[unit.target].alive:
            distance2 = _distance2(battle, i, unit.target)
            if distance2 <= tables.pairs[kind, tables.specs[unit.target].kind].hold2:
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
        j = k if upwards else rules.n_allies - 1 - k
        if units[j].alive:
            distance2 = _distance2(battle, i, j)
            if distance2 < nearest2 and distance2 <= tables.pairs[kind, tables.specs[j].kind].scan2:
                nearest2 = distance2
                unit.target = j


@inlined
def _distance2(battle, i, j):
    x, y = battle.x[j] - battle.x[i], battle.y[j] - battle.y[i]
    return x * x + y * y


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
    if not battle.units[unit.target].alive:
        unit.order, unit.target = IDLE, -1
        return False
    x, y = battle.x[unit.target] - battle.x[i], battle.y[unit.target] - battle.y[i]
    if x * x + y * y > tables.pairs[spec.kind, tables.specs[unit.target].kind].reach2:
        return _walk(tables, battle, i, x, y, now)
    if now >= unit.ready_at:
        delay = rng.uniform(battle.stream)
        if tables.rules[0].integer_delay:
            delay = np.floor(delay * (_DELAY_SPAN + 1.0)) / _DELAY_SPAN
        unit.ready_at = now + spec.period + _DELAY_LOW + _DELAY_SPAN * delay
        unit.hit_at = now + spec.damage_point
        unit.hits = spec.hits
        unit.aim = unit.target
        if now >= unit.hit_at:
            _release(tables, battle, i, now)
    return False


@inlined
def _release(tables, battle, i, now):
    """The next hit of the attack under way; a dead target ends the attack."""
    unit, spec = battle.units[i], tables.specs[i]
    if not battle.units[unit.aim].alive:
        if unit.hits == spec.hits and tables.rules[0].cooldown_from_release:
            unit.ready_at = now
        unit.hits = 0
        return
    unit.hits -= 1
    unit.hit_at += spec.hit_interval
    if tables.rules[0].stand_after_hit:
        unit.free_at = now + spec.backswing
    if spec.missile_speed > 0.0:
        unit.missile_x, unit.missile_y, unit.missile_target = battle.x[i], battle.y[i], unit.aim
    else:
        _hit(tables, battle, i, unit.aim, now)


@inlined
def _hit(tables, battle, attacker, victim, now):
    """Damage goes to the shield first; what is left of it loses the armor and goes to life."""
    target, spec, rules = battle.units[victim], tables.specs[victim], tables.rules[0]
    damage = tables.pairs[tables.specs[attacker].kind, spec.kind].damage
    absorbed = min(damage, target.shield)
    target.shield -= absorbed
    if damage > absorbed:
        target.health -= max(MINIMUM_DAMAGE, damage - absorbed - spec.armor)
    target.hurt_at = now
    target.attacker = attacker
    if target.health <= 0.0:
        target.health = target.shield = 0.0
        target.alive = False
        battle.status[DEAD_ALLIES if victim < rules.n_allies else DEAD_ENEMIES] += 1
    elif target.order == ATTACK_MOVE and target.target < 0:
        _respond(rules, battle, victim, now)


@inlined
def _respond(rules, battle, victim, now):
    """An enemy without a target takes the one that hit it, and calls others that have none."""
    caller = battle.units[victim]
    if not rules.chase_attacker:
        return
    caller.target = caller.attacker
    if not rules.call_for_help or now < caller.help_at + HELP_PERIOD:
        return
    caller.help_at = now
    for i in range(rules.n_allies, len(battle.units)):
        friend = battle.units[i]
        waits = friend.alive and friend.order == ATTACK_MOVE and friend.target < 0
        if waits and _distance2(battle, victim, i) <= HELP_RADIUS**2:
            friend.target = friend.attacker = caller.attacker


@inlined
def _fly_missiles(tables, battle, now):
    """Missiles home in on their targets; they outlive the unit that launched them."""
    for i in range(len(battle.units)):
        unit = battle.units[i]
        if unit.missile_target >= 0:
            j = unit.missile_target
            if not battle.units[j].alive:
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
        if battle.units[j].alive and distance2 < nearest2:
            nearest, nearest2 = j, distance2
    return nearest


@inlined
def _walk(tables, battle, i, x, y, now):
    """One loop of walking along (x, y), the way to the goal; a goal nearer than that is reached.

    Whether it walks.
    """
    unit, distance2 = battle.units[i], x * x + y * y
    if now < unit.free_at or distance2 == 0.0:
        return False
    share = min(1.0, tables.specs[i].speed / np.sqrt(distance2))
    unit.heading_x, unit.heading_y = x * share, y * share
    unit.walked_at = now
    _displace(tables.pathing, battle, i, unit.heading_x, unit.heading_y)
    return True


@inlined
def _displace(pathing, battle, i, x, y):
    """Move a unit, axis by axis, as far as the ground allows; so units slide along walls."""
    if pathing[int(battle.x[i] + x), int(battle.y[i])]:
        battle.x[i] += x
    if pathing[int(battle.x[i]), int(battle.y[i] + y)]:
        battle.y[i] += y


@inlined
def _separate(tables, battle, now):
    """Push overlapping discs apart; only units that walked in this loop can have made an overlap."""
    for i in range(len(battle.units)):
        walked = battle.units[i].walked_at == now and battle.units[i].alive
        # Everybody is near to himself.
        if walked and _count_near(battle, i, len(battle.units), tables.rules[0].widest_contact2) > 1:
            _separate_one(tables, battle, i, now)


@inlined
def _separate_one(tables, battle, i, now):
    for j in range(len(battle.units)):
        distance2 = _distance2(battle, i, j)
        if distance2 < tables.rules[0].widest_contact2 and j != i and battle.units[j].alive:
            both_walked = battle.units[j].walked_at == now
            contact = tables.pairs[tables.specs[i].kind, tables.specs[j].kind].contact
            if distance2 < contact * contact and not (both_walked and j < i):
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
        _displace(tables.pathing, battle, j, -0.5 * overlap * x, -0.5 * overlap * y)
    else:
        _give_way(tables, battle, i, x, y, overlap)


@inlined
def _give_way(tables, battle, i, x, y, overlap):
    """Back off along (x, y), away from the blocker, and go around it on the side of the heading."""
    unit, slide = battle.units[i], 0.0
    if unit.heading_x * x + unit.heading_y * y < 0.0:
        leftward = unit.heading_y * x - unit.heading_x * y >= 0.0
        slide = tables.rules[0].slide if leftward else -tables.rules[0].slide
    _displace(tables.pathing, battle, i, overlap * (x - slide * y), overlap * (y + slide * x))
