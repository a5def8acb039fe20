"""Wire messages: what goes in comes out, and what could not have been played is refused."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, tensor_pb2
from liir_common.types import Exploration, Ticket, policy_shapes, trajectories_equal
from tests.samples import SPEC, make_trajectory

STATS = rollout_pb2.ActorStats(play_seconds=0.5, wait_seconds=0.25)


def encode(compress: bool = False, **changes: object) -> rollout_pb2.Trajectory:
    return codec.encode_trajectory(replace(make_trajectory(), **changes), STATS, compress)  # type: ignore[arg-type]


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("length", [1, 6, 9])
def test_trajectory_round_trip(compress: bool, length: int) -> None:
    trajectory = make_trajectory(3, 2, length)
    wire = codec.encode_trajectory(trajectory, STATS, compress).SerializeToString()
    assert trajectories_equal(
        codec.decode_trajectory(rollout_pb2.Trajectory.FromString(wire), SPEC), trajectory
    )


def test_policy_round_trip() -> None:
    shapes = policy_shapes(SPEC, 8)
    weights = {name: np.random.default_rng(0).random(shape, np.float32) for name, shape in shapes.items()}
    decoded = codec.decode_policy(codec.encode_policy(4, weights), shapes)
    assert all(np.array_equal(decoded[name], weights[name]) for name in shapes)


def test_policy_with_other_tensors_is_refused() -> None:
    shapes = policy_shapes(SPEC, 8)
    weights = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    del weights["fc1.bias"]
    with pytest.raises(ValueError, match="wanted tensors"):
        codec.decode_policy(codec.encode_policy(0, weights), shapes)


@pytest.mark.parametrize("exploration", list(Exploration))
def test_ticket_round_trip(exploration: Exploration) -> None:
    ticket = Ticket(2**40, 3, 2**64 - 1, exploration, 0.3)
    assert codec.decode_ticket(codec.encode_ticket(ticket)) == ticket


def test_unknown_exploration_is_refused() -> None:
    with pytest.raises(ValueError, match="exploration"):
        codec.decode_ticket(rollout_pb2.Ticket())


def nan_like(name: str) -> np.ndarray:
    array = getattr(make_trajectory(), name).copy()
    array.flat[-1] = np.nan
    return array


def all_masked() -> np.ndarray:
    mask = make_trajectory().mask.copy()
    mask[2, 1] = False
    return mask


def action(value: int) -> np.ndarray:
    actions = make_trajectory().actions.copy()
    actions[3, 0] = value
    return actions


def only_action_one() -> np.ndarray:
    mask = np.zeros_like(make_trajectory().mask)
    mask[..., 1] = True
    return mask


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obs": nan_like("obs")}, "obs: wanted finite"),
        ({"reward": nan_like("reward")}, "reward: wanted finite"),
        ({"state": nan_like("state")}, "state: wanted finite"),
        ({"log_mu": np.full((6, 2), 0.1, np.float32)}, "log_mu: wanted logarithms"),
        ({"mask": all_masked()}, "agent 1 at step 2 has no available action"),
        ({"actions": action(4)}, "agent 0 at step 3"),
        ({"actions": action(-1)}, "wanted 0..3"),
        ({"mask": only_action_one(), "actions": action(2)}, "agent 0 at step 3 took an action that its mask"),
        ({"terminated": False, "truncated": False}, "wanted terminated or truncated"),
        ({"info": {"won": 1.0}}, "wanted 2 figures, got 1"),
        ({"info": {"won": 1.0, "score": float("inf")}}, "info: wanted finite"),
        (
            {"obs": np.zeros((7, 2, 6), np.float32)},
            r"obs: wanted float32 \[7, 2, 5\], got float32 \[7, 2, 6\]",
        ),
        ({"alive": np.ones((6, 2), np.bool_)}, r"alive: wanted bool \[7, 2\]"),
        ({"reward": np.zeros(10, np.float32)}, "T in 1..9"),
        ({"reward": np.zeros(0, np.float32)}, "T in 1..9"),
        ({"reward": np.zeros((6, 1), np.float32)}, "T in 1..9"),
    ],
)
def test_what_no_episode_produces_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        codec.decode_trajectory(encode(**changes), SPEC)


def wrong_dtype(message: rollout_pb2.Trajectory) -> None:
    message.reward.dtype = tensor_pb2.DTYPE_INT16


def no_dtype(message: rollout_pb2.Trajectory) -> None:
    message.obs.dtype = tensor_pb2.DTYPE_UNSPECIFIED


def short(message: rollout_pb2.Trajectory) -> None:
    message.state.data = message.state.data[:-1]


def not_boolean(message: rollout_pb2.Trajectory) -> None:
    message.mask.data = b"\2" + message.mask.data[1:]


def missing(message: rollout_pb2.Trajectory) -> None:
    message.ClearField("log_mu")


def not_zstd(message: rollout_pb2.Trajectory) -> None:
    message.obs.zstd = True


def bomb(message: rollout_pb2.Trajectory) -> None:
    message.obs.zstd = True
    message.obs.data = zstandard.ZstdCompressor().compress(bytes(2**28))


def bomb_without_size(message: rollout_pb2.Trajectory) -> None:
    message.obs.zstd = True
    packer = zstandard.ZstdCompressor(write_content_size=False)
    message.obs.data = packer.compress(bytes(2**28))


@pytest.mark.parametrize(
    ("damage", "wanted"),
    [
        (wrong_dtype, "reward: wanted float32"),
        (no_dtype, "got an unknown dtype"),
        (short, "state: wanted 84 bytes"),
        (not_boolean, "mask: wanted booleans"),
        (missing, "log_mu: wanted float32"),
        (not_zstd, "obs: wanted a zstd frame"),
        (bomb, "obs: wanted a zstd frame of 280 bytes, got one of 268435456"),
        (bomb_without_size, "obs: wanted a zstd frame of 280 bytes"),
    ],
)
def test_damaged_tensors_are_refused(damage: Callable[[rollout_pb2.Trajectory], None], wanted: str) -> None:
    message = encode()
    damage(message)
    with pytest.raises(ValueError, match=wanted):
        codec.decode_trajectory(message, SPEC)
