"""A field of a parameter in a netCDF file: a variable over x and y."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pbdkit.interfaces.component import did_you_mean
from pbdkit.interfaces.varying import MOST_VALUES, Gridded

MOST_BYTES = 2**30


class FieldFileError(ValueError):
    """A field file that is not there, cannot be read, or holds no field; the text names it."""


def read_field(given: dict[str, Any], folder: Path) -> Gridded:
    """What ``{file: NAME, variable: NAME}`` says, the file relative to a folder.

    Raises FieldFileError where the file or the variable is not there, or no numbers over x and y.
    """
    if given.keys() != {"file", "variable"}:
        raise ValueError(f"a field from a file has file and variable, got {', '.join(given)}")
    name, variable = given["file"], given["variable"]
    if not isinstance(name, str) or not isinstance(variable, str):
        raise ValueError("file and variable should be words")
    path = folder / name
    if not path.is_file():
        what = "is no regular file" if path.exists() else "is not there"
        raise ValueError(f"{path} {what}; its place counts from the experiment's file")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path} is larger than 1 GiB")
    import h5py
    import xarray

    try:
        with h5py.File(path, "r") as file:
            # h5netcdf reads this first, and a file of its own that fails there cannot be closed.
            file.attrs.get("_nc3_strict")
        with xarray.open_dataset(path, engine="h5netcdf") as dataset:
            return _gridded(dataset, variable, path)
    except FieldFileError:
        raise
    except Exception as error:  # whatever the libraries below make of a damaged file
        told = " ".join(str(error).split())
        raise FieldFileError(f"{path} cannot be read as netCDF-4: {told}") from None


def _gridded(dataset: Any, variable: str, path: Path) -> Gridded:
    if variable not in dataset:
        hint = did_you_mean(variable, dataset)
        raise FieldFileError(f"{path} has no variable '{variable}'{hint}")
    values = dataset[variable]
    if set(values.dims) != {"x", "y"} or not {"x", "y"} <= set(values.coords):
        raise FieldFileError(
            f"{path}: '{variable}' should be over x and y, with a coordinate for each; it is over "
            f"{', '.join(map(str, values.dims)) or 'nothing'}"
        )
    if values.size > MOST_VALUES:
        count = f"{values.size} values, more than {MOST_VALUES}"
        raise FieldFileError(f"{path}: '{variable}' has {count}")
    if values.dtype.kind not in "fiu":
        raise FieldFileError(f"{path}: '{variable}' holds {values.dtype}, not numbers")
    try:
        return Gridded(values["x"], values["y"], values.transpose("x", "y"))
    except ValueError as error:
        raise FieldFileError(f"{path}: '{variable}': {error}") from None
