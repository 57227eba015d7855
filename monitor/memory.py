"""How freed memory is kept for the next array."""

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Names of these settings in the C library (malloc.h)."""

_KEPT_BYTES = 1 << 30
"""Freed memory that is kept: all of it. A process holds what its fullest moment needed, and no more."""


def keep_freed() -> None:
    """Lets the C library keep freed memory; where it is another than glibc, nothing is changed.

    Arrays of a frame are of some megabytes and live for milliseconds. By default each is asked of the kernel
    anew, page by page, which costs up to three times what is computed in it.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    for setting in (_TRIM_THRESHOLD, _MMAP_THRESHOLD):
        libc.mallopt(setting, _KEPT_BYTES)
