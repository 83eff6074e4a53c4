"""Opens result files, and gives every xarray.Dataset the accessor `pbd`."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray
from xarray.backends import StoreBackendEntrypoint

from pbdkit.errors import ExperimentError, PbdkitError, PbdkitWarning, StorageError
from pbdkit.registry.blame import one_line
from pbdkit.results import picture
from pbdkit.results.layout import SCHEMA_VERSION, base_columns
from pbdkit.results.seal import BrokenSealError, opened, seal_of
from pbdkit.results.trial import opened_unsealed, try_reading

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNSEALED = "carries no seal: nobody can tell whether it is as it was written"


def open(path: str | Path) -> xarray.Dataset:
    """The dataset in a result file; its values are read, and checked, when they are used.

    Raises ExperimentError for an experiment, and StorageError where there is no such file, where it
    is not as it was written, where it cannot be read as netCDF, where pbdkit did not make it, where
    variables are missing, or where a newer pbdkit made it than this one can read. A change that is
    met later, as values are read, raises StorageError too. Warns, with pbdkit.PbdkitWarning, of a
    file without a seal, which is first read once in another process.
    """
    file = Path(path)
    refuse_no_file(file)
    if file.suffix in (".yaml", ".yml", ".json"):
        raise ExperimentError(
            f"{file}: is an experiment; `pbdkit run {file}` makes a result of it, and says where"
        )
    try:
        dataset = _opened(file)
    except StorageError:
        raise
    except Exception as error:  # whatever the libraries below make of a damaged file
        reason = getattr(error, "strerror", None) or error
        raise StorageError(f"{file}: cannot be read as netCDF-4: {reason}") from None
    if fault := _fault(dataset):
        dataset.close()
        raise StorageError(f"{file}: {fault}")
    return dataset


def refuse_no_file(file: Path) -> None:
    """Raises StorageError where there is no plain file of that name."""
    if file.is_dir():
        raise StorageError(f"{file}: is a folder, no result of pbdkit")
    if not file.is_file():
        what = (
            "is no plain file, and no result of pbdkit"
            if file.exists()
            else "there is no such file"
        )
        raise StorageError(f"{file}: {what}")


def _opened(file: Path) -> xarray.Dataset:
    with file.open("rb", buffering=0) as start:
        sealed = seal_of(start) is not None
    if not sealed:
        try_reading(file)
        dataset = opened_unsealed(file)
        warnings.warn(f"{file}: {UNSEALED}", PbdkitWarning, stacklevel=3)
        return dataset
    manager = xarray.backends.CachingFileManager(opened, file.absolute(), mode="r")
    store = xarray.backends.H5NetCDFStore(manager)
    # Times are steps: nothing is to be decoded as a date, as in the dataset that `run` returns.
    return xarray.open_dataset(store, engine=StoreBackendEntrypoint, decode_times=False)


@contextmanager
def reading(path: str | Path) -> Iterator[xarray.Dataset]:
    """The dataset in a result file, to be read from in the block.

    Raises what `open` does, and StorageError for whatever reading and using its values raises:
    files are sound when written.
    """
    with open(path) as dataset:
        try:
            yield dataset
        except BrokenSealError:
            raise
        except (ExperimentError, StorageError) as error:
            raise type(error)(f"{path}: {'; '.join(str(error).splitlines())}") from None
        except (PbdkitError, MemoryError):
            raise
        except Exception as error:
            told = f"{type(error).__name__}: {error}"
            raise StorageError(f"{path}: is damaged, or was changed: {one_line(told)}") from error


def _fault(dataset: xarray.Dataset) -> str | None:
    """Why this pbdkit cannot read it, if it cannot."""
    version = dataset.attrs.get("schema_version")
    if version is None:
        return "is no dataset of pbdkit: it has no attribute schema_version"
    try:
        newer = [int(part) for part in str(version).split(".")] > [int(SCHEMA_VERSION)]
    except ValueError:
        return f"has the schema_version '{version}', which no pbdkit writes"
    if newer:
        return (
            f"has schema_version {version}, and this pbdkit reads up to {SCHEMA_VERSION}; "
            "install a newer pbdkit"
        )
    for column in base_columns():
        dims = dataset[column.name].dims if column.name in dataset.variables else None
        if dims != column.dims:
            what = "has no" if dims is None else f"has other dimensions, {dims}, of"
            return f"{what} variable '{column.name}': it is damaged, or was changed"
    return None


@xarray.register_dataset_accessor("pbd")  # type: ignore[no-untyped-call]  # xarray's is untyped
class PbdAccessor:
    """What pbdkit adds to a dataset: ``dataset.pbd.plot(...)``."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        self._dataset = dataset

    def plot(
        self,
        time: int | Iterable[int] | None = None,
        color: str | None = None,
        *,
        contours: bool = False,
        numbers: bool = False,
        ax: Axes | None = None,
    ) -> Axes | Figure:
        """A picture: the Axes of one step (default the last), or a Figure of several.

        `contours`, `numbers` and, for one step, `ax` are those of `picture.draw`, and what is
        raised is too.
        """
        look: dict[str, Any] = {"color": color, "contours": contours, "numbers": numbers}
        if isinstance(time, Iterable):
            whole = picture.draw(self._dataset, time, **look)[0].get_figure(root=True)
            assert whole is not None
            return whole
        return picture.draw(self._dataset, [time], ax=ax, **look)[0]
