"""Between our types and wire messages; whatever comes off a wire is checked here, before it is allocated.

Every function that decodes raises `ValueError` with what was wanted and what came.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import cast

import numpy as np
import zstandard
from numpy.typing import NDArray

from liir_common import types
from liir_common.rollout import changes
from liir_common.rollout.playable import check_playable
from liir_common.rpc.gen.liir.v1 import rollout_pb2, tensor_pb2
from liir_common.types import (
    TRAJECTORY_ARRAYS,
    Array,
    EnvSpec,
    Exploration,
    Ticket,
    Trajectory,
    Weights,
    expected_shape,
)

_DTYPES = {
    tensor_pb2.DTYPE_FLOAT32: np.dtype("<f4"),
    tensor_pb2.DTYPE_BOOL: np.dtype("?"),
    tensor_pb2.DTYPE_INT16: np.dtype("<i2"),
}
_RAW, _ZSTD, _CHANGES = (
    tensor_pb2.ENCODING_RAW,
    tensor_pb2.ENCODING_ZSTD,
    tensor_pb2.ENCODING_CHANGES,
)
_REPEATING = ("obs", "state")
"""Arrays of a trajectory that mostly stay as they are from step to step."""
_WORTH_PACKING = 1 << 16
"""Bytes; of a smaller array gRPC's copies cost less than finding and undoing the changes."""
_DIMS_SHOWN = 8
_DTYPE_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_EXPLORATIONS = {
    Exploration.SOFTMAX_FLOOR: rollout_pb2.EXPLORATION_SOFTMAX_FLOOR,
    Exploration.EPSILON_GREEDY: rollout_pb2.EXPLORATION_EPSILON_GREEDY,
    Exploration.GREEDY: rollout_pb2.EXPLORATION_GREEDY,
}
_EXPLORATION_NAMES = {code: name for name, code in _EXPLORATIONS.items()}


def encode_tensor(array: Array, encoding: tensor_pb2.Encoding = _RAW) -> tensor_pb2.Tensor:
    """Message with the array's bytes, as they are if `encoding` would make more of them."""
    data = b""
    if encoding == _ZSTD:
        data = zstandard.ZstdCompressor(level=1).compress(array.tobytes())
    elif encoding == _CHANGES:
        assert array.dtype == np.float32
        data = changes.pack(cast(NDArray[np.float32], array))
    if encoding == _RAW or len(data) > array.nbytes:
        data, encoding = array.tobytes(), _RAW
    return tensor_pb2.Tensor(dtype=_DTYPE_CODES[array.dtype], shape=array.shape, data=data, encoding=encoding)


def decode_tensor(
    message: tensor_pb2.Tensor, name: str, dtype: np.dtype[np.generic], shape: tuple[int, ...]
) -> Array:
    """Read-only array of exactly the wanted dtype and shape, sharing the message's bytes if it can."""
    got = _DTYPES.get(message.dtype)
    if got != dtype or message.shape != list(shape):
        raise ValueError(
            f"{name}: wanted {dtype.name} {list(shape)}, "
            f"got {got.name if got else 'an unknown dtype'} {_dims(message)}"
        )
    data = message.data
    if message.encoding == _CHANGES:
        return _unpack_changes(data, name, dtype, shape)
    size = dtype.itemsize * math.prod(shape)
    if message.encoding == _ZSTD:
        data = _unpack_zstd(data, name, size)
    elif message.encoding != _RAW:
        raise ValueError(f"{name}: wanted an encoding this build knows, got {message.encoding}")
    if len(data) != size:
        raise ValueError(f"{name}: wanted {size} bytes for {dtype.name} {list(shape)}, got {len(data)}")
    if dtype == np.bool_ and data.translate(None, b"\0\1"):
        raise ValueError(f"{name}: wanted booleans as bytes 0 or 1, got other bytes")
    return np.frombuffer(data, dtype).reshape(shape)


def _unpack_changes(data: bytes, name: str, dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> Array:
    if dtype != np.float32:
        raise ValueError(f"{name}: wanted changes of float32 alone, got those of {dtype.name}")
    try:
        return changes.unpack(data, shape)
    except ValueError as error:
        raise ValueError(f"{name}: wanted {error}") from None


def _dims(message: tensor_pb2.Tensor) -> str:
    """The shape as text; only the beginning of one that has millions of dimensions."""
    shown = ", ".join(map(str, message.shape[:_DIMS_SHOWN]))
    return f"[{shown}, …]" if len(message.shape) > _DIMS_SHOWN else f"[{shown}]"


def _unpack_zstd(data: bytes, name: str, size: int) -> bytes:
    # The frame's own claim is checked first: it is what the library would allocate.
    try:
        claimed = zstandard.frame_content_size(data)
        if claimed != size:
            raise ValueError(f"{name}: wanted a zstd frame of {size} bytes, got one of {claimed}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: wanted a zstd frame of {size} bytes, got {error}") from None


def encode_policy(version: int, weights: Weights) -> rollout_pb2.Policy:
    """Message with all tensors of the policy."""
    tensors = (
        tensor_pb2.NamedTensor(name=name, tensor=encode_tensor(array)) for name, array in weights.items()
    )
    return rollout_pb2.Policy(version=version, tensors=tensors)


def decode_policy(message: rollout_pb2.Policy, shapes: Mapping[str, tuple[int, ...]]) -> Weights:
    """Weights with exactly the wanted names and shapes."""
    names = [item.name for item in message.tensors]
    if sorted(names) != sorted(shapes):
        raise ValueError(f"policy: wanted tensors {sorted(shapes)}, got {sorted(names)}")
    float32 = np.dtype(np.float32)
    return {
        item.name: decode_tensor(
            item.tensor, f"policy tensor {item.name}", float32, shapes[item.name]
        ).astype(np.float32, copy=False)
        for item in message.tensors
    }


def encode_ticket(ticket: Ticket) -> rollout_pb2.Ticket:
    """Message of a ticket."""
    return rollout_pb2.Ticket(
        episode_id=ticket.episode_id,
        policy_version=ticket.policy_version,
        seed=ticket.seed,
        exploration=_EXPLORATIONS[ticket.exploration],
        epsilon=ticket.epsilon,
    )


def decode_ticket(message: rollout_pb2.Ticket) -> Ticket:
    """Ticket of a message."""
    exploration = _EXPLORATION_NAMES.get(message.exploration)
    if exploration is None:
        raise ValueError(f"ticket: wanted an exploration this build knows, got {message.exploration}")
    return Ticket(message.episode_id, message.policy_version, message.seed, exploration, message.epsilon)


def largest_episode(spec: EnvSpec) -> int:
    """Bytes of the arrays of an episode that lasts to the limit."""
    return sum(
        math.prod(expected_shape(name, spec, spec.episode_limit)) * np.dtype(dtype).itemsize
        for name, (dtype, _) in TRAJECTORY_ARRAYS.items()
    )


def encode_trajectory(
    trajectory: Trajectory, stats: rollout_pb2.ActorStats, compress: bool = False
) -> rollout_pb2.Trajectory:
    """Message with everything the episode produced, packed with zstd if asked."""

    def encoded(name: str) -> tensor_pb2.Tensor:
        array = getattr(trajectory, name)
        changes_pay = name in _REPEATING and array.nbytes >= _WORTH_PACKING
        return encode_tensor(array, _ZSTD if compress else _CHANGES if changes_pay else _RAW)

    return rollout_pb2.Trajectory(
        episode_id=trajectory.episode_id,
        policy_version=trajectory.policy_version,
        terminated=trajectory.terminated,
        truncated=trajectory.truncated,
        info=list(trajectory.info.values()),
        stats=stats,
        **{name: encoded(name) for name in types.TRAJECTORY_ARRAYS},
    )


@cache
def _layout(spec: EnvSpec, length: int) -> list[tuple[str, np.dtype[np.generic], tuple[int, ...]]]:
    """Name, dtype and shape of each array of an episode of `length` steps."""
    return [
        (name, np.dtype(dtype), types.expected_shape(name, spec, length))
        for name, (dtype, _) in types.TRAJECTORY_ARRAYS.items()
    ]


def decode_trajectory(message: rollout_pb2.Trajectory, spec: EnvSpec) -> Trajectory:
    """Trajectory whose sizes fit the environment and whose content could have been played."""
    length = message.reward.shape[0] if len(message.reward.shape) == 1 else 0
    if not 1 <= length <= spec.episode_limit:
        raise ValueError(
            f"reward: wanted shape [T] with T in 1..{spec.episode_limit}, got {_dims(message.reward)}"
        )
    if len(message.info) != len(spec.info_keys):
        raise ValueError(f"info: wanted {len(spec.info_keys)} figures, got {len(message.info)}")
    arrays = {
        name: decode_tensor(getattr(message, name), name, dtype, shape)
        for name, dtype, shape in _layout(spec, length)
    }
    trajectory = Trajectory(
        episode_id=message.episode_id,
        policy_version=message.policy_version,
        terminated=message.terminated,
        truncated=message.truncated,
        info=dict(zip(spec.info_keys, message.info, strict=True)),
        **arrays,
    )
    check_playable(trajectory, spec)
    return trajectory
