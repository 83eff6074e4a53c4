"""Reading of files without a seal in a separate process, with bounds on memory, time, and on what
an HDF5 file declares and refers to.

A file of some kilobytes can declare arrays of terabytes, refer to the bytes of other files, and
name filters that HDF5 loads as programs; on changed bytes the libraries can crash the process or
loop. There nothing is lost. A seal is no protection: anyone can make one.
"""

from __future__ import annotations

import faulthandler
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import StorageError
from pbdkit.memory import LIBRARIES, machine_memory

if TYPE_CHECKING:
    import h5py
    import xarray


DENSEST = 1100
"""Largest ratio of declared to stored bytes of a compressed variable (deflate: 1032)."""
SPARSEST = 16
"""Largest ratio of the bytes that a variable declares, written or not, to those of the file."""
EMPTY = 2**20
"""Bytes that a variable may declare whatever is stored."""
LARGEST_CHUNK = 2**26
"""Bytes of a chunk that are taken whatever is stored."""
MOST_OBJECTS = 10_000
"""Maximum number of objects and of links in a file, and of attributes of each."""
LARGEST_TEXTS = 2**28
"""Bytes that a block of texts can take when it is looked at."""
FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32"}
"""The filters of HDF5 that are applied; others would be loaded as programs."""
NO_VARIABLE = b"This is a netCDF dimension but not a netCDF variable"
"""Begins the attribute NAME of datasets that are dimensions only, whose values nobody reads."""


def check_declared(content: h5py.File, size: int) -> None:
    """Check what an open file of `size` bytes declares, and that all of it is in the file.

    Raises StorageError, without the name of the file, for links that lead elsewhere, external
    storage, virtual datasets, groups in a circle, filters other than `FILTERS`, and for variables,
    attributes and texts larger than a file of that size can hold.
    """
    from h5py import h5a, h5d, h5g, h5l, h5o

    links: list[tuple[bytes, bool]] = []
    objects = [b"."]

    # h5py ends a visit where something is returned; it does not bear exceptions there.
    def note_link(name: bytes, info: Any) -> bool | None:
        links.append((name, info.type == h5l.TYPE_HARD))
        return len(links) > MOST_OBJECTS or None

    def note_object(name: bytes, info: Any) -> bool | None:
        objects.append(name)
        return len(objects) > MOST_OBJECTS or None

    if content.id.links.visit(note_link, info=True) or h5o.visit(
        content.id, note_object, info=True
    ):
        raise StorageError(f"it holds more than {MOST_OBJECTS} objects")
    for name, is_hard in links:
        if not is_hard:
            raise StorageError(f"its link '{_text(name)}' leads elsewhere; {_REMEDY}")
    for name in objects:
        found = h5o.open(content.id, name)
        if (count := h5a.get_num_attrs(found)) > MOST_OBJECTS:
            raise StorageError(f"'{_text(name)}' has {count} attributes")
        for n in range(count):
            _check_attribute(h5a.open(found, index=n), size)
        if isinstance(found, h5g.GroupID) and h5o.get_info(found).rc > 1:
            raise StorageError(f"its group '{_text(name)}' lies in several groups; {_REMEDY}")
        if isinstance(found, h5d.DatasetID):
            _check_dataset(found, _text(name), size)


_REMEDY = "copy the data into one netCDF-4 file, for instance by xarray: open_dataset, to_netcdf"


def _text(name: bytes) -> str:
    return name.decode(errors="replace")[:80]


def _check_attribute(attribute: Any, size: int) -> None:
    """Elements of variable length may all be the same large one."""
    if _is_ragged(attribute.get_type()):
        count = math.prod(attribute.shape or ())
        if count > max(64, LARGEST_TEXTS // size):
            raise StorageError(f"its attribute '{_text(attribute.name)}' has {count} parts")


def _is_ragged(kind: Any) -> bool:
    from h5py import h5t

    variable = isinstance(kind, h5t.TypeStringID) and kind.is_variable_str()
    return bool(variable or kind.detect_class(h5t.VLEN))


def _check_dataset(dataset: Any, name: str, size: int) -> None:
    from h5py import h5d, h5ds

    created, kind = dataset.get_create_plist(), dataset.get_type()
    if created.get_layout() == h5d.VIRTUAL or created.get_external_count():
        raise StorageError(f"the values of its variable '{name}' lie in other files; {_REMEDY}")
    for n in range(created.get_nfilters()):
        number, *_, word = created.get_filter(n)
        if number not in FILTERS:
            raise StorageError(
                f"its variable '{name}' is stored by the filter {number} ({_text(word)}); "
                f"pbdkit applies {', '.join(FILTERS.values())}: write it anew with these"
            )
    if _is_dimension_only(dataset):
        return
    shape, stored = dataset.shape or (), dataset.get_storage_size()
    declared = math.prod(shape) * kind.get_size()
    if declared > max(DENSEST * stored, SPARSEST * size) + EMPTY:
        raise StorageError(f"it cannot hold the {declared:.3g} bytes that '{name}' declares")
    if created.get_layout() == h5d.CHUNKED:
        chunk = math.prod(created.get_chunk()) * kind.get_size()
        if chunk > DENSEST * stored + LARGEST_CHUNK:
            raise StorageError(f"it cannot hold the chunks of {chunk:.3g} bytes of '{name}'")
    if h5ds.is_scale(dataset) and declared > machine_memory() // 4:
        raise StorageError(f"'{name}' declares {declared:.3g} bytes, more than fit into memory")
    if _is_ragged(kind):
        _check_texts(dataset, name, size)


def _is_dimension_only(dataset: Any) -> bool:
    from h5py import h5a

    if not h5a.exists(dataset, b"NAME"):
        return False
    import h5py

    said = h5py.Dataset(dataset).attrs["NAME"]
    return isinstance(said, bytes) and said.startswith(NO_VARIABLE)


def _check_texts(dataset: Any, name: str, size: int) -> None:
    """Read texts of variable length, some at a time: together they are in the file, once each."""
    import h5py

    texts, total = h5py.Dataset(dataset), 0
    if h5py.check_string_dtype(texts.dtype) is None:
        raise StorageError(f"its variable '{name}' holds values of variable length")
    for block in _blocks(texts, size):
        total += sum(map(len, block.ravel()))
        if total > size:
            raise StorageError(f"it cannot hold the texts that '{name}' declares")


def _blocks(texts: Any, size: int) -> Iterator[Any]:
    if not texts.shape or not texts.size:
        return
    each = size * math.prod(texts.shape[1:])
    step = max(1, LARGEST_TEXTS // each)
    for start in range(0, len(texts), step):
        yield texts[start : start + step]


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
    read_apart(path)


def read_apart(path: Path, *arguments: str) -> bytes:
    """Return what a module prints that reads a file in a process of its own; see `answer`.

    Raises StorageError, which names the file, where that fails, crashes or comes to no end.
    """
    # What is imported here is imported there, from wherever either runs.
    paths = os.pathsep.join([*filter(None, sys.path), str(Path(__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-P", "-m", __name__, str(path.absolute()), *arguments],
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


VALUES = "values"
"""The name under which the values are printed."""
SHOWN = 10
"""Maximum number of names in a message."""
PACKING = ("_FillValue", "missing_value", "scale_factor", "add_offset", "_Unsigned")
"""Attributes that change what stored numbers mean (CF conventions)."""


def _print(path: Path, variable: str, most_values: str) -> None:
    """Print the variable, (x, y), and its coordinates as they are stored, as an npz archive.

    Raises StorageError, without the name of the file, for what is no field.
    """
    import h5netcdf
    import h5py

    bound_time()
    if not h5py.is_hdf5(path):
        raise StorageError(
            "is no netCDF-4 file; xarray writes one: dataset.to_netcdf(NAME, engine='h5netcdf')"
        )
    with h5py.File(path, "r") as content:
        check_declared(content, path.stat().st_size)
        with h5netcdf.File(content, "r") as file:
            field = _field(file, variable, int(most_values))
            found = {VALUES: field, "x": file["x"], "y": file["y"]}
            arrays = {name: each[...] for name, each in found.items()}
            if field.dimensions == ("y", "x"):
                arrays[VALUES] = arrays[VALUES].T
            for name, each in found.items():
                known = {key: each.attrs[key] for key in PACKING if key in each.attrs}
                arrays |= {f"{name}.{key}": np.asarray(value) for key, value in known.items()}
    np.savez(sys.stdout.buffer, **arrays)


def _field(file: Any, variable: str, most_values: int) -> Any:
    if variable not in file.variables:
        names = ", ".join(islice(file.variables, SHOWN)) or "none"
        raise StorageError(f"has no variable '{variable}'; it has: {names}")
    found = file.variables[variable]
    if {*found.dimensions} != {"x", "y"} or not {"x", "y"} <= {*file.variables}:
        raise StorageError(
            f"'{variable}' should be over x and y, with a coordinate for each; it is over "
            f"{', '.join(found.dimensions) or 'nothing'}"
        )
    if (count := math.prod(found.shape)) > most_values:
        raise StorageError(f"'{variable}' has {count} values, more than {most_values}")
    for name in (variable, "x", "y"):
        if file.variables[name].dtype.kind not in "fiu":
            raise StorageError(f"'{name}' holds {file.variables[name].dtype}, not numbers")
    for name in ("x", "y"):
        if file.variables[name].dimensions != (name,):
            raise StorageError(f"'{name}' should be a coordinate: numbers over {name} alone")
    return found


if __name__ == "__main__":
    answer(_print if len(sys.argv) > 2 else _read)
