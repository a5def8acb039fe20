"""What every player shares: it holds a policy and turns a ticket into a trajectory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from liir_common import seeds
from liir_common.rollout.policy import MODES, Choice, Policy, pack
from liir_common.types import (
    TRAJECTORY_ARRAYS,
    BoolArray,
    EnvSpec,
    FloatArray,
    IntArray,
    Ticket,
    Trajectory,
    Weights,
    expected_shape,
)


class Rows(NamedTuple):
    """Room for the longest episode; the shapes are those of `Trajectory` with T the episode limit."""

    obs: FloatArray
    state: FloatArray
    mask: BoolArray
    alive: BoolArray
    actions: IntArray
    log_mu: FloatArray
    reward: FloatArray

    @classmethod
    def for_spec(cls, spec: EnvSpec) -> Rows:
        """Zeros for `spec.episode_limit` steps."""
        return cls(
            **{
                name: np.zeros(expected_shape(name, spec, spec.episode_limit), dtype)
                for name, (dtype, _) in TRAJECTORY_ARRAYS.items()
            }
        )


class Ending(NamedTuple):
    """How an episode ended, after `length` steps."""

    length: int
    terminated: bool
    truncated: bool
    info: Mapping[str, float]


class Player(ABC):
    """Plays episodes of one environment with one policy at a time; serves one thread at a time."""

    tickets_held = 1
    """Tickets to hold at a time: more than one pays where a policy takes longer to come than an episode."""

    def __init__(self, spec: EnvSpec, policy_hidden: int) -> None:
        self.spec = spec
        self._policy_hidden = policy_hidden
        self._hidden = np.zeros((spec.n_agents, policy_hidden), np.float32)
        self._rows = Rows.for_spec(spec)
        self._policy: Policy | None = None

    def load(self, weights: Weights) -> None:
        """Play with these weights from now on; once per policy version is enough.

        Raises:
            ValueError: the weights do not fit the environment or are not finite.
        """
        self._policy = pack(weights, self.spec, self._policy_hidden)

    def play(self, ticket: Ticket) -> Trajectory:
        """The episode that the ticket and the loaded weights determine, byte for byte.

        Raises:
            ValueError: no weights are loaded, the ticket is out of range, or the environment broke its
                promises (no available action, rewards that differ between agents, a missing figure).
        """
        if self._policy is None:
            raise ValueError("play wants a policy: call load(weights) first")
        if not 0 <= ticket.epsilon <= 1 or not 0 <= ticket.seed < 2**64:
            raise ValueError(f"a ticket wants epsilon in [0, 1] and a 64-bit seed, got {ticket}")
        stream = np.array([seeds.derive(ticket.seed, seeds.POLICY)], np.uint64)
        self._hidden[:] = 0
        choice = Choice(stream, MODES[ticket.exploration], float(ticket.epsilon))
        return self._cut(ticket, self._run(self._policy, ticket.seed, choice))

    @abstractmethod
    def _run(self, policy: Policy, seed: int, choice: Choice) -> Ending:
        """Play one episode into `_rows`, starting from the zeros in `_hidden`."""

    def _cut(self, ticket: Ticket, ending: Ending) -> Trajectory:
        arrays = {
            name: getattr(self._rows, name)[: ending.length + (axes[0] == "T+1")].copy()
            for name, (_, axes) in TRAJECTORY_ARRAYS.items()
        }
        return Trajectory(
            ticket.episode_id,
            ticket.policy_version,
            terminated=ending.terminated,
            truncated=ending.truncated,
            info=ending.info,
            **arrays,
        )
