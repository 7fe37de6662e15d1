"""The memory of this process, and what of it the system can have back."""

import ctypes
import mmap
import platform
from pathlib import Path
from typing import Any


def give_back_memory() -> None:
    """Hand memory that was freed to the system, where the C library keeps it: some 270 MB after compiling."""
    if platform.system() == "Linux" and platform.libc_ver()[0] == "glibc":
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def peak_rss_bytes() -> int:
    """The most memory that this process has held.

    Returns:
        [bytes].
    """
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.exists() else ():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    import resource  # not on Windows

    # Also counts the parent up to the fork, hence the second choice; macOS gives bytes, others kilobytes.
    unit = 1 if platform.system() == "Darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def give_back_zeros(zeros: Any, first: int = 0) -> None:
    """Hand pages of zeros to the system, which makes them anew, as zeros, where they are written.

    So an array with room for more than it holds takes the memory of what it holds. Nothing happens to arrays
    of a GPU or of several devices, while functions are traced, and where the system is not Linux.

    Args:
        zeros: An array of JAX.
        first: From this row on it holds nothing but zeros.
    """
    from jax.core import Tracer  # slow to load, and results of runs are read without it

    if platform.system() != "Linux" or isinstance(zeros, Tracer):
        return
    if [device.platform for device in zeros.devices()] != ["cpu"]:
        return
    begin = zeros.block_until_ready().unsafe_buffer_pointer()
    start = -(-(begin + first * (zeros.nbytes // len(zeros))) // mmap.PAGESIZE)
    end = (begin + zeros.nbytes) // mmap.PAGESIZE
    if start < end:
        pages = ctypes.c_void_p(start * mmap.PAGESIZE), ctypes.c_size_t((end - start) * mmap.PAGESIZE)
        ctypes.CDLL(None).madvise(*pages, ctypes.c_int(mmap.MADV_DONTNEED))
