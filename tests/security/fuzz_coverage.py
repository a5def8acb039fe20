"""`make fuzz`: inputs that coverage leads to, into the codec.

atheris keeps each input that reaches new code and goes on from there. It ends with an error for an exception
that is not meant, an input that takes too long and memory that grows, and writes the input to a file.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import atheris
import psutil

# numba compiles nothing that is instrumented.
with atheris.instrument_imports(
    include=["liir_common"], exclude=["liir_common.rollout.changes", "liir_common.rollout.playable"]
):
    from liir_common.rpc import codec

from google.protobuf.message import DecodeError

from liir_common.rpc.gen.liir.v1 import rollout_pb2
from tests.samples import SPEC
from tests.security import fuzz_wire


def requests() -> list[bytes]:
    """What an actor sends, to begin from."""
    trajectories = [fuzz_wire.trajectory(SPEC, compress) for compress in (False, True)]
    messages = [
        rollout_pb2.PlayRequest(hello=rollout_pb2.Hello(actor_id="fuzz", env_spec_hash=SPEC.hash)),
        rollout_pb2.PlayRequest(ready=rollout_pb2.Ready(tickets=2)),
        rollout_pb2.PlayRequest(trajectories=trajectories),
    ]
    return [message.SerializeToString() for message in (*messages, *trajectories)]


def decode(wire: bytes) -> None:
    """Both as a trajectory and as a message of an actor's stream, as the learner does."""
    with suppress(DecodeError, ValueError):
        codec.decode_trajectory(rollout_pb2.Trajectory.FromString(wire), SPEC)
    with suppress(DecodeError, ValueError):
        for trajectory in rollout_pb2.PlayRequest.FromString(wire).trajectories:
            codec.decode_trajectory(trajectory, SPEC)


def fuzz(corpus: str) -> None:
    """Go on from the inputs in the folder `corpus`; ends the process."""
    limit = psutil.Process().memory_info().rss + fuzz_wire.MOST_GROWTH
    bounds = [f"-rss_limit_mb={limit // 2**20}", f"-timeout={fuzz_wire.HANG_SECONDS:.0f}"]
    atheris.Setup([sys.argv[0], *bounds, *sys.argv[1:], corpus], decode)
    atheris.Fuzz()


def main() -> int:
    """Fuzz with libFuzzer's options, such as -runs=100000; 0 if nothing was found."""
    with tempfile.TemporaryDirectory() as corpus:
        for number, wire in enumerate(requests()):
            (Path(corpus) / str(number)).write_bytes(wire)
        process = multiprocessing.get_context("fork").Process(target=fuzz, args=(corpus,))
        process.start()
        process.join()
    return process.exitcode or 0


if __name__ == "__main__":
    sys.exit(main())
