"""A recording as one HTML file that needs nothing else."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

import numpy as np

from liir_common.battle.env import BattleEnv
from liir_common.battle.render import LETTERS
from liir_common.battle.snapshots import UnitRecord
from liir_common.replay.record import HEALERS, Recording, target_number
from liir_common.types import Exploration

_ACTIONS = ("no-op", "stop", "north", "south", "east", "west")
"""Those below the attacks"""
_PLACE = "/*RECORDING*/null"


def write_page(recording: Recording) -> str:
    """The page's text; the recording is inside it as JSON."""
    template = resources.files("liir_common.replay").joinpath("page.html").read_text(encoding="utf-8")
    data = json.dumps(page_data(recording), separators=(",", ":"), allow_nan=False)
    # Inside <script> only "</script" and "<!--" mean anything to the HTML parser.
    return template.replace(_PLACE, data.replace("<", "\\u003c"))


def page_data(recording: Recording) -> dict[str, Any]:
    """What the page shows, in plain values; numbers are rounded to what can be seen."""
    trajectory, manifest = recording.trajectory, recording.manifest
    n = trajectory.alive.shape[1]
    return {
        "map": recording.map_name,
        "seed": str(recording.seed),
        "sampled": recording.exploration is not Exploration.GREEDY,
        "run": manifest.run_id,
        "method": manifest.config["algorithm"]["name"],
        "episode": manifest.episode,
        "envSteps": manifest.env_steps,
        "outcome": _outcome(recording),
        "stepsPerSecond": BattleEnv.metadata["render_fps"],
        # West to east, each column south to north.
        "terrain": ["".join(".#"[cell] for cell in column) for column in recording.pathing.astype(int)],
        "units": [_unit(unit) for unit in recording.frames[0]],
        "frames": [[_situation(unit, n) for unit in frame] for frame in recording.frames],
        "shots": recording.shots,
        "blasts": [[_rounded(blast, 2) for blast in blasts] for blasts in recording.blasts],
        "actionNames": _ACTIONS,
        "actions": trajectory.actions.tolist(),
        "choices": [[_choices(recording, t, i) for i in range(n)] for t in range(trajectory.length)],
        "hasQ": recording.q_values is not None,
        "hasIntrinsic": recording.intrinsic is not None,
        "rewards": _rounded(trajectory.reward, 3),
    }


def _outcome(recording: Recording) -> str:
    if recording.trajectory.info["won"]:
        return "won"
    return "lost" if recording.trajectory.terminated else "limit"


def _unit(unit: UnitRecord) -> dict[str, Any]:
    """What stays the same about a unit."""
    letter = LETTERS[unit["unit_type"]]
    return {
        "team": unit["team"],
        "name": f"{letter if unit['team'] == 'ally' else letter.upper()}{unit['id']}",
        "type": unit["unit_type"].replace("_", " "),
        "radius": unit["radius"],
        "health": unit["health_max"],
        "shield": unit["shield_max"],
        "verb": "heal ally" if unit["unit_type"] in HEALERS else "attack enemy",
    }


def _situation(unit: UnitRecord, n_allies: int) -> list[Any]:
    """x, y, health, shield, energy, cooldown in loops, order, place of the target in the frame or null."""
    numbers = [round(unit[key], 2) for key in ("x", "y", "health", "shield", "energy", "cooldown")]
    heals = unit["unit_type"] in HEALERS and unit["target"] is not None
    return [*numbers, "heal" if heals else unit["order"], target_number(unit, n_allies)]


def _choices(recording: Recording, step: int, agent: int) -> list[list[float]]:
    """[action, probability or Q value, r_in if learned] of each available action of a living agent."""
    if not recording.trajectory.alive[step, agent]:
        return []
    columns = (recording.probabilities, recording.q_values, recording.intrinsic)
    return [
        [int(action), *(_rounded(column[step, agent, action], 4) for column in columns if column is not None)]
        for action in np.flatnonzero(recording.trajectory.mask[step, agent])
    ]


def _rounded(values: Any, digits: int) -> Any:
    return np.round(np.asarray(values, np.float64), digits).tolist()
