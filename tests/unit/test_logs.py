"""What a log line holds, and what it must not."""

import json
import subprocess
import sys

PROGRAM = """
import structlog
from liir_common import logs

logs.configure("test")
secret = "".join(map(chr, range(65, 91)))
try:
    raise ValueError("wanted something else")
except ValueError:
    structlog.get_logger().exception("failed")
"""


def test_tracebacks_tell_what_happened_and_no_local_variable() -> None:
    text = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True).stderr
    line = json.loads(text)
    assert (line["event"], line["process"]) == ("failed", "test")
    assert line["exception"][0]["exc_value"] == "wanted something else"
    assert "ABCDEFGHIJKLMNOPQRSTUVWXYZ" not in text


ERROR_ON_A_FULL_DISK = """
import sys
import structlog
from liir_common import logs
from liir_common.errors import StorageError, exit_on_error

logs.configure("test")
structlog.get_logger().info("x" * 100_000)
with exit_on_error():
    raise StorageError("no room")
"""


def test_a_log_on_a_full_disk_neither_ends_a_process_nor_changes_its_code() -> None:
    with open("/dev/full", "wb") as full:
        ended = subprocess.run([sys.executable, "-c", ERROR_ON_A_FULL_DISK], stderr=full, check=False)
    assert ended.returncode == 6
