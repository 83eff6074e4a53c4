"""A trial of a file without seal: read once, from end to end, in a process of its own.

On bytes that were changed the libraries that read files can crash the process or come to no end.
Here they do so where nothing is lost, and what passes is then opened.
"""

from __future__ import annotations

import faulthandler
import math
import os
import signal
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pbdkit.errors import StorageError
from pbdkit.scene.memory import LIBRARIES, machine_memory

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
DENSEST, EMPTY = 1100, 2**20
"""So many times as large as a file can what it holds be, compressed (deflate: 1032), and as large
as this anyway."""
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
    # What is imported here is imported there, from wherever either runs.
    paths = os.pathsep.join([*filter(None, sys.path), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, "-P", "-m", "pbdkit.results.trial", str(path.absolute())],
        env=os.environ | {"PYTHONPATH": paths},
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    if done.returncode == 0:
        return
    if done.returncode == FAULT:
        raise StorageError(f"{path}: cannot be read as netCDF-4: {done.stdout.decode().strip()}")
    told = done.stderr.decode(errors="replace").strip().splitlines() or [""]
    how = f"ends its process (status {done.returncode}: {told[-1][:200]})"
    if told[0].startswith("Timeout"):
        how = f"comes to no end ({PATIENCE_S:g} s)"
    elif done.returncode < 0:
        how = f"ends its process ({signal.strsignal(-done.returncode)})"
    raise StorageError(f"{path}: is damaged, or was changed: to read it {how}")


def opened_unsealed(path: Path) -> xarray.Dataset:
    """The dataset in a file without seal, as it is. Raises whatever the libraries do."""
    import xarray

    # Times are steps: nothing is to be decoded as a date.
    return xarray.open_dataset(path, engine=getattr(xarray.backends, ENGINE), decode_times=False)


def _read(path: Path) -> None:
    """Reads all of it, a piece at a time, and ends the process where a piece takes too long."""
    faulthandler.dump_traceback_later(PATIENCE_S, exit=True)
    limit = DENSEST * path.stat().st_size + EMPTY
    with import_module(MODULE).Dataset(path) as file:
        for owner in (file, *file.variables.values()):
            for name in owner.ncattrs():
                owner.getncattr(name)
        for variable in file.variables.values():
            size = math.prod(variable.shape) * getattr(variable.dtype, "itemsize", 1)
            if size > limit:
                raise ValueError(f"it cannot hold the {size:.3g} bytes that it declares")
            entries = variable.shape[0] if variable.ndim else 1
            each = max(1, PIECE * entries // max(1, size))
            for first in range(0, entries, each):
                _ = variable[first : first + each] if variable.ndim else variable[()]
                faulthandler.dump_traceback_later(PATIENCE_S, exit=True)


def _bound_memory() -> None:
    """To half of the machine's, where the system can."""
    with suppress(ImportError, ValueError, OSError):
        from resource import RLIMIT_AS, RLIMIT_CORE, setrlimit

        setrlimit(RLIMIT_CORE, (0, 0))
        setrlimit(RLIMIT_AS, (machine_memory() // 2 + LIBRARIES,) * 2)


def main() -> None:
    """The child: exits with FAULT, and prints what is wrong, where something is."""
    _bound_memory()
    try:
        _read(Path(sys.argv[1]))
    except Exception as error:
        told = getattr(error, "strerror", None) or str(error) or type(error).__name__
        print(" ".join(str(told).split())[:500])
        sys.exit(FAULT)


if __name__ == "__main__":
    main()
