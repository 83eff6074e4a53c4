"""The memory that this process may use: of the machine, of a container, under a limit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

LIBRARIES = 2**30
"""Bytes of address space for the libraries that are loaded (measured: 560 MiB with a kernel
compiled anew). Some of them end the process, or never end, where they get none."""
CONTAINER = Path("/sys/fs/cgroup/memory.max")


def machine_memory(processes: int = 1) -> int:
    """Bytes for a scene, where so many processes share the machine; what cannot be asked is taken
    as 16 GiB."""
    found = [min(_of_all(), default=16 * 2**30) // processes]
    if (limit := address_limit()) is not None:
        found.append(max(0, limit - LIBRARIES))
    return min(found)


def refuse_little_memory() -> None:
    """Raises MemoryError where the limit on address space leaves too little for the libraries;
    where it is enough they take one thread, as each maps some more."""
    limit = address_limit()
    if limit is None:
        return
    if limit < LIBRARIES:
        raise MemoryError(
            f"the limit on address space (ulimit -v) is {limit / 2**20:.0f} MiB, and "
            f"{LIBRARIES / 2**20:.0f} are needed"
        )
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def address_limit() -> int | None:
    """Bytes of address space that the process may map; None where there is no limit."""
    try:
        from resource import RLIM_INFINITY, RLIMIT_AS, getrlimit
    except ImportError:  # not on every system
        return None
    limit, _ = getrlimit(RLIMIT_AS)
    return None if limit == RLIM_INFINITY else limit


def _of_all() -> Iterator[int]:
    with suppress(AttributeError, OSError, ValueError):
        yield os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError):  # "max": no bound
        yield int(CONTAINER.read_text())
