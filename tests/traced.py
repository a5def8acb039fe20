"""What work takes of memory, and leaves there."""

import gc
import pathlib
import tracemalloc
from collections.abc import Callable


def bytes_left(work: Callable[[], None]) -> int:
    """By what Python has allocated meanwhile and not freed, the table of interned parts of paths left out."""
    tracemalloc.start()
    try:
        work()
        gc.collect()
        left = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(False, pathlib.__file__)])
        return sum(trace.size for trace in left.traces)
    finally:
        tracemalloc.stop()


def bytes_at_peak(work: Callable[[], object]) -> int:
    """The most that Python has allocated at a time meanwhile."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
