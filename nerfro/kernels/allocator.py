"""The C library's memory allocator on the CPU."""

from __future__ import annotations

import ctypes

# Settings of glibc's mallopt (malloc.h). Blocks above M_MMAP_THRESHOLD (-3), 64 MiB, are returned to the system: steps
# of training and rendering allocate smaller blocks, and fits of the background larger ones. M_TRIM_THRESHOLD (-1):
# nothing else is returned.
_SETTINGS = {-3: 2**26, -1: 2**31 - 1}


def keep_freed_memory() -> bool:
    """Let the process keep memory that is freed from now on, for the tensors of the next step.

    By default, glibc returns large blocks to the system when a tensor is freed. Every step then allocates the same
    memory again, one page fault and 4 KiB of zeros at a time, which can cost more than the arithmetic. The price is
    that the process keeps the memory until the process ends. Long-lived tensors must not be allocated among tensors of
    varying sizes, because freed gaps would not fit later tensors and the process would grow.

    Returns:
        Whether the C library supports the setting.
    """
    try:
        library = ctypes.CDLL(None)
        library.malloc_trim(0)
    except (OSError, TypeError, AttributeError):  # not a Unix, or another C library
        return False
    return all(library.mallopt(*setting) for setting in _SETTINGS.items())
