"""The intrinsic reward in numpy is the network that was trained."""

from dataclasses import asdict
from hashlib import sha256

import numpy as np
import pytest
import torch

from liir_common.checkpoint import Manifest, pack, unpack
from liir_common.config import load
from liir_common.errors import ConfigError
from liir_common.intrinsic import IntrinsicReward
from liir_common.types import EnvSpec
from services.learner.algorithms import networks

SPEC = EnvSpec(
    "game", "1", "{}", n_agents=3, n_actions=4, obs_dim=5, state_dim=6, episode_limit=7, info_keys=()
)


def make_manifest(data: bytes, *settings: str) -> Manifest:
    return Manifest(
        episode=100,
        policy_version=3,
        env_steps=1000,
        run_id="run",
        git_commit="abc",
        env_spec=asdict(SPEC),
        config=load(None, settings).tree(),
        created=1.0,
        sha256=sha256(data).hexdigest(),
        size_bytes=len(data),
    )


@pytest.mark.parametrize("bound", [0.3, 10.0])
def test_it_is_the_network_that_was_trained(bound: float) -> None:
    network = networks.IntrinsicReward(SPEC, 16, bound)
    eta = networks.initial(network, 1.0, True, 7, torch.device("cpu"), torch.float32)
    data = pack({f"intrinsic.{name}": array for name, array in networks.arrays(eta, network.shapes).items()})
    manifest = make_manifest(data, f"algorithm.r_in_bound={bound}")
    obs = np.random.default_rng(1).normal(size=(2, 8, SPEC.n_agents, SPEC.obs_dim)).astype(np.float32)

    got = IntrinsicReward.from_checkpoint(manifest, unpack(data, manifest.sha256))(obs)

    ids = torch.eye(SPEC.n_agents).expand(2, 8, -1, -1)
    wanted = network(eta, torch.cat([torch.from_numpy(obs), ids], -1).flatten(0, 2)).view(got.shape)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-6)


def test_a_method_without_one_is_named() -> None:
    data = pack({"policy.fc1.bias": np.zeros(2, np.float32)})
    with pytest.raises(ConfigError, match=r"central_v.*no intrinsic reward"):
        IntrinsicReward.from_checkpoint(
            make_manifest(data, "algorithm=central_v"), unpack(data, sha256(data).hexdigest())
        )
