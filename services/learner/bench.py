"""How fast a learner step is, beside what its matrix products alone would take."""

from __future__ import annotations

import numpy as np

from liir_common.types import Batch, EnvSpec, Trajectory


def synthetic_batch(
    spec: EnvSpec, episodes: int, steps: int, seed: int, policy_version: int = 0, epsilon: float = 0.1
) -> Batch:
    """Random episodes of about `steps` steps (standard deviation a fifth) played by the uniform policy.

    Every other agent dies, uniformly within the second half of its episode; one episode in five runs into
    the limit.
    """
    rng = np.random.default_rng(seed)
    lengths = np.clip(rng.normal(steps, steps / 5, episodes).round(), 2, spec.episode_limit).astype(int)
    trajectories = [_episode(spec, i, int(length), rng, policy_version) for i, length in enumerate(lengths)]
    return Batch.from_trajectories(trajectories, epsilon)


def _episode(spec: EnvSpec, number: int, length: int, rng: np.random.Generator, version: int) -> Trajectory:
    n, a = spec.n_agents, spec.n_actions
    death = np.where(rng.random(n) < 0.5, rng.integers(length // 2 + 1, length + 1, n), length + 1)
    alive = np.arange(length + 1)[:, None] < death
    mask = rng.random((length + 1, n, a)) < 0.7
    mask[..., 0] = ~alive
    mask[~alive, 1:] = False
    mask[alive, 1] = True
    actions = np.where(mask, rng.random(mask.shape), -1).argmax(-1)[:length]
    truncated = bool(rng.random() < 0.2)
    return Trajectory(
        episode_id=number,
        policy_version=version,
        obs=(rng.normal(size=(length + 1, n, spec.obs_dim)) * alive[..., None]).astype(np.float32),
        state=rng.normal(size=(length + 1, spec.state_dim)).astype(np.float32),
        mask=mask,
        alive=alive,
        actions=actions.astype(np.int16),
        log_mu=-np.log(mask[:length].sum(-1)).astype(np.float32),
        reward=rng.random(length).astype(np.float32),
        terminated=not truncated,
        truncated=truncated,
        info={key: 0.0 for key in spec.info_keys},
    )
