"""Section 5.2.3: how alike are an agent's health and its intrinsic reward for "attack" when it is weak?

The paper states the cosine similarity of the two for health below 50 %, over 100 test episodes (0.55 on
2s3z, 0.67 on 3m), and leaves open over what the vectors run, whose rewards they hold and in what unit
health is. `_readings` has those that make a difference; the first is the one to quote.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from liir_common.battle.tables import FIRST_ATTACK
from liir_common.figures.run import Battle, Frozen, battles
from liir_common.figures.statistics import Values, cosine
from liir_common.files import write_atomic

EPISODES = 100
WEAK = 0.5
PAPER = {"3m": 0.67, "2s3z": 0.55}
"""What the paper states, by map."""


@dataclass(frozen=True)
class Life:
    """One agent's weak moments in one battle, of those in which it could attack."""

    health: Values
    """[k], share of the full health, without the shield"""
    taken: Values
    """[k], r_in of the attack made; NaN where it did something else"""
    possible: Values
    """[k], mean r_in of the attacks that were possible"""


def lives(battle: Battle) -> list[Life]:
    """The lives of all agents in a battle."""
    allies = [[u for u in units if u["team"] == "ally"] for units in battle.units[:-1]]
    health = np.array([[u["health"] / u["health_max"] for u in units] for units in allies])
    possible = battle.trajectory.mask[:-1, :, FIRST_ATTACK:]
    rewards = battle.r_in[..., FIRST_ATTACK:]
    actions = battle.trajectory.actions[..., None] - FIRST_ATTACK
    made = np.where(np.arange(rewards.shape[-1]) == actions, rewards, 0).sum(-1)
    taken = np.where(actions[..., 0] >= 0, made, np.nan)
    mean = np.where(possible, rewards, 0).sum(-1) / possible.sum(-1).clip(min=1)
    weak = (health < WEAK) & battle.trajectory.alive[:-1] & possible.any(-1)
    return [
        Life(health[at, agent], taken[at, agent], mean[at, agent])
        for agent, at in ((agent, np.flatnonzero(weak[:, agent])) for agent in range(weak.shape[1]))
    ]


def measure(found: Sequence[Life]) -> dict[str, Any]:
    """Every reading of the similarity, with the number of vectors and of values in them."""
    return {name: _mean_cosine(pairs) for name, pairs in _readings(found).items()}


def _readings(found: Sequence[Life]) -> dict[str, list[tuple[Values, Values]]]:
    """The pairs of vectors (health, r_in) by reading."""
    made = [(life.health[at], life.taken[at]) for life in found for at in [~np.isnan(life.taken)]]
    able = [(life.health, life.possible) for life in found]
    centred = [_centred(*pair) for pair in [_joined(made)] if len(pair[0])]
    return {
        "attacks made, per life": made,
        "attacks made, all in one vector": [_joined(made)],
        "attacks possible, per life": able,
        "attacks possible, all in one vector": [_joined(able)],
        "attacks made, all in one vector, centred": centred,
    }


def _joined(pairs: Iterable[tuple[Values, Values]]) -> tuple[Values, Values]:
    first, second = zip(*pairs, strict=True)
    return np.concatenate(first), np.concatenate(second)


def _centred(health: Values, r_in: Values) -> tuple[Values, Values]:
    """Makes the cosine a correlation, which no constant offset of r_in moves."""
    return health - health.mean(), r_in - r_in.mean()


def _mean_cosine(pairs: Sequence[tuple[Values, Values]]) -> dict[str, Any]:
    """Mean over vectors of two values or more: with one value the cosine is a mere sign."""
    counted = [(health, r_in) for health, r_in in pairs if len(health) > 1]
    similarities = [cosine(health, r_in) for health, r_in in counted]
    return {
        "cosine": float(np.mean(similarities)) if similarities else None,
        "vectors": len(counted),
        "values": sum(len(health) for health, _ in counted),
    }


def write_figure(
    frozen: Frozen, output: Path, episodes: int = EPISODES, mode: str = "greedy"
) -> dict[str, Any]:
    """Play, measure and write cosine.json and cosine.txt into `output`; returns the JSON.

    Raises:
        ConfigError: the run plays no battle.
    """
    played = list(battles(frozen, range(episodes), mode))
    figures = frozen.about() | {
        "map": frozen.config.env.map,
        "episodes": episodes,
        "actions": mode,
        "won": sum(battle.trajectory.info["won"] > 0 for battle in played),
        "paper": PAPER.get(frozen.config.env.map),
        "readings": measure([life for battle in played for life in lives(battle)]),
    }
    output.mkdir(parents=True, exist_ok=True)
    write_atomic(output / "cosine.json", json.dumps(figures, indent=1).encode())
    write_atomic(output / "cosine.txt", describe(figures).encode())
    return figures


def describe(figures: dict[str, Any]) -> str:
    """The figures as lines of text."""
    head = (
        f"Cosine similarity of health and r_in of attacks at health below {WEAK:.0%}; {figures['episodes']} "
        f"{figures['actions']} test episodes of {figures['run']}, checkpoint {figures['checkpoint']}, "
        f"{figures['won']} won. The paper states {figures['paper'] or 'nothing'} for {figures['map']}.\n"
    )
    return head + "".join(
        f"{name:42} {'–' if row['cosine'] is None else format(row['cosine'], '+.3f')}  "
        f"({row['values']} values in {row['vectors']} vectors)\n"
        for name, row in figures["readings"].items()
    )
