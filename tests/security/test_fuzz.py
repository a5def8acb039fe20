"""A short turn of `make fuzz`, and the bombs one by one."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard

from liir_common.rpc import codec
from liir_common.rpc.gen.liir.v1 import rollout_pb2, tensor_pb2
from tests.samples import SPEC
from tests.security import fuzz_wire

ROOT = Path(__file__).parents[2]


def test_the_codec_takes_damaged_messages() -> None:
    outcomes = fuzz_wire.fuzz_codec(3000)
    assert outcomes.total() == 3000
    assert {"trajectory: no message", "trajectory: refused", "trajectory: decoded"} <= set(outcomes)


def unpack_all_first(data: bytes, name: str, size: int) -> bytes:
    """What the codec would do without its look at the frame's header."""
    try:
        unpacked: bytes = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: {error}") from None
    if len(unpacked) != size:
        raise ValueError(f"{name}: wanted {size} bytes, got {len(unpacked)}")
    return unpacked


def test_a_codec_that_unpacks_a_bomb_before_it_refuses_it_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even in a process that once had more memory than that."""
    earlier = b"\1" * (fuzz_wire.BOMB_BYTES + fuzz_wire.MOST_GROWTH)
    del earlier
    monkeypatch.setattr(codec, "_unpack_zstd", unpack_all_first)
    # The others lie about their size, which zstd itself finds out before it has unpacked much.
    monkeypatch.setattr(fuzz_wire, "BOMBS", fuzz_wire.BOMBS[:2])
    with pytest.raises(AssertionError, match=r"memory grew by [2-9]\d\d MiB"):
        fuzz_wire.fuzz_codec(30)


@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64" or sys.version_info >= (3, 12),
    reason="atheris is required where pyproject.toml says that there is a wheel of it",
)
def test_the_codec_takes_what_coverage_leads_to(tmp_path: Path) -> None:
    arguments = ["tests.security.fuzz_coverage", "-runs=2000", f"-artifact_prefix={tmp_path}/"]
    command = [sys.executable, "-m", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-4000:]
    assert "Done 2000 runs" in done.stderr


def test_a_learner_takes_damaged_calls() -> None:
    outcomes = fuzz_wire.fuzz_server(300)
    assert outcomes.total() == 300
    assert len({outcome.split(":")[0] for outcome in outcomes}) == len(fuzz_wire.CALLS) + 1


@pytest.mark.parametrize("bomb", fuzz_wire.BOMBS)
@pytest.mark.parametrize("name", ["obs", "mask", "actions", "reward"])
def test_bombs_are_refused(bomb: bytes, name: str) -> None:
    assert len(bomb) < 2**15
    message: rollout_pb2.Trajectory = fuzz_wire.trajectory(SPEC, compress=False)
    tensor = getattr(message, name)
    tensor.encoding, tensor.data = tensor_pb2.ENCODING_ZSTD, bomb
    with pytest.raises(ValueError, match=f"{name}: wanted a zstd frame of"):
        codec.decode_trajectory(message, SPEC)
