"""Made-up environments and episodes for tests that need the shapes, not the game."""

from dataclasses import fields

import numpy as np

from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, tensor_pb2
from liir_common.types import EnvSpec, Trajectory

SPEC = EnvSpec(
    name="sample",
    version="1",
    options="{}",
    n_agents=2,
    n_actions=4,
    obs_dim=5,
    state_dim=3,
    episode_limit=9,
    info_keys=("won", "score"),
)


def make_trajectory(
    episode_id: int = 0, version: int = 0, length: int = 6, spec: EnvSpec = SPEC
) -> Trajectory:
    """An episode that could have been played: random, but the same for the same arguments."""
    random = np.random.default_rng([episode_id, version, length])
    shape = (length + 1, spec.n_agents)
    mask = random.random((*shape, spec.n_actions)) < 0.5
    mask[..., 1] = True
    obs = random.standard_normal((*shape, spec.obs_dim)).astype(np.float32)
    state = random.standard_normal((length + 1, spec.state_dim)).astype(np.float32)
    for repeating in (obs, state):
        repeating[1::2] = repeating[:-1:2]  # as most of a battle does
    return Trajectory(
        episode_id=episode_id,
        policy_version=version,
        obs=obs,
        state=state,
        mask=mask,
        alive=np.ones(shape, np.bool_),
        actions=np.ones((length, spec.n_agents), np.int16),
        log_mu=np.log(random.uniform(0.1, 1, (length, spec.n_agents))).astype(np.float32),
        reward=random.standard_normal(length).astype(np.float32),
        terminated=length < spec.episode_limit,
        truncated=length == spec.episode_limit,
        info={"won": float(episode_id % 2), "score": 0.5},
    )


def encode_sample(
    trajectory: Trajectory, stats: rollout_pb2.ActorStats, compress: bool = False
) -> rollout_pb2.Trajectory:
    """As `codec.encode_trajectory`, and packed like a large episode unless it is compressed."""
    message = codec.encode_trajectory(trajectory, stats, compress)
    for name in () if compress else ("obs", "state"):
        tensor = codec.encode_tensor(getattr(trajectory, name), tensor_pb2.ENCODING_CHANGES)
        getattr(message, name).CopyFrom(tensor)
    return message


def trajectories_equal(a: Trajectory, b: Trajectory) -> bool:
    """Whether two trajectories agree in every byte."""
    for field in fields(Trajectory):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            if x.dtype != y.dtype or x.shape != y.shape or x.tobytes() != y.tobytes():
                return False
        elif x != y:
            return False
    return True
