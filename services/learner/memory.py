"""How a process of the learner keeps its memory."""

from __future__ import annotations

import ctypes
import gc
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_KEEP_BYTES = 1 << 30


def keep_memory() -> None:
    """Keep what is freed, and look no more for garbage in what is there by now.

    glibc hands every freed block of a megabyte back to the system, and getting it anew costs a learner step
    more page faults than arithmetic. Threads but the first would have arenas of their own that do so
    whatever the thresholds, so all share one; call this before others are started.
    """
    gc.freeze()
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):
            libc.mallopt(_M_ARENA_MAX, 1)
            libc.mallopt(_M_MMAP_THRESHOLD, _KEEP_BYTES)
            libc.mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
