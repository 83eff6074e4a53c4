"""Reads a variable over x and y of a netCDF file, in a process of its own."""

from __future__ import annotations

import math
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.errors import StorageError
from pbdkit.resources.declared import check_declared
from pbdkit.resources.trial import answer, bound_time

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
    answer(_print)
