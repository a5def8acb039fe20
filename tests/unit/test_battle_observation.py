"""Observations, state and masks against a slow reference written from the layout of SMAC v1."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from liir_common.battle.env import BattleEnv, battle_spec, parallel_env
from liir_common.battle.scenarios import SCENARIOS, describe
from liir_common.battle.snapshots import UnitRecord
from liir_common.battle.terrain import TERRAINS

SIGHT, SHOOT_RANGE = 9.0, 6.0
COOLDOWN_MAX = {
    "marine": 15,
    "marauder": 25,
    "stalker": 35,
    "zealot": 22,
    "colossus": 24,
    "hydralisk": 10,
    "zergling": 11,
    "baneling": 1,
}
ENERGY_MAX = 200
STALKERS_AND_ZEALOTS = {"ally": ["stalker", "zealot"], "enemy": ["zealot", "stalker"]}
COLOSSI = {key: ["colossus", "stalker", "zealot"] for key in ("ally", "enemy")}
MMM = {key: ["marauder", "marine", "medivac"] for key in ("ally", "enemy")}
BANE = {key: ["baneling", "zergling"] for key in ("ally", "enemy")}
BITS = {
    "2s3z": STALKERS_AND_ZEALOTS,
    "3s5z": STALKERS_AND_ZEALOTS,
    "3s5z_vs_3s6z": STALKERS_AND_ZEALOTS,
    "1c3s5z": COLOSSI,
    "MMM": MMM,
    "MMM2": MMM,
    "bane_vs_bane": BANE,
}
HEIGHTS = {0.0: 175, 1.0: 191, 1.25: 195, 1.5: 199, 1.75: 203, 2.0: 207}
"""Bytes of the game's API by cliff level."""
DEFAULTS: dict[str, Any] = {
    "obs_all_health": True,
    "obs_own_health": True,
    "obs_last_action": False,
    "obs_pathing_grid": False,
    "obs_terrain_height": False,
    "move_amount": 2.0,
    "obs_timestep_number": False,
    "obs_instead_of_state": False,
    "state_last_action": True,
    "state_timestep_number": False,
}
OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"state_last_action": False, "state_timestep_number": True},
    {"obs_last_action": True, "obs_timestep_number": True, "obs_pathing_grid": True},
    {"obs_terrain_height": True, "obs_pathing_grid": True, "move_amount": 5.0},
    {"obs_terrain_height": True, "obs_pathing_grid": True, "move_amount": 1.25},
    {"obs_all_health": False},
    {"obs_all_health": False, "obs_own_health": False, "obs_instead_of_state": True},
)


class Reference:
    """The layout, value by value."""

    def __init__(self, map_name: str, options: dict[str, Any]) -> None:
        self.scenario = SCENARIOS[map_name]
        self.options = DEFAULTS | options
        self.options["obs_own_health"] |= self.options["obs_all_health"]
        self.pathing = TERRAINS[self.scenario.terrain].pathing
        self.level = TERRAINS[self.scenario.terrain].level
        self.bits = BITS.get(map_name)

    def is_open(self, x: int, y: int, outside: bool) -> bool:
        inside = 0 <= x < 32 and 0 <= y < 32
        return bool(self.pathing[x, y]) if inside else outside

    def height(self, x: int, y: int) -> float:
        return HEIGHTS[self.level[x, y]] / 255 if 0 <= x < 32 and 0 <= y < 32 else 1.0

    def mask(self, me: UnitRecord, units: list[UnitRecord]) -> list[bool]:
        enemies = [unit for unit in units if unit["team"] == "enemy"]
        if not me["alive"]:
            return [True] + [False] * (5 + len(enemies))
        x, y, ahead = me["x"], me["y"], self.options["move_amount"] / 2
        moves = [
            self.is_open(int(x), int(y + ahead), False),
            self.is_open(int(x), int(y - ahead), False),
            self.is_open(int(x + ahead), int(y), False),
            self.is_open(int(x - ahead), int(y), False),
        ]
        attacks = [self.in_range(me, enemy) for enemy in enemies]
        if me["unit_type"] == "medivac":
            allies = [unit for unit in units if unit["team"] == "ally"]
            attacks = [u["unit_type"] != "medivac" and self.in_range(me, u) for u in allies]
            attacks += [False] * (len(enemies) - len(allies))
        return [False, True, *moves, *attacks]

    def in_range(self, me: UnitRecord, other: UnitRecord) -> bool:
        gap = np.hypot(other["x"] - me["x"], other["y"] - me["y"])
        return bool(other["alive"] and gap <= SHOOT_RANGE)

    def health(self, unit: UnitRecord, shields: bool) -> list[float]:
        values = [unit["health"] / unit["health_max"]]
        return [*values, unit["shield"] / unit["shield_max"]] if shields else values

    def type_bits(self, unit: UnitRecord) -> list[float]:
        names = self.bits[unit["team"]] if self.bits else []
        return [float(name == unit["unit_type"]) for name in names]

    def seen(self, me: UnitRecord, other: UnitRecord, first: float, tail: list[float]) -> list[float]:
        dx, dy = other["x"] - me["x"], other["y"] - me["y"]
        distance = np.hypot(dx, dy)
        shields = other["shield_max"] > 0
        health = self.health(other, shields) if self.options["obs_all_health"] else []
        values = [first, distance / SIGHT, dx / SIGHT, dy / SIGHT, *health, *self.type_bits(other), *tail]
        visible = me["alive"] and other["alive"] and distance < SIGHT
        return values if visible else [0.0] * len(values)

    def observation(
        self, units: list[UnitRecord], i: int, last_actions: np.ndarray[Any, Any], share: float
    ) -> list[float]:
        allies = [u for u in units if u["team"] == "ally"]
        enemies = [u for u in units if u["team"] == "enemy"]
        me = allies[i]
        mask = self.mask(me, units)
        values = [float(v) for v in mask[2:6]]
        x, y = int(me["x"]), int(me["y"])
        far, near = 2 * self.options["move_amount"], self.options["move_amount"]
        steps = [(0, far), (0, -far), (far, 0), (-far, 0)]
        steps += [(near, near), (-near, -near), (near, -near), (-near, near)]
        around = [(int(x + dx), int(y + dy)) for dx, dy in steps]
        if self.options["obs_pathing_grid"]:
            values += [float(self.is_open(*place, True)) for place in around]
        if self.options["obs_terrain_height"]:
            values += [self.height(*place) for place in [*around, (x, y)]]
        for j, enemy in enumerate(enemies):
            values += self.seen(me, enemy, float(mask[6 + j]), [])
        for j, ally in enumerate(allies):
            if j != i:
                tail = list(last_actions[j]) if self.options["obs_last_action"] else []
                values += self.seen(me, ally, 1.0, tail)
        if self.options["obs_own_health"]:
            values += self.health(me, me["shield_max"] > 0)
        values += self.type_bits(me)
        if not me["alive"]:
            values = [0.0] * len(values)
        return [*values, 0.0, share] if self.options["obs_timestep_number"] else values

    def state(self, units: list[UnitRecord], last_actions: np.ndarray[Any, Any], share: float) -> list[float]:
        values: list[float] = []
        for unit in units:
            row = [unit["health"] / unit["health_max"]]
            if unit["team"] == "ally":
                if unit["unit_type"] == "medivac":
                    row.append(unit["energy"] / ENERGY_MAX)
                else:
                    row.append(unit["cooldown"] / COOLDOWN_MAX[unit["unit_type"]])
            row += [(unit["x"] - 16) / 32, (unit["y"] - 16) / 32]
            if unit["shield_max"]:
                row.append(unit["shield"] / unit["shield_max"])
            row += self.type_bits(unit)
            values += row if unit["alive"] else [0.0] * len(row)
        if self.options["state_last_action"]:
            values += list(last_actions.ravel())
        return [*values, share] if self.options["state_timestep_number"] else values


def scatter(env: BattleEnv, rng: np.random.Generator) -> None:
    """Put all units somewhere, near enough to each other that many are in sight."""
    records = env.snapshot()
    for record, spec in zip(records, env._tables.specs, strict=True):
        cells = env._tables.layers[spec["layer"]]
        while not cells[int(record["x"]), int(record["y"])] or rng.random() < 0.5:
            record["x"], record["y"] = rng.uniform(2, 22), rng.uniform(4, 26)
        alive = bool(rng.random() < 0.8)
        record["alive"] = alive
        record["health"] = float(rng.integers(1, int(record["health_max"]))) if alive else 0.0
        record["shield"] = float(rng.uniform(0, record["shield_max"])) if alive else 0.0
        if record["unit_type"] == "medivac":
            record["energy"] = float(rng.uniform(0, ENERGY_MAX))
        record["cooldown"] = float(rng.choice([0.0, rng.uniform(0, 40)]))
    for team in (records[0], records[-1]):
        team["alive"], team["health"] = True, 7.0
    env.restore(records)


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(options) or "default")
@pytest.mark.parametrize("map_name", SCENARIOS)
def test_layout(map_name: str, options: dict[str, Any]) -> None:
    env, reference = parallel_env(map_name, **options), Reference(map_name, options)
    spec, rng = battle_spec(map_name, **options), np.random.default_rng(3)
    for episode in range(8 if spec.n_agents < 12 else 2):
        observations, _ = env.reset(seed=episode)
        last_actions = np.zeros((spec.n_agents, spec.n_actions))
        steps = 0
        for _ in range(rng.integers(0, 3)):
            actions = {agent: env.action_space(agent).sample() for agent in env.agents}
            last_actions = np.eye(spec.n_actions)[list(actions.values())]
            env.step(actions)
            steps += 1
        scatter(env, rng)
        observations, units = env._observations(), env.snapshot()
        share = steps / spec.episode_limit
        rows = [reference.observation(units, i, last_actions, share) for i in range(spec.n_agents)]
        for i, agent in enumerate(env.agents):
            assert observations[agent]["observation"].shape == (spec.obs_dim,)
            np.testing.assert_allclose(observations[agent]["observation"], rows[i], atol=1e-6)
            assert observations[agent]["action_mask"].tolist() == reference.mask(units[i], units)
        state = np.concatenate(rows) if options.get("obs_instead_of_state") else None
        wanted = reference.state(units, last_actions, share) if state is None else state
        assert env.state().shape == (spec.state_dim,)
        np.testing.assert_allclose(env.state(), wanted, atol=1e-6)


def test_an_attack_wants_6_at_most_and_sight_less_than_9() -> None:
    """From centre to centre, to the last bit."""
    env = parallel_env("3m")
    for x, available, visible in [
        (16.0, True, True),
        (np.nextafter(16.0, 17.0), False, True),
        (np.nextafter(19.0, 18.0), False, True),
        (19.0, False, False),
    ]:
        env.reset(seed=0)
        records = env.snapshot()
        records[0] |= {"x": 10.0, "y": 15.0}
        records[3] |= {"x": float(x), "y": 15.0}
        env.restore(records)
        seen = env._observations()["ally_0"]
        assert seen["action_mask"][6] == available
        assert seen["observation"][4:9].any() == visible


@pytest.mark.parametrize(
    ("map_name", "n_actions", "obs", "state", "state_without"),
    [
        ("3m", 9, 30, 48, 21),
        ("8m", 14, 80, 168, 56),
        ("25m", 31, 250, 950, 175),
        ("5m_vs_6m", 12, 55, 98, 38),
        ("8m_vs_9m", 15, 85, 179, 59),
        ("10m_vs_11m", 17, 105, 243, 73),
        ("27m_vs_30m", 36, 285, 1170, 198),
        ("2s3z", 11, 80, 120, 65),
        ("3s5z", 14, 128, 216, 104),
        ("3s5z_vs_3s6z", 15, 136, 230, 110),
        ("3s_vs_3z", 9, 36, 54, 27),
        ("MMM", 16, 160, 290, 130),
        ("MMM2", 18, 176, 322, 142),
        ("1c3s5z", 15, 162, 270, 135),
        ("2m_vs_1z", 7, 16, 26, 12),
        ("corridor", 30, 156, 282, 102),
        ("so_many_baneling", 38, 202, 397, 131),
        ("bane_vs_bane", 30, 336, 984, 264),
        ("2c_vs_64zg", 70, 332, 342, 202),
        ("3s_vs_4z", 10, 42, 61, 31),
        ("3s_vs_5z", 11, 48, 68, 35),
        ("6h_vs_8z", 14, 78, 140, 56),
        ("2s_vs_1sc", 7, 17, 27, 13),
    ],
)
def test_sizes_are_those_of_smac(
    map_name: str, n_actions: int, obs: int, state: int, state_without: int
) -> None:
    spec = battle_spec(map_name)
    assert (spec.n_actions, spec.obs_dim, spec.state_dim) == (n_actions, obs, state)
    assert battle_spec(map_name, state_last_action=False).state_dim == state_without


# Limit, then who fights whom, as SMAC v1's registry and map scripts have them.
MAPS: dict[str, tuple[int, dict[str, int], dict[str, int]]] = {
    "3m": (60, {"marine": 3}, {"marine": 3}),
    "8m": (120, {"marine": 8}, {"marine": 8}),
    "25m": (150, {"marine": 25}, {"marine": 25}),
    "5m_vs_6m": (70, {"marine": 5}, {"marine": 6}),
    "8m_vs_9m": (120, {"marine": 8}, {"marine": 9}),
    "10m_vs_11m": (150, {"marine": 10}, {"marine": 11}),
    "27m_vs_30m": (180, {"marine": 27}, {"marine": 30}),
    "MMM": (150, {"marine": 7, "marauder": 2, "medivac": 1}, {"marine": 7, "marauder": 2, "medivac": 1}),
    "MMM2": (180, {"marine": 7, "marauder": 2, "medivac": 1}, {"marine": 8, "marauder": 3, "medivac": 1}),
    "2s3z": (120, {"stalker": 2, "zealot": 3}, {"stalker": 2, "zealot": 3}),
    "3s5z": (150, {"stalker": 3, "zealot": 5}, {"stalker": 3, "zealot": 5}),
    "3s5z_vs_3s6z": (170, {"stalker": 3, "zealot": 5}, {"stalker": 3, "zealot": 6}),
    "3s_vs_3z": (150, {"stalker": 3}, {"zealot": 3}),
    "3s_vs_4z": (200, {"stalker": 3}, {"zealot": 4}),
    "3s_vs_5z": (250, {"stalker": 3}, {"zealot": 5}),
    "1c3s5z": (180, {"colossus": 1, "stalker": 3, "zealot": 5}, {"colossus": 1, "stalker": 3, "zealot": 5}),
    "2m_vs_1z": (150, {"marine": 2}, {"zealot": 1}),
    "corridor": (400, {"zealot": 6}, {"zergling": 24}),
    "6h_vs_8z": (150, {"hydralisk": 6}, {"zealot": 8}),
    "2s_vs_1sc": (300, {"stalker": 2}, {"spine_crawler": 1}),
    "so_many_baneling": (100, {"zealot": 7}, {"baneling": 32}),
    "bane_vs_bane": (200, {"zergling": 20, "baneling": 4}, {"zergling": 20, "baneling": 4}),
    "2c_vs_64zg": (400, {"colossus": 2}, {"zergling": 64}),
}


def test_maps_are_those_of_smac() -> None:
    listed = {name: describe(scenario) for name, scenario in SCENARIOS.items()}
    assert {name: (row["limit"], row["agents"], row["enemies"]) for name, row in listed.items()} == MAPS


@pytest.mark.parametrize("map_name", SCENARIOS)
def test_allies_are_in_the_order_of_smac(map_name: str) -> None:
    env = parallel_env(map_name)
    env.reset(seed=0)
    allies = [(u["unit_type"], u["x"], u["y"]) for u in env.snapshot() if u["team"] == "ally"]
    assert allies == sorted(allies)
