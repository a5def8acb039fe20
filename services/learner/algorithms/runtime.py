"""Settings of the process that trains."""

from __future__ import annotations

import ctypes
import gc
import sys

import torch

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_KEEP_BYTES = 1 << 30


def set_up_process(threads: int) -> None:
    """Give matrix products of the calling thread `threads` threads, and keep freed memory.

    glibc hands every freed block of a megabyte back to the system, and getting it anew costs a learner step
    more page faults than arithmetic. Threads but the first would have arenas of their own that do so
    whatever the thresholds, so all share one; call this before the thread that trains is started, too.
    """
    gc.freeze()  # What is there by now mostly stays; no collection has to look through it again.
    torch.set_num_threads(threads)
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):
            libc.mallopt(_M_ARENA_MAX, 1)
            libc.mallopt(_M_MMAP_THRESHOLD, _KEEP_BYTES)
            libc.mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
