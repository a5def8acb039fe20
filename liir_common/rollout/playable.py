"""What an episode must be like for anybody to have played it; anything else would poison the learner."""

import math

import numpy as np
from numba import njit

from liir_common import kernel_cache
from liir_common.types import EnvSpec, Trajectory

kernel_cache.install()

_PLAYABLE, _POSITIVE, _STUCK, _OUT_OF_RANGE, _FORBIDDEN = range(5)
_FIGURES = ("obs", "state", "log_mu", "reward")
_EXPONENT = np.uint32(0x7F800000)
"""These bits of a float32 are all ones if it is infinite or NaN."""


def check_playable(trajectory: Trajectory, spec: EnvSpec) -> None:
    """Refuse what no episode can produce.

    Raises:
        ValueError: a figure is not finite, an agent has no available action, an action is out of range
            or not available, or the episode has no end.
    """
    if not (trajectory.terminated or trajectory.truncated):
        raise ValueError("trajectory: wanted terminated or truncated, got neither")
    if not all(map(math.isfinite, trajectory.info.values())):
        raise ValueError("info: wanted finite numbers, got NaN or infinity")
    if fault := _first_infinite(*(getattr(trajectory, name).view(np.uint32) for name in _FIGURES)):
        raise ValueError(f"{_FIGURES[fault - 1]}: wanted finite numbers, got NaN or infinity")
    fault, step, agent = _first_fault(trajectory.mask, trajectory.actions, trajectory.log_mu)
    where = f"agent {agent} at step {step}"
    if fault == _POSITIVE:
        raise ValueError(f"log_mu: wanted logarithms of probabilities, {where} has a positive one")
    if fault == _STUCK:
        raise ValueError(f"mask: {where} has no available action")
    if fault == _OUT_OF_RANGE:
        raise ValueError(f"actions: wanted 0..{spec.n_actions - 1}, {where} has another")
    if fault == _FORBIDDEN:
        raise ValueError(f"actions: {where} took an action that its mask forbids")


@njit(cache=True, nogil=True)
def _first_infinite(obs, state, log_mu, reward):
    """The number, from 1 on, of the first array that has an infinity or NaN among these bits, else 0."""
    if not _all_finite(obs.reshape(-1)):
        return 1
    if not _all_finite(state.reshape(-1)):
        return 2
    if not _all_finite(log_mu.reshape(-1)):
        return 3
    return 0 if _all_finite(reward) else 4


@njit(cache=True, nogil=True)
def _all_finite(bits):
    largest = np.uint32(0)
    for k in range(len(bits)):
        largest = max(largest, bits[k] & _EXPONENT)
    return largest != _EXPONENT


@njit(cache=True, nogil=True)
def _first_fault(mask, actions, log_mu):
    """The first fault with its step and agent; mask [T+1, n, A], actions and log_mu [T, n]."""
    steps = len(actions)
    for t in range(mask.shape[0]):
        for i in range(mask.shape[1]):
            if not mask[t, i].any():
                return _STUCK, t, i
            if t < steps:
                if not 0 <= actions[t, i] < mask.shape[2]:
                    return _OUT_OF_RANGE, t, i
                if not mask[t, i, actions[t, i]]:
                    return _FORBIDDEN, t, i
                if log_mu[t, i] > 0:
                    return _POSITIVE, t, i
    return _PLAYABLE, 0, 0
