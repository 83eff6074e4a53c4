"""Files without seal are first read in a process of their own.

On bytes that were changed the libraries that read files can crash the process or come to no end.
Here they do so where nothing is lost.
"""

from __future__ import annotations

import faulthandler
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pbdkit.errors import StorageError
from pbdkit.resources.declared import DENSEST, EMPTY, check_declared
from pbdkit.resources.memory import LIBRARIES, machine_memory

if TYPE_CHECKING:
    import xarray

MODULE, ENGINE = "netCDF4", "NetCDF4BackendEntrypoint"
"""What reads files without seal: the module, which the trial asks as it is loaded sooner, and the
class by which xarray asks the same. By their names xarray would go through all distributions, and
stop at one whose metadata are torn."""
BEGINNINGS = (b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"CDF\x02", b"CDF\x05")
"""Of netCDF files of any kind."""
PATIENCE_S = 10.0
"""In so many seconds a piece is read, or never."""
PIECE = 2**26
"""Bytes read at once, if an entry along the first dimension is not larger."""
FAULT = 9
"""The exit status of a child that found one and printed it."""


def refuse_no_result(path: Path) -> None:
    """Raises StorageError where a file does not even begin as netCDF files do, and OSError."""
    with path.open("rb") as file:
        if not file.read(8).startswith(BEGINNINGS):
            raise StorageError(f"{path}: is no result of pbdkit: it begins as no netCDF file does")


def try_reading(path: Path) -> None:
    """Raises StorageError where the file is no netCDF file, or reading it fails, crashes or comes
    to no end."""
    refuse_no_result(path)
    read_apart(__name__, path)


def read_apart(module: str, path: Path, *arguments: str) -> bytes:
    """Return what a module prints that reads a file in a process of its own; see `answer`.

    Raises StorageError, which names the file, where that fails, crashes or comes to no end.
    """
    # What is imported here is imported there, from wherever either runs.
    paths = os.pathsep.join([*filter(None, sys.path), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, "-P", "-m", module, str(path.absolute()), *arguments],
        env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    if done.returncode == 0:
        return done.stdout
    if done.returncode == FAULT:
        raise StorageError(f"{path}: {done.stdout.decode(errors='replace').strip()}")
    told = done.stderr.decode(errors="replace").strip().splitlines() or [""]
    how = f"ends its process (status {done.returncode}: {told[-1][:200]})"
    if told[0].startswith("Timeout"):
        how = f"comes to no end ({PATIENCE_S:g} s)"
    elif done.returncode < 0:
        how = f"ends its process ({signal.strsignal(-done.returncode)})"
    raise StorageError(f"{path}: is damaged, or was changed: to read it {how}")


def answer(read: Callable[..., None]) -> None:
    """In the process that `read_apart` starts, read the file with bounds on memory and time.

    Exits with FAULT, and prints what is wrong, where something is.
    """
    _bound_memory()
    path, *arguments = sys.argv[1:]
    try:
        read(Path(path), *arguments)
    except StorageError as error:
        _exit_with(str(error))
    except Exception as error:
        told = getattr(error, "strerror", None) or str(error) or type(error).__name__
        _exit_with(f"cannot be read as netCDF-4: {told}")


def _exit_with(fault: str) -> None:
    print(" ".join(fault.split())[:500])
    sys.exit(FAULT)


def bound_time() -> None:
    """End this process with a traceback unless this is called again within the patience."""
    faulthandler.dump_traceback_later(PATIENCE_S, exit=True)


def opened_unsealed(path: Path) -> xarray.Dataset:
    """The dataset in a file without seal, as it is. Raises whatever the libraries do."""
    import xarray

    # Times are steps: nothing is to be decoded as a date.
    return xarray.open_dataset(path, engine=getattr(xarray.backends, ENGINE), decode_times=False)


def check_hdf5(path: Path) -> None:
    """Raises StorageError where an HDF5 file declares or refers to what it should not."""
    if path.open("rb").read(4) != BEGINNINGS[0][:4]:
        return
    import h5py

    with h5py.File(path, "r") as content:
        check_declared(content, path.stat().st_size)


def _read(path: Path) -> None:
    """Reads all of it, a piece at a time, and ends the process where a piece takes too long."""
    library = import_module(MODULE)
    bound_time()
    check_hdf5(path)
    limit = DENSEST * path.stat().st_size + EMPTY
    with library.Dataset(path) as file:
        for owner in (file, *file.variables.values()):
            for name in owner.ncattrs():
                owner.getncattr(name)
        for variable in file.variables.values():
            size = math.prod(variable.shape) * getattr(variable.dtype, "itemsize", 1)
            if size > limit:
                raise StorageError(f"it cannot hold the {size:.3g} bytes that it declares")
            entries = variable.shape[0] if variable.ndim else 1
            each = max(1, PIECE * entries // max(1, size))
            for first in range(0, entries, each):
                _ = variable[first : first + each] if variable.ndim else variable[()]
                bound_time()


def _bound_memory() -> None:
    """To half of the machine's, where the system can."""
    with suppress(ImportError, ValueError, OSError):
        from resource import RLIMIT_AS, RLIMIT_CORE, setrlimit

        setrlimit(RLIMIT_CORE, (0, 0))
        setrlimit(RLIMIT_AS, (machine_memory() // 2 + LIBRARIES,) * 2)


if __name__ == "__main__":
    answer(_read)
