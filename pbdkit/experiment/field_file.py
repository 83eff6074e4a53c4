"""A field of a parameter in a netCDF file: a variable over x and y."""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.errors import StorageError
from pbdkit.experiment.beside import Beside
from pbdkit.interfaces.varying import MOST_VALUES, Gridded
from pbdkit.registry.blame import one_line
from pbdkit.resources.field_variable import VALUES
from pbdkit.resources.trial import read_apart

MOST_BYTES = 2**30
MODULE = "pbdkit.resources.field_variable"
"""Reads the variable, in a process of its own."""
LONGEST_NAME = 200
"""Maximum number of characters in the name of a variable."""


class FieldFileError(ValueError):
    """A field file that is not there, cannot be read, or holds no field; the text names it."""


def read_field(given: dict[str, Any], files: Beside) -> Gridded:
    """Return what ``{file: NAME, variable: NAME}`` says, the file among those that may be named.

    Raises ValueError where the file or the variable is not there, or no numbers over x and y.
    """
    if given.keys() != {"file", "variable"}:
        raise ValueError(f"a field from a file has file and variable, got {', '.join(given)}")
    path, variable = files.path(given["file"], "netCDF"), given["variable"]
    if not isinstance(variable, str) or not variable.isprintable() or len(variable) > LONGEST_NAME:
        raise ValueError(f"variable should be the name of one in {path}")
    about = path.stat()
    if about.st_size > MOST_BYTES:
        raise ValueError(f"{path} is larger than 1 GiB")
    return _read(path, variable, about.st_size, about.st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: Path, variable: str, size: int, changed_ns: int) -> Gridded:
    """The field in a file of that size and time of change: members of a sweep read the same."""
    try:
        read = read_apart(MODULE, path, variable, str(MOST_VALUES))
    except StorageError as error:
        raise FieldFileError(str(error)) from None
    try:
        with np.load(io.BytesIO(read)) as arrays:
            x, y, values = (_decoded(name, arrays) for name in ("x", "y", VALUES))
        return Gridded(x, y, values)
    except MemoryError:
        raise
    except Exception as error:  # attributes that make no sense, in words of other libraries
        raise FieldFileError(f"{path}: '{variable}': {one_line(str(error))}") from None


def _decoded(name: str, arrays: Any) -> Any:
    """The numbers of an array, unpacked and masked as its attributes demand."""
    from xarray import Variable
    from xarray.conventions import decode_cf_variable

    begin = f"{name}."
    keys = [key for key in arrays if key.startswith(begin)]
    attributes = {key.removeprefix(begin): arrays[key][()] for key in keys}
    if not attributes:
        return arrays[name]
    dims = [f"d{n}" for n in range(arrays[name].ndim)]
    stored = Variable(dims, arrays[name], attributes)
    return decode_cf_variable(name, stored, decode_times=False).values
