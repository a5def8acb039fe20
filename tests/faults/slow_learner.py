"""`liir learner`, except that its updates are those of `slow_compute`."""

from __future__ import annotations

import sys

from liir_common import options
from services.learner import __main__, compute

if __name__ == "__main__":
    compute._COMMAND = (sys.executable, "-m", "tests.faults.slow_compute")
    options.run(__main__.learner)
