"""Certificates against clocks that are wrong."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from liir_common.certs import make_certs
from tests.e2e.service import LIIR
from tests.faults.supervisor import Clock
from tests.security.test_access import security, serving

pytestmark = pytest.mark.faults

DAY_S = 86_400


@pytest.mark.parametrize(
    ("wrong_by_s", "code", "reason"),
    [
        (0, 0, ""),
        (-DAY_S, 0, ""),
        (DAY_S, 0, ""),
        (-3 * DAY_S, 3, "not yet valid"),
        (400 * DAY_S, 3, "expired"),
    ],
)
def test_new_certificates_hold_for_who_is_a_day_wrong(
    tmp_path: Path, wrong_by_s: float, code: int, reason: str
) -> None:
    make_certs(tmp_path)
    clock = Clock(tmp_path, "client")
    clock.set(wrong_by_s)
    with serving(security(tmp_path)) as address:
        command = [LIIR, "health", "--learner", address, "--set", f"security={tmp_path / 'reader'}"]
        done = subprocess.run(command, env=os.environ | clock.environment, capture_output=True, text=True)
    assert (done.returncode, reason in done.stderr) == (code, True), done.stderr
