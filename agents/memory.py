"""Memory that is freed is kept for the next step.

By default the C library returns every block of more than 128 kB to the system when it is freed and asks for it again at the next
step, page fault by page fault: up to half of the time of a population whose temporaries are of that size.
"""

import ctypes
import functools
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc's malloc.h
_KEPT_BYTES = 1 << 28


@functools.cache
def keep_freed_memory() -> None:
    """Let this process keep up to 256 MB of freed memory. Does nothing where the C library is not glibc."""
    if not sys.platform.startswith("linux"):
        return
    try:
        libc = ctypes.CDLL(None)
        libc.mallopt(_MMAP_THRESHOLD, 1 << 25)
        libc.mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
    except (OSError, AttributeError):
        return
