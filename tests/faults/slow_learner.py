"""`liir learner`, except that every update but the first takes a hundred times as long as it would.

Measured in CPU time of the thread that learns (`learner.threads: 1`), so that a busy machine does not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from liir_common import options
from liir_common.types import Batch
from services.learner import __main__, service

SLOWER = 100
_make_algorithm = service.make_algorithm


def make_slow_algorithm(*arguments: Any) -> Any:
    algorithm = _make_algorithm(*arguments)
    update, warm = algorithm.update, False

    def slow_update(batch: Batch, policy_ready: Callable[[], None]) -> Mapping[str, float]:
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
    service.make_algorithm = make_slow_algorithm
    options.run(__main__.learner)
