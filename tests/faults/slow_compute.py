"""The process that computes, except that every update but the first takes a hundred times as long.

Measured in CPU time of the thread that learns (`learner.threads: 1`), so that a busy machine does not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from liir_common.types import Batch, Weights
from services.learner.compute import __main__ as compute

SLOWER = 100


def make(*arguments: Any) -> Any:
    algorithm = compute.make(*arguments)
    update, warm = algorithm.update, False

    def slow_update(batch: Batch, policy_ready: Callable[[Weights], None]) -> Mapping[str, float]:
        nonlocal warm
        begin = time.thread_time()
        figures = update(batch, policy_ready)
        if warm:
            time.sleep((SLOWER - 1) * (time.thread_time() - begin))
        warm = True
        return figures

    algorithm.update = slow_update  # type: ignore[method-assign]
    return algorithm


if __name__ == "__main__":
    compute.main(make)
