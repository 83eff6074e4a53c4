"""Write datasets as sealed result files, and check before a computation that the name of the result
file is free."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from pbdkit.errors import ExperimentError
from pbdkit.io.atomic_file import kind_of, open_atomic
from pbdkit.io.open import fault_of
from pbdkit.io.paged_file import PagedFile
from pbdkit.io.run_store import make_room

if TYPE_CHECKING:
    import xarray


def save(dataset: xarray.Dataset, path: str | Path, *, force: bool = False) -> Path:
    """Write a dataset as a result file with checksums, as `run` does.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of a run or a sweep.
    path : str or path
        File to write, usually with the extension ``.nc``. An incomplete file never appears.
    force : bool
        Replace an existing file.

    Returns
    -------
    Path
        Path of the file.

    Raises
    ------
    ExperimentError
        If the file exists, or the dataset lacks variables or attributes of a result.
    StorageError
        If the file cannot be written.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> ds.pbd.save("a.nc").name
    'a.nc'
    """
    file = Path(path)
    refuse_existing(file, force=force)
    if fault := fault_of(dataset):
        raise ExperimentError(
            f"save: the dataset {fault.partition(':')[0]}, which a result requires; use "
            "`to_netcdf` for a part of a result"
        )
    write_dataset(dataset, file, replace=force)
    return file


def write_dataset(dataset: xarray.Dataset, path: Path, *, replace: bool) -> None:
    """Write a dataset as a sealed file, which appears complete or not at all. Raises WriteError."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    from pbdkit.io.hdf5_file import Hdf5File

    plain = dataset.drop_encoding()
    for name, variable in dataset.variables.items():
        if variable.encoding.get("zlib"):
            plain[name].encoding["zlib"] = True
    with (
        open_atomic(path, PagedFile, replace=replace) as file,
        Hdf5File(file, "w", track_order=True) as content,
        h5netcdf.File(content, "w") as target,
    ):
        plain.dump_to_store(H5NetCDFStore(target, autoclose=False))


def refuse_existing(path: Path, *, force: bool) -> None:
    """Raise ExperimentError if a path cannot be written. This is so if the path exists and is not a
    plain file. Without `force` it is also so if an unfinished run or a file has that name."""
    try:
        kind = kind_of(path)
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be written: {error.strerror}") from None
    if kind:
        raise ExperimentError(f"{path}: is {kind}, which is not replaced; name another file")
    if os.path.lexists(path) and not force:
        raise ExperimentError(f"{path}: exists; force=True replaces it")
    if not make_room(path, discard=force):
        raise ExperimentError(
            f"{path}: this run is unfinished; pbdkit.resume({str(path)!r}) continues it, "
            "force=True discards it"
        )
