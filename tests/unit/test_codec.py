"""Wire messages: what goes in comes out, and what could not have been played is refused."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from liir_common.rollout import changes
from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, tensor_pb2
from liir_common.types import Exploration, Ticket, policy_shapes
from tests.samples import SPEC, encode_sample, make_trajectory, trajectories_equal

STATS = rollout_pb2.ActorStats(play_seconds=0.5, wait_seconds=0.25)


def encode(compress: bool = False, **changes: object) -> rollout_pb2.Trajectory:
    return encode_sample(replace(make_trajectory(), **changes), STATS, compress)  # type: ignore[arg-type]


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("length", [1, 6, 9])
def test_trajectory_round_trip(compress: bool, length: int) -> None:
    trajectory = make_trajectory(3, 2, length)
    wire = encode_sample(trajectory, STATS, compress).SerializeToString()
    assert trajectories_equal(
        codec.decode_trajectory(rollout_pb2.Trajectory.FromString(wire), SPEC), trajectory
    )


def test_only_large_arrays_are_packed() -> None:
    spec = replace(SPEC, obs_dim=2000)
    message = codec.encode_trajectory(make_trajectory(spec=spec), STATS)
    assert message.obs.encoding == tensor_pb2.ENCODING_CHANGES
    assert message.state.encoding == tensor_pb2.ENCODING_RAW
    assert trajectories_equal(codec.decode_trajectory(message, spec), make_trajectory(spec=spec))


def test_what_repeats_is_not_sent() -> None:
    message = encode()
    assert message.obs.encoding == message.state.encoding == tensor_pb2.ENCODING_CHANGES
    rows, width, changed = 7, 2 * 5, 4
    assert len(message.obs.data) == 4 * (rows + changed * width)


@pytest.mark.parametrize("width", [1, 31, 32, 33, 130])
def test_changes_keep_every_bit(width: int) -> None:
    bits = np.random.default_rng(width).choice(
        np.array([0, 1 << 31, 1, 0x7FC00001, 0x3F800000], np.uint32), (9, width)
    )
    array = bits.view(np.float32)  # zeros of both signs and a NaN among them
    assert np.array_equal(changes.unpack(changes.pack(array), array.shape).view(np.uint32), bits)


def test_changes_that_would_be_larger_are_sent_as_they_are() -> None:
    array = np.arange(1, 61, dtype=np.float32).reshape(6, 10)
    message = codec.encode_tensor(array, tensor_pb2.ENCODING_CHANGES)
    assert message.encoding == tensor_pb2.ENCODING_RAW
    assert message.data == array.tobytes()


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
    message.reward.data = message.reward.data[:-1]


def change_missing(message: rollout_pb2.Trajectory) -> None:
    message.obs.data = message.obs.data[:-4]


def change_too_many(message: rollout_pb2.Trajectory) -> None:
    message.obs.data += bytes(4)


def no_word(message: rollout_pb2.Trajectory) -> None:
    message.obs.data += bytes(1)


def marks_missing(message: rollout_pb2.Trajectory) -> None:
    message.obs.data = message.obs.data[:24]


def mark_beyond_the_row(message: rollout_pb2.Trajectory) -> None:
    marks = bytearray(message.obs.data)
    marks[1] |= 1 << 2  # of ten values, the eleventh
    message.obs.data = bytes(marks) + bytes(4)


def changes_of_integers(message: rollout_pb2.Trajectory) -> None:
    message.actions.encoding = tensor_pb2.ENCODING_CHANGES


def not_boolean(message: rollout_pb2.Trajectory) -> None:
    message.mask.data = b"\2" + message.mask.data[1:]


def missing(message: rollout_pb2.Trajectory) -> None:
    message.ClearField("log_mu")


def unknown_encoding(message: rollout_pb2.Trajectory) -> None:
    message.obs.encoding = 7  # type: ignore[assignment]


def not_zstd(message: rollout_pb2.Trajectory) -> None:
    message.obs.encoding = tensor_pb2.ENCODING_ZSTD


def bomb(message: rollout_pb2.Trajectory) -> None:
    message.obs.encoding = tensor_pb2.ENCODING_ZSTD
    message.obs.data = zstandard.ZstdCompressor().compress(bytes(2**28))


def bomb_without_size(message: rollout_pb2.Trajectory) -> None:
    message.obs.encoding = tensor_pb2.ENCODING_ZSTD
    packer = zstandard.ZstdCompressor(write_content_size=False)
    message.obs.data = packer.compress(bytes(2**28))


@pytest.mark.parametrize(
    ("damage", "wanted"),
    [
        (wrong_dtype, "reward: wanted float32"),
        (no_dtype, "got an unknown dtype"),
        (short, "reward: wanted 24 bytes"),
        (change_missing, r"obs: wanted marks for \[7, 2, 5\] and a value for each"),
        (change_too_many, "obs: wanted marks"),
        (no_word, "obs: wanted marks"),
        (marks_missing, "obs: wanted marks"),
        (mark_beyond_the_row, "obs: wanted marks"),
        (changes_of_integers, "actions: wanted changes of float32 alone, got those of int16"),
        (unknown_encoding, "obs: wanted an encoding this build knows, got 7"),
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
