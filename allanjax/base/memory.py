"""Memory that NumPy has freed, but the C library keeps."""

from __future__ import annotations

import contextlib
import ctypes


def return_freed() -> None:
    """Return freed memory to the system, where the C library is glibc; elsewhere nothing happens.

    Arrays of several megabytes leave gaps that later arrays of other lengths do not fill.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
