"""The C library's memory allocator on the CPU."""

from __future__ import annotations

import ctypes

# Parameters of glibc's mallopt (malloc.h).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_NEVER = 2**31 - 1


def keep_freed_memory() -> bool:
    """Let the process keep the memory that it frees, for the next step's tensors.

    By default glibc gives large blocks back to the system when a tensor dies. Every step then gets the same memory
    anew, one page fault and 4 KiB of zeros at a time, which can cost more than the arithmetic. The price is that memory
    once used stays with the process until it ends. Little may be left for long among tensors of ever different sizes:
    no gap would fit the next one, and the process would grow.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # not a Unix, or another C library
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _NEVER)) and bool(mallopt(_M_TRIM_THRESHOLD, _NEVER))
