"""`make fuzz`: damaged messages and zstd bombs, into the codec and into a real learner.

Every input must be refused with an error that is meant for it or be worth keeping, the codec's within a
second of processor time, and memory must not grow with them, not even for a moment. An input follows from
its number alone, and a failure names that.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import random
import re
import socket
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import grpc
import psutil
import zstandard
from google.protobuf.message import DecodeError, Message

from liir_common.build import build
from liir_common.client import TrainingClient
from liir_common.rollout.play import env_spec
from liir_common.rollout.playable import check_playable
from liir_common.rollout.policy import random_weights
from liir_common.rpc import codec
from liir_common.rpc.channel import CHANNEL_OPTIONS
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, rollout_pb2, tensor_pb2, training_pb2
from liir_common.types import TRAJECTORY_ARRAYS, EnvSpec, Exploration, Ticket, policy_shapes
from tests.e2e import service
from tests.samples import SPEC, encode_sample, make_trajectory

BOMB_BYTES = 2**28
MOST_GROWTH = 200 * 2**20
"""Bytes by which memory may grow; one bomb unpacks to more."""
MOST_SECONDS = 1.0
"""Of the thread that decodes: a busy machine takes longer, and is not what is tested."""
HANG_SECONDS = 60.0
HIDDEN = 4
DIMENSIONS = (0, 1, 7, 2**31, 2**32 - 1)


@cache
def wire_trajectory(spec: EnvSpec, compress: bool) -> bytes:
    stats = rollout_pb2.ActorStats(play_seconds=1.0)
    return encode_sample(make_trajectory(spec=spec), stats, compress).SerializeToString()


def trajectory(spec: EnvSpec, compress: bool) -> rollout_pb2.Trajectory:
    return rollout_pb2.Trajectory.FromString(wire_trajectory(spec, compress))


def bombs() -> list[bytes]:
    """Frames of a few kilobytes that unpack to 256 MiB: honest, without a size, and lying about it."""
    honest, silent = pack_zeros(BOMB_BYTES), pack_zeros(-1)
    size = BOMB_BYTES.to_bytes(4, "little")
    assert honest.count(size, 0, 16) == 1, "the frame's header has its size elsewhere"
    # The sizes that the tensors of the sample have, so that the claim passes for the truth.
    sample = make_trajectory(spec=SPEC)
    wanted = {getattr(sample, name).nbytes for name in TRAJECTORY_ARRAYS}
    return [honest, silent, *(honest.replace(size, w.to_bytes(4, "little"), 1) for w in wanted)]


def pack_zeros(claimed: int) -> bytes:
    """A bomb, packed piece by piece: memory is to peak later, if at all."""
    packer = zstandard.ZstdCompressor().compressobj(size=claimed)
    piece = bytes(2**20)
    return b"".join([*(packer.compress(piece) for _ in range(BOMB_BYTES // len(piece))), packer.flush()])


def tensors(message: Message) -> list[tuple[str, tensor_pb2.Tensor]]:
    """The message's tensors, with their names."""
    found = [(field.name, value) for field, value in message.ListFields()]
    return [(name, value) for name, value in found if isinstance(value, tensor_pb2.Tensor)]


BOMBS = bombs()


def damage_bytes(rng: random.Random, wire: bytes) -> bytes:
    """Cut, overwrite, insert, double or flip a few times."""
    data = bytearray(wire)
    for _ in range(rng.randint(1, 4)):
        start = rng.randrange(len(data) + 1)
        end = min(len(data), start + rng.choice((1, 2, 8, 64, 512)))
        match rng.randrange(6):
            case 0:
                del data[start:]
            case 1:
                data[start:end] = rng.randbytes(end - start)
            case 2:
                data[start:start] = rng.randbytes(rng.randint(1, 16))
            case 3:
                data[start:start] = data[start:end]
            case 4:
                data[start:end] = b"\xff" * 9 + b"\x01"  # the largest varint
            case 5 if start < len(data):
                data[start] ^= 1 << rng.randrange(8)
    return bytes(data)


def damage_tensor(rng: random.Random, message: rollout_pb2.Trajectory) -> None:
    """Change one thing in one tensor, so that the rest still passes."""
    _, tensor = rng.choice(tensors(message))
    match rng.randrange(6):
        case 0:
            tensor.dtype = rng.randrange(6)
        case 1:
            tensor.shape[rng.randrange(len(tensor.shape))] = rng.choice(DIMENSIONS)
        case 2:
            tensor.shape.extend([rng.choice(DIMENSIONS)] * rng.choice((1, 3, 1000)))
        case 3:
            tensor.encoding = rng.randrange(5)
        case 4:
            tensor.encoding, tensor.data = tensor_pb2.ENCODING_ZSTD, rng.choice(BOMBS)
        case 5:
            tensor.data = damage_bytes(rng, tensor.data)


def damaged_trajectory(rng: random.Random, spec: EnvSpec) -> bytes:
    message = trajectory(spec, compress=rng.random() < 0.5)
    if rng.random() < 0.5:
        damage_tensor(rng, message)
        return message.SerializeToString()
    return damage_bytes(rng, message.SerializeToString())


def decode_trajectory(wire: bytes) -> None:
    check_playable(codec.decode_trajectory(rollout_pb2.Trajectory.FromString(wire), SPEC), SPEC)


def decode_policy(wire: bytes) -> None:
    codec.decode_policy(rollout_pb2.Policy.FromString(wire), policy_shapes(SPEC, HIDDEN))


def decode_ticket(wire: bytes) -> None:
    codec.decode_ticket(rollout_pb2.Ticket.FromString(wire))


POLICY = codec.encode_policy(3, random_weights(SPEC, HIDDEN, seed=0)).SerializeToString()
TICKET = codec.encode_ticket(Ticket(1, 2, 3, Exploration.GREEDY, 0.5)).SerializeToString()


def reset_peak(process: str = "self") -> int:
    """Begin to measure the memory of a process anew; returns the bytes it has now."""
    if process == "self" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)  # A bomb would fit unseen into what was freed and kept.
    Path(f"/proc/{process}/clear_refs").write_text("5")
    return peak(process)


def peak(process: str = "self") -> int:
    """The most bytes that a process had in memory since `reset_peak`; getrusage knows of no reset."""
    found = re.search(r"^VmHWM:\s*(\d+) kB$", Path(f"/proc/{process}/status").read_text(), re.M)
    assert found, "the kernel does not say"
    return int(found[1]) * 1024


def fuzz_codec(inputs: int) -> Counter[str]:
    """Decode `inputs` damaged messages; returns how many ended in which way."""
    outcomes: Counter[str] = Counter()
    decode_trajectory(wire_trajectory(SPEC, True))  # the first has what is set up once
    before = reset_peak()
    for number in range(inputs):
        rng = random.Random(number)
        kind = rng.choice(("trajectory",) * 8 + ("policy", "ticket"))
        decode: Callable[[bytes], None]
        match kind:
            case "trajectory":
                decode, wire = decode_trajectory, damaged_trajectory(rng, SPEC)
            case "policy":
                decode, wire = decode_policy, damage_bytes(rng, POLICY)
            case _:
                decode, wire = decode_ticket, damage_bytes(rng, TICKET)
        faulthandler.dump_traceback_later(HANG_SECONDS, exit=True)
        begin = time.thread_time()
        try:
            decode(wire)
            outcome = "decoded"
        except (DecodeError, ValueError) as error:
            outcome = "no message" if isinstance(error, DecodeError) else "refused"
        except BaseException:
            print(f"codec input {number}")
            raise
        taken = time.thread_time() - begin
        assert taken < MOST_SECONDS, f"codec input {number} took {taken:.1f} s"
        outcomes[f"{kind}: {outcome}"] += 1
    faulthandler.cancel_dump_traceback_later()
    grown = peak() - before
    assert grown < MOST_GROWTH, f"memory grew by {grown / 2**20:.0f} MiB"
    return outcomes


# All methods but Stop, which would do what it is asked to, each with a message to begin from.
CALLS: dict[str, Message] = {
    "CheckpointService/ListCheckpoints": checkpoint_pb2.ListCheckpointsRequest(after_episode=3, limit=9),
    "CheckpointService/GetCheckpoint": checkpoint_pb2.GetCheckpointRequest(episode=100, offset=5),
    "CheckpointService/ListEvaluations": checkpoint_pb2.ListEvaluationsRequest(after_episode=3, limit=9),
    "CheckpointService/WatchCheckpoints": checkpoint_pb2.WatchCheckpointsRequest(after_episode=3),
    "CheckpointService/ReportEvaluation": checkpoint_pb2.ReportEvaluationRequest(
        evaluation=checkpoint_pb2.Evaluation(episode=100, sha256="a" * 64, env_steps=7)
    ),
    "TrainingService/GetRun": training_pb2.GetRunRequest(),
    "TrainingService/GetStatus": training_pb2.GetStatusRequest(),
}
MEANT = {
    grpc.StatusCode.OK,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.FAILED_PRECONDITION,
}
"""What a call may end with; besides, WatchCheckpoints waits for checkpoints until the deadline."""


def play_stream(rng: random.Random, spec: EnvSpec) -> list[bytes]:
    """A stream's messages: most begin as an actor's would, so that the damage comes deeper."""
    hello = rollout_pb2.PlayRequest(
        hello=rollout_pb2.Hello(actor_id="fuzz", env_spec_hash=spec.hash, build=build())
    )
    ready = rollout_pb2.PlayRequest(ready=rollout_pb2.Ready(tickets=2)).SerializeToString()
    first = hello.SerializeToString()
    if rng.random() < 0.2:
        first = damage_bytes(rng, first)
    if rng.random() < 0.2:
        return [first, damage_bytes(rng, ready)]
    message = trajectory(spec, compress=rng.random() < 0.5)
    damage_tensor(rng, message)
    wire = rollout_pb2.PlayRequest(trajectories=[message]).SerializeToString()
    return [first, ready, wire if rng.random() < 0.7 else damage_bytes(rng, wire)]


def fuzz_server(calls: int) -> Counter[str]:
    """Send `calls` damaged calls to a learner in a process of its own, and junk to its port."""
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder, serving(Path(folder)) as (address, learner):
        with grpc.insecure_channel(address, options=CHANNEL_OPTIONS) as channel:
            outcomes[call(channel, 0)] += 1  # the first call has what is set up once
            before = reset_peak(str(learner.pid))
            for number in range(1, calls):
                outcomes[call(channel, number)] += 1
        send_junk(address, calls // 10)
        grown = peak(str(learner.pid)) - before
        assert grown < MOST_GROWTH, f"the learner's memory grew by {grown / 2**20:.0f} MiB"
        with TrainingClient(address) as client:
            service.wait_for(lambda: client.status().actors == 0, "the end of the last stream", 10)
    return outcomes


@contextmanager
def serving(folder: Path) -> Iterator[tuple[str, psutil.Process]]:
    """Address and process of a learner; its log is a file, since a full pipe would stop it."""
    run_dir = folder / "run"
    command = [service.LIIR, "learner", "--run-dir", str(run_dir), *service.arguments([])]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
        yield service.endpoints(run_dir)["address"], psutil.Process(process.pid)
    finally:
        process.terminate()
        code = process.wait(60)
    log_text = (folder / "log").read_text()
    assert code == 0, log_text[-4000:]
    assert "Traceback" not in log_text, log_text[log_text.index("Traceback") :][:4000]


def call(channel: grpc.Channel, number: int) -> str:
    """One damaged call; returns the method and how it ended."""
    rng = random.Random(number)
    method = rng.choice([*CALLS, *["RolloutService/Play"] * len(CALLS)])
    if method in CALLS:
        messages = [damage_bytes(rng, CALLS[method].SerializeToString())]
    else:
        messages = play_stream(rng, env_spec(service.config().env))
    # What hangs ends with a status that is not meant.
    deadline = 0.05 if "Watch" in method else HANG_SECONDS
    responses = channel.stream_stream(f"/liir.v1.{method}")(iter(messages), timeout=deadline)
    with suppress(grpc.RpcError):
        for _ in responses:
            pass
    code = responses.code()
    meant = MEANT | {grpc.StatusCode.DEADLINE_EXCEEDED} if "Watch" in method else MEANT
    assert code in meant, f"server call {number}, {method}: {code.name}: {responses.details()}"
    return f"{method}: {code.name}"


def send_junk(address: str, connections: int) -> None:
    """Bytes that are no gRPC, half of them after the greeting of HTTP/2."""
    host, port = address.split(":")
    for number in range(connections):
        rng = random.Random(number)
        greeting = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" if number % 2 else b""
        with socket.create_connection((host, int(port)), timeout=5) as connection, suppress(ConnectionError):
            connection.sendall(greeting + rng.randbytes(rng.randint(1, 4096)))


def main() -> None:
    """Fuzz as much as the command line says, and print what the inputs ended as."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000, help="into the codec")
    parser.add_argument("--calls", type=int, default=5_000, help="into a learner")
    arguments = parser.parse_args()
    for outcomes in (fuzz_codec(arguments.inputs), fuzz_server(arguments.calls)):
        for outcome, count in sorted(outcomes.items()):
            print(f"{count:8} {outcome}")


if __name__ == "__main__":
    main()
