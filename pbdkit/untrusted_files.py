"""Reading of untrusted files: in a separate process, after checks of their structure.

The seal of a result is its set of checksums. Files without a seal are read in a separate process
with limits on memory and time. Before an HDF5 file is read, its declared sizes and its references
are checked.

A file of some kilobytes can declare arrays of terabytes, refer to the bytes of other files, and
name filters that HDF5 loads as programs. Damaged bytes can crash the libraries or make them hang,
which does no harm in a separate process. A seal does not protect against malicious files, because
anyone can create one.
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


MAX_COMPRESSION_RATIO = 1100
"""Largest ratio of declared to stored bytes of a compressed variable.

The largest ratio of deflate is 1032.
"""
MAX_FILE_RATIO = 16
"""Largest ratio of the declared size of a variable to the size of the file.

It also limits variables of which parts have not been written.
"""
EMPTY = 2**20
"""Number of bytes that a variable may declare in a file of any size."""
MAX_CHUNK_BYTES = 2**26
"""Number of bytes that a chunk may declare in a file of any size."""
MAX_OBJECTS = 10_000
"""Maximum number of objects in a file, of links in a file, and of attributes of an object."""
MAX_TEXT_BLOCK_BYTES = 2**28
"""Maximum number of bytes of a block of texts that is checked."""
FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32"}
"""Filters of HDF5 that are applied; all others would be loaded as programs."""
NO_VARIABLE = b"This is a netCDF dimension but not a netCDF variable"
"""Beginning of the attribute NAME of datasets that are only dimensions and have no values."""


def check_declared(content: h5py.File, size: int) -> None:
    """Check the declarations of an open file of `size` bytes, and that all data is in the file.

    Raises
    ------
    StorageError
        For links to other files, external storage, virtual datasets, cyclic groups, filters other
        than `FILTERS`, and for variables, attributes and texts larger than a file of that size can
        hold. The message does not contain the name of the file.
    """
    from h5py import h5a, h5d, h5g, h5l, h5o

    links: list[tuple[bytes, bool]] = []
    objects = [b"."]

    # h5py ends a visit if the function returns a value; it does not support exceptions in it.
    def note_link(name: bytes, info: Any) -> bool | None:
        links.append((name, info.type == h5l.TYPE_HARD))
        return len(links) > MAX_OBJECTS or None

    def note_object(name: bytes, info: Any) -> bool | None:
        objects.append(name)
        return len(objects) > MAX_OBJECTS or None

    if content.id.links.visit(note_link, info=True) or h5o.visit(
        content.id, note_object, info=True
    ):
        raise StorageError(f"it contains more than {MAX_OBJECTS} objects")
    for name, is_hard in links:
        if not is_hard:
            raise StorageError(f"its link '{_text(name)}' is not a hard link; {_REMEDY}")
    for name in objects:
        item = h5o.open(content.id, name)
        if (count := h5a.get_num_attrs(item)) > MAX_OBJECTS:
            raise StorageError(f"'{_text(name)}' has {count} attributes")
        for n in range(count):
            _check_attribute(h5a.open(item, index=n), size)
        if isinstance(item, h5g.GroupID) and h5o.get_info(item).rc > 1:
            raise StorageError(f"its group '{_text(name)}' belongs to several groups; {_REMEDY}")
        if isinstance(item, h5d.DatasetID):
            _check_dataset(item, _text(name), size)


_REMEDY = "copy the data into one netCDF-4 file, for instance by xarray: open_dataset, to_netcdf"
"""Remedy for files that are not accepted."""


def _text(name: bytes) -> str:
    return name.decode(errors="replace")[:80]


def _check_attribute(attribute: Any, size: int) -> None:
    """Refuse attributes with many elements of variable length, which may all refer to one large
    text."""
    if _is_ragged(attribute.get_type()):
        count = math.prod(attribute.shape or ())
        if count > max(64, MAX_TEXT_BLOCK_BYTES // size):
            raise StorageError(f"its attribute '{_text(attribute.name)}' has {count} elements")


def _is_ragged(kind: Any) -> bool:
    from h5py import h5t

    variable = isinstance(kind, h5t.TypeStringID) and kind.is_variable_str()
    return bool(variable or kind.detect_class(h5t.VLEN))


def _check_dataset(dataset: Any, name: str, size: int) -> None:
    from h5py import h5d, h5ds

    properties, kind = dataset.get_create_plist(), dataset.get_type()
    if properties.get_layout() == h5d.VIRTUAL or properties.get_external_count():
        raise StorageError(f"the values of its variable '{name}' are in other files; {_REMEDY}")
    for n in range(properties.get_nfilters()):
        number, *_, word = properties.get_filter(n)
        if number not in FILTERS:
            raise StorageError(
                f"its variable '{name}' is stored by the filter {number} ({_text(word)}); "
                f"pbdkit applies {', '.join(FILTERS.values())}: write it again with one of these"
            )
    if _is_dimension_only(dataset):
        return
    shape, stored = dataset.shape or (), dataset.get_storage_size()
    declared = math.prod(shape) * kind.get_size()
    if declared > max(MAX_COMPRESSION_RATIO * stored, MAX_FILE_RATIO * size) + EMPTY:
        raise StorageError(
            f"its size is too small for the {declared:.3g} bytes that '{name}' declares"
        )
    if properties.get_layout() == h5d.CHUNKED:
        chunk = math.prod(properties.get_chunk()) * kind.get_size()
        if chunk > MAX_COMPRESSION_RATIO * stored + MAX_CHUNK_BYTES:
            raise StorageError(
                f"its size is too small for the chunks of {chunk:.3g} bytes of '{name}'"
            )
    if h5ds.is_scale(dataset) and declared > machine_memory() // 4:
        raise StorageError(f"'{name}' declares {declared:.3g} bytes, more than fit into memory")
    if _is_ragged(kind):
        _check_texts(dataset, name, size)


def _is_dimension_only(dataset: Any) -> bool:
    from h5py import h5a

    if not h5a.exists(dataset, b"NAME"):
        return False
    import h5py

    name = h5py.Dataset(dataset).attrs["NAME"]
    return isinstance(name, bytes) and name.startswith(NO_VARIABLE)


def _check_texts(dataset: Any, name: str, size: int) -> None:
    """Read texts of variable length in blocks, to test that they are not larger than the file."""
    import h5py

    texts, total = h5py.Dataset(dataset), 0
    if h5py.check_string_dtype(texts.dtype) is None:
        raise StorageError(f"its variable '{name}' has values of variable length")
    for block in _blocks(texts, size):
        total += sum(map(len, block.ravel()))
        if total > size:
            raise StorageError(f"its size is too small for the texts that '{name}' declares")


def _blocks(texts: Any, size: int) -> Iterator[Any]:
    if not texts.shape or not texts.size:
        return
    row_size = size * math.prod(texts.shape[1:])
    step = max(1, MAX_TEXT_BLOCK_BYTES // row_size)
    for start in range(0, len(texts), step):
        yield texts[start : start + step]


MODULE = "netCDF4"
"""Module that reads files without a seal."""
ENGINE = "NetCDF4BackendEntrypoint"
"""Class by which xarray uses this module. With its name instead of the class, xarray would search
all distributions, and stop at one with damaged metadata."""
BEGINNINGS = (b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"CDF\x02", b"CDF\x05")
"""First bytes of netCDF files: HDF5 and the classic formats."""
PATIENCE_S = 10.0
"""Time limit in seconds for reading one piece."""
PIECE = 2**26
"""Number of bytes that are read at once. At least one entry along the first dimension is read."""
FAULT = 9
"""Exit status of a child process that has printed a fault."""


def refuse_no_result(path: Path) -> None:
    """Raise StorageError if the first bytes of a file are not those of a netCDF file.

    An OSError is raised if the file cannot be read.
    """
    with path.open("rb") as file:
        if not file.read(8).startswith(BEGINNINGS):
            raise StorageError(
                f"{path}: is not a result of pbdkit: its first bytes are not those of netCDF"
            )


def try_reading(path: Path) -> None:
    """Raise StorageError if a file cannot be read as a netCDF file in a separate process.

    Reading can fail, crash the process, or exceed the time limit.
    """
    refuse_no_result(path)
    read_apart(path)


def read_apart(path: Path, *arguments: str) -> bytes:
    """Return the output of this module when it reads a file in a separate process; see `answer`.

    Raises
    ------
    StorageError
        If reading fails, crashes or exceeds the time limit. The message names the file.
    """
    # The child process imports this module from the same place as this process.
    paths = os.pathsep.join([*filter(None, sys.path), str(Path(__file__).parents[1])])
    process = subprocess.run(
        [sys.executable, "-P", "-m", __name__, str(path.absolute()), *arguments],
        env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    if process.returncode == 0:
        return process.stdout
    if process.returncode == FAULT:
        raise StorageError(f"{path}: {process.stdout.decode(errors='replace').strip()}")
    messages = process.stderr.decode(errors="replace").strip().splitlines() or [""]
    ending = f"ends with status {process.returncode}: {messages[-1][:200]}"
    if messages[0].startswith("Timeout"):
        ending = f"does not end within {PATIENCE_S:g} s"
    elif process.returncode < 0:
        ending = f"ends by a signal: {signal.strsignal(-process.returncode)}"
    raise StorageError(f"{path}: is damaged, or was changed: the process that reads it {ending}")


def answer(read: Callable[..., None]) -> None:
    """Read the file in the process that `read_apart` starts, with bounds on memory and time.

    If there is a fault, print it and exit with `FAULT`.
    """
    _bound_memory()
    path, *arguments = sys.argv[1:]
    try:
        read(Path(path), *arguments)
    except StorageError as error:
        _exit_with(str(error))
    except Exception as error:
        text = getattr(error, "strerror", None) or str(error) or type(error).__name__
        _exit_with(f"cannot be read as netCDF-4: {text}")


def _exit_with(fault: str) -> None:
    print(" ".join(fault.split())[:500])
    sys.exit(FAULT)


def bound_time() -> None:
    """End this process with a traceback after `PATIENCE_S`, unless the function is called again."""
    faulthandler.dump_traceback_later(PATIENCE_S, exit=True)


def opened_unsealed(path: Path) -> xarray.Dataset:
    """Return the dataset in a file without a seal. Errors of the libraries are not converted."""
    import xarray

    # Times are numbers of steps and must not be decoded as dates.
    return xarray.open_dataset(path, engine=getattr(xarray.backends, ENGINE), decode_times=False)


def check_hdf5(path: Path) -> None:
    """Raise StorageError if an HDF5 file has declarations or references that are not acceptable."""
    if path.open("rb").read(4) != BEGINNINGS[0][:4]:
        return
    import h5py

    with h5py.File(path, "r") as content:
        check_declared(content, path.stat().st_size)


def _read(path: Path) -> None:
    """Read a whole file in blocks, with a time limit for each block."""
    library = import_module(MODULE)
    bound_time()
    check_hdf5(path)
    limit = MAX_COMPRESSION_RATIO * path.stat().st_size + EMPTY
    with library.Dataset(path) as file:
        for owner in (file, *file.variables.values()):
            for name in owner.ncattrs():
                owner.getncattr(name)
        for variable in file.variables.values():
            size = math.prod(variable.shape) * getattr(variable.dtype, "itemsize", 1)
            if size > limit:
                raise StorageError(
                    f"its size is too small for the {size:.3g} bytes that it declares"
                )
            entries = variable.shape[0] if variable.ndim else 1
            rows = max(1, PIECE * entries // max(1, size))
            for first in range(0, entries, rows):
                _ = variable[first : first + rows] if variable.ndim else variable[()]
                bound_time()


def _bound_memory() -> None:
    """Limit the memory of this process to half of the machine's, if the system supports it."""
    with suppress(ImportError, ValueError, OSError):
        from resource import RLIMIT_AS, RLIMIT_CORE, setrlimit

        setrlimit(RLIMIT_CORE, (0, 0))
        setrlimit(RLIMIT_AS, (machine_memory() // 2 + LIBRARIES,) * 2)


VALUES = "values"
"""Name of the values in the output."""
MAX_SHOWN = 10
"""Maximum number of names in a message."""
PACKING = ("_FillValue", "missing_value", "scale_factor", "add_offset", "_Unsigned")
"""Attributes that change the meaning of stored numbers (CF conventions)."""


def _print(path: Path, variable: str, most_values: str) -> None:
    """Print a variable over (x, y) and its coordinates, as stored, as an npz archive.

    Raises
    ------
    StorageError
        If it is no field. The message does not contain the name of the file.
    """
    import h5netcdf
    import h5py

    bound_time()
    if not h5py.is_hdf5(path):
        raise StorageError(
            "is not a netCDF-4 file; xarray writes one: dataset.to_netcdf(NAME, engine='h5netcdf')"
        )
    with h5py.File(path, "r") as content:
        check_declared(content, path.stat().st_size)
        with h5netcdf.File(content, "r") as file:
            field = _field(file, variable, int(most_values))
            variables = {VALUES: field, "x": file["x"], "y": file["y"]}
            arrays = {name: stored[...] for name, stored in variables.items()}
            if field.dimensions == ("y", "x"):
                arrays[VALUES] = arrays[VALUES].T
            for name, stored in variables.items():
                attributes = {key: stored.attrs[key] for key in PACKING if key in stored.attrs}
                arrays |= {f"{name}.{key}": np.asarray(value) for key, value in attributes.items()}
    np.savez(sys.stdout.buffer, **arrays)


def _field(file: Any, variable: str, most_values: int) -> Any:
    if variable not in file.variables:
        names = ", ".join(islice(file.variables, MAX_SHOWN)) or "none"
        raise StorageError(f"has no variable '{variable}'; it has: {names}")
    field = file.variables[variable]
    if {*field.dimensions} != {"x", "y"} or not {"x", "y"} <= {*file.variables}:
        raise StorageError(
            f"'{variable}' should have the dimensions x and y with their coordinates, got "
            f"{', '.join(field.dimensions) or 'nothing'}"
        )
    if (count := math.prod(field.shape)) > most_values:
        raise StorageError(f"'{variable}' has {count} values, more than {most_values}")
    for name in (variable, "x", "y"):
        if file.variables[name].dtype.kind not in "fiu":
            raise StorageError(
                f"'{name}' has the type {file.variables[name].dtype}; expected numbers"
            )
    for name in ("x", "y"):
        if file.variables[name].dimensions != (name,):
            raise StorageError(
                f"'{name}' should be a coordinate: numbers with the dimension {name} only"
            )
    return field


if __name__ == "__main__":
    answer(_print if len(sys.argv) > 2 else _read)
