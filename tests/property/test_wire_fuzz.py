"""Whatever bytes arrive, decoding ends in a trajectory that could have been played or in a ValueError."""

from contextlib import suppress

import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from liir_common.rollout.playable import check_playable
from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2
from liir_common.types import policy_shapes
from tests.samples import SPEC, encode_sample, make_trajectory

VALID = {
    compress: encode_sample(
        make_trajectory(), rollout_pb2.ActorStats(play_seconds=1.0), compress
    ).SerializeToString()
    for compress in (False, True)
}


def decode(wire: bytes) -> None:
    """Any other error fails the test; gRPC answers the first of these itself, our servicer the second."""
    with suppress(DecodeError, ValueError):
        check_playable(codec.decode_trajectory(rollout_pb2.Trajectory.FromString(wire), SPEC), SPEC)
    with suppress(DecodeError, ValueError):
        for trajectory in rollout_pb2.PlayRequest.FromString(wire).trajectories:
            codec.decode_trajectory(trajectory, SPEC)


# An example may compile or wait for a busy machine: how long it takes says nothing here.
@settings(deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes(wire: bytes) -> None:
    decode(wire)


@settings(max_examples=400, deadline=None)
@given(
    compress=st.booleans(),
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=6)), max_size=4),
)
def test_mutated_trajectories(compress: bool, edits: list[tuple[int, bytes]]) -> None:
    wire = bytearray(VALID[compress])
    for position, replacement in edits:
        start = position % len(wire)
        wire[start : start + len(replacement)] = replacement
    decode(bytes(wire))


@settings(deadline=None)
@given(compress=st.booleans(), length=st.integers(0, 10**6))
def test_truncated_trajectories(compress: bool, length: int) -> None:
    decode(VALID[compress][: length % len(VALID[compress])])


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_any_policy_bytes(wire: bytes) -> None:
    with pytest.raises((DecodeError, ValueError), match=r"."):
        codec.decode_policy(rollout_pb2.Policy.FromString(wire), policy_shapes(SPEC, 4))
