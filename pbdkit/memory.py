"""Available memory of the machine or container, and the limit on address space."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

LIBRARIES = 2**30
"""Number of bytes of address space that is reserved for libraries.

560 MiB were measured while a kernel was compiled. Some libraries crash or hang if there is less.
"""
FILE_CACHE = 2**21
"""Number of bytes that HDF5 allocates to open a file, with a margin. It reads a null pointer if
there is less."""
CONTAINER = Path("/sys/fs/cgroup/memory.max")
"""File with the memory limit of a container."""


def machine_memory(processes: int = 1) -> int:
    """Return the memory in bytes for a scene.

    Parameters
    ----------
    processes
        Number of processes that share the machine.

    Notes
    -----
    16 GiB are assumed if the system does not report its memory.
    """
    limits = [min(_system_limits(), default=16 * 2**30) // processes]
    if (limit := address_limit()) is not None:
        limits.append(max(0, limit - LIBRARIES))
    return min(limits)


def refuse_little_memory() -> None:
    """Raise MemoryError if the limit on address space is too small for the libraries.

    If there is a limit, libraries are restricted to one thread, because each thread takes address
    space.
    """
    limit = address_limit()
    if limit is None:
        return
    if limit < LIBRARIES:
        raise MemoryError(
            f"the limit on address space (ulimit -v) is {limit / 2**20:.0f} MiB, and "
            f"{LIBRARIES / 2**20:.0f} are needed"
        )
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def refuse_no_file_cache() -> None:
    """Raise MemoryError if HDF5 could not allocate the memory to open a file."""
    bytes(FILE_CACHE)


def address_limit() -> int | None:
    """Return the limit on address space in bytes; None if there is none."""
    try:
        from resource import RLIM_INFINITY, RLIMIT_AS, getrlimit
    except ImportError:  # Windows has no module resource.
        return None
    limit, _ = getrlimit(RLIMIT_AS)
    return None if limit == RLIM_INFINITY else limit


def _system_limits() -> Iterator[int]:
    with suppress(AttributeError, OSError, ValueError):
        yield os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError):  # "max" means that there is no limit.
        yield int(CONTAINER.read_text())
