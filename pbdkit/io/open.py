"""Open results of finished and unfinished runs, and single members of sweeps. If a file is of
another kind, the error message contains the command that reads it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.errors import (
    ExperimentError,
    PbdkitError,
    StorageError,
    StorageWarning,
    WriteError,
    did_you_mean,
    one_line,
    reason_of,
    unreadable,
    warn_caller,
)
from pbdkit.io.layout import SCHEMA_VERSION, base_columns, in_this_layout, json_attribute
from pbdkit.io.members import SWEEP, choices, member
from pbdkit.io.other_files import refuse_other_file
from pbdkit.io.run_store import STORE, has_committed
from pbdkit.io.seal import BrokenSealError, SealedFile, open_sealed, seal_of
from pbdkit.untrusted_files import opened_unsealed, try_reading

if TYPE_CHECKING:
    import xarray


UNSEALED = "has no seal: changes since it was written cannot be detected"
"""Warning for a file without a seal."""
OF_PARTICLES = ("number", "reference", "role", "site", "i", "j", "X", "Y")
"""Coordinates of particles, which a sweep keeps with each variable of particles."""
MISSING_VARIABLE = re.compile(r"No variable named '(\w+)'")
"""Beginning of the message of xarray for a variable that a dataset does not contain."""


def open(path: str | Path) -> xarray.Dataset:
    """Open a result file.

    Values are read when they are used, and are verified with the checksums of the file. For an
    unfinished run the dataset of its last checkpoint is returned, with the status "interrupted".

    Parameters
    ----------
    path : str or path
        File of a run or a sweep.

    Returns
    -------
    xarray.Dataset
        Dataset of the file.

    Raises
    ------
    ExperimentError
        If the file is an experiment or the specification of a sweep.
    StorageError
        If the file does not exist, is no result of pbdkit, was changed or damaged, or was written
        by a newer version. Changes of values are detected when they are read.

    Warns
    -----
    StorageWarning
        If the file has no checksums. It is then first read in a separate process.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, output="a.nc", progress=False)
    >>> pbdkit.open("a.nc").attrs["status"]
    'complete'
    """
    if not isinstance(path, str | Path):
        raise ExperimentError(
            f"open: expected the path of a result, got an object of type {type(path).__name__}"
        )
    file = Path(path)
    unfinished = _output_of(file)
    if not unfinished:
        refuse_other_file(file)
        refuse_no_file(file)
    try:
        dataset = in_this_layout(_unfinished(unfinished) if unfinished else _opened(file))
    except (PbdkitError, MemoryError):
        raise
    except Exception as error:  # The libraries raise various errors for damaged files.
        if not unfinished:
            with SealedFile(file) as content:
                content.check()
        reason = reason_of(error) if isinstance(error, OSError) else error
        raise StorageError(f"{file}: cannot be read as netCDF-4: {reason}") from None
    if fault := fault_of(dataset):
        dataset.close()
        raise StorageError(f"{file}: {fault}")
    return dataset


def refuse_no_file(file: Path) -> None:
    """Raise StorageError if the path is not a plain file."""
    if file.is_dir():
        raise StorageError(f"{file}: is a folder, not a result of pbdkit")
    if not file.is_file():
        what = "is not a plain file, and not a result of pbdkit"
        if not file.exists():
            beside = sorted(path.stem for path in file.parent.glob("*.nc"))
            hint = did_you_mean(file.stem, beside).replace("'?", ".nc'?")
            what = f"there is no such file{hint}"
        raise StorageError(f"{file}: {what}")


def _opened(file: Path) -> xarray.Dataset:
    with file.open("rb", buffering=0) as start:
        sealed = seal_of(start) is not None
    if not sealed:
        try_reading(file)
        dataset = opened_unsealed(file)
        warn_caller(f"{file}: {UNSEALED}", StorageWarning)
        return dataset
    import xarray

    return _dataset(xarray.backends.CachingFileManager(open_sealed, file.absolute(), mode="r"))


def _dataset(content: Any) -> xarray.Dataset:
    import xarray
    from xarray.backends import StoreBackendEntrypoint

    # Times are numbers of steps, and xarray must not decode them as dates.
    store = xarray.backends.H5NetCDFStore(content)
    return xarray.open_dataset(store, engine=StoreBackendEntrypoint, decode_times=False)


def _unfinished(output: Path) -> xarray.Dataset:

    from pbdkit.io.unfinished import unfinished_dataset

    return _dataset(unfinished_dataset(output))


def _output_of(file: Path) -> Path | None:
    """Return the output of the unfinished run to which a path refers. The path may lead to the
    output or to the store."""
    if file.name.endswith(STORE) and file.is_file():
        return file.with_name(file.name.removesuffix(STORE))
    return file if not file.exists() and has_committed(file) else None


@contextmanager
def reading(
    path: str | Path, *, sweeps: bool = False, at: Mapping[str, str] | None = None
) -> Iterator[xarray.Dataset]:
    """Open the dataset of a run for reading in the block. With `sweeps` it may also be the dataset
    of a sweep.

    `at` selects a member of a sweep. Raises the errors of `open`. Also raises ExperimentError for a
    sweep from which no member is selected, unless `sweeps` is true. Errors of pbdkit in the block,
    such as a WriteError of another file, keep their type. Any other error in the block is raised as
    a StorageError: since files are correct when they are written, the error must be caused by
    damage, or by the disk if it is an error of the system.
    """
    with open(path) as whole:
        dataset = _chosen(whole, path, at) if at else whole
        if SWEEP in dataset.attrs and not sweeps:
            raise ExperimentError(
                f"{path}: contains all members of a sweep; select one with "
                f"--at NAME=VALUE, in Python with ds.pbd.member(NAME=VALUE) ({choices(dataset)})"
            )
        try:
            yield dataset
        except (BrokenSealError, WriteError):
            raise
        except (ExperimentError, StorageError) as error:
            raise type(error)(f"{path}: {'; '.join(str(error).splitlines())}") from None
        except (PbdkitError, MemoryError):
            raise
        except Exception as error:
            if name := _not_kept(error, whole):
                kept_with = "`position`" if name in OF_PARTICLES else "it"
                raise ExperimentError(
                    f"{path}: this requires `{name}`, which the sweep did not keep; add "
                    f"{kept_with} to keep.variables, and run the sweep again"
                ) from None
            if isinstance(error, OSError) and error.errno:
                raise unreadable(path, error) from None
            reason = f"{type(error).__name__}: {error}"
            raise StorageError(f"{path}: is damaged, or was changed: {one_line(reason)}") from error


def _not_kept(error: Exception, dataset: xarray.Dataset) -> str | None:
    """Return the name of the variable of a sweep that an error misses, if the sweep keeps only
    selected variables. xarray reports missing variables as KeyError."""
    missing = MISSING_VARIABLE.match(str(error.args[0])) if isinstance(error, KeyError) else None
    if missing is None or missing[1] in dataset.variables or SWEEP not in dataset.attrs:
        return None
    keep = json_attribute(dataset, SWEEP).get("keep") or {}
    return missing[1] if keep.get("variables") else None


def _chosen(dataset: xarray.Dataset, path: str | Path, at: Mapping[str, str]) -> xarray.Dataset:
    try:
        return member(dataset, at)
    except ExperimentError as error:
        raise ExperimentError(f"{path}: --at {error}") from None


def fault_of(dataset: xarray.Dataset) -> str | None:
    """Return the reason why this pbdkit cannot read a dataset, or None."""
    version = dataset.attrs.get("schema_version")
    if version is None:
        return "is not a dataset of pbdkit: it has no attribute schema_version"
    try:
        newer = [int(part) for part in str(version).split(".")] > [int(SCHEMA_VERSION)]
    except ValueError:
        return f"has an invalid schema_version, '{version}'"
    if newer:
        return (
            f"has schema_version {version}, and this pbdkit reads up to {SCHEMA_VERSION}; "
            "install a newer pbdkit"
        )
    if SWEEP in dataset.attrs:
        missing = [name for name in ("status", "message") if name not in dataset.variables]
        return f"has no variable '{missing[0]}': it is damaged, or was changed" if missing else None
    for column in base_columns():
        dims = dataset[column.name].dims if column.name in dataset.variables else None
        if dims != column.dims:
            what = "has no" if dims is None else f"has other dimensions, {dims}, of"
            return f"{what} variable '{column.name}': it is damaged, or was changed"
    return None
