"""Messages to the process that computes, over a pair of sockets without that process."""

from __future__ import annotations

import math
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from liir_common.types import Array
from services.learner.compute.link import Link
from services.learner.replay_store import join, split

SQUARE = np.arange(12, dtype=np.float32).reshape(3, 4)


@pytest.fixture
def ends() -> Iterator[tuple[Link, Link]]:
    ours, theirs = map(Link, socket.socketpair())
    yield ours, theirs
    ours.close()
    theirs.close()


@pytest.mark.parametrize(
    "array",
    [
        np.array(3.5),
        np.zeros((3, 0, 2), np.int16),
        SQUARE.T,
        SQUARE[:, ::2],
        SQUARE[::-1],
        np.array([True, False]),
        np.arange(3, dtype=np.uint64),
        np.array([math.nan, math.inf]),
    ],
    ids=lambda array: f"{array.dtype}{array.shape}{array.strides}",
)
def test_an_array_comes_as_it_was(ends: tuple[Link, Link], array: Array) -> None:
    ends[0].send(None, {"x": array})
    _, arrays = ends[1].receive()
    got = arrays["x"]
    np.testing.assert_array_equal(got, array)
    assert (got.dtype, got.shape, got.flags.writeable) == (array.dtype, array.shape, True)


def test_numbers_come_as_they_were(ends: tuple[Link, Link]) -> None:
    head = ["a", None, True, 0.1, -math.inf, {"b": [1, 2**60]}]
    ends[0].send(head)
    assert ends[1].receive() == (head, {})
    ends[0].send([math.nan])
    ((number,), _) = ends[1].receive()
    assert math.isnan(number)


def test_what_cannot_be_said_leaves_no_part_of_a_message(ends: tuple[Link, Link]) -> None:
    with pytest.raises(TypeError, match="not JSON serializable"):
        ends[0].send(np.float32(1))
    with pytest.raises(Exception, match="dtype"):
        ends[0].send(None, {"x": np.array(["text"])})
    ends[0].send("next")
    assert ends[1].receive() == ("next", {})


@pytest.mark.parametrize("part", [b"", b"\0" * 3, struct.pack("<QQ", 5, 0) + b"nul"])
def test_an_end_within_a_message_is_an_end(part: bytes) -> None:
    ours, theirs = socket.socketpair()
    ours.sendall(part)
    ours.close()
    link = Link(theirs)
    with pytest.raises(EOFError):
        link.receive()
    link.close()


def test_closing_wakes_who_waits_here(ends: tuple[Link, Link]) -> None:
    raised: list[BaseException] = []

    def wait() -> None:
        try:
            ends[0].receive()
        except (EOFError, OSError) as error:
            raised.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    ends[0].close()
    thread.join(30)
    assert not thread.is_alive()
    assert raised


@pytest.mark.parametrize("frames", [[], [b""], [b"abc", b"", b"de"]])
def test_frames_are_joined_and_split(frames: list[bytes]) -> None:
    assert split(join(frames)) == frames
