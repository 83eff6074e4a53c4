"""Opens result files, and gives every xarray.Dataset the accessor `pbd`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray

from pbdkit.errors import StorageError
from pbdkit.results import picture
from pbdkit.results.layout import SCHEMA_VERSION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def open(path: str | Path) -> xarray.Dataset:
    """The dataset in a result file; its values are read when they are used.

    Raises StorageError where there is no such file, where it cannot be read as netCDF, where
    pbdkit did not make it, or where a newer pbdkit made it than this one can read.
    """
    file = Path(path)
    if not file.is_file():
        raise StorageError(f"{file}: there is no such file")
    try:
        # Times are steps: nothing is to be decoded as a date, as in the dataset that `run` returns.
        dataset = xarray.open_dataset(file, engine="netcdf4", decode_times=False)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        reason = getattr(error, "strerror", None) or error
        raise StorageError(f"{file}: cannot be read as netCDF-4: {reason}") from None
    fault = _fault(dataset.attrs.get("schema_version"))
    if fault:
        dataset.close()
        raise StorageError(f"{file}: {fault}")
    return dataset


def _fault(version: Any) -> str | None:
    if version is None:
        return "is no dataset of pbdkit: it has no attribute schema_version"
    try:
        newer = _parts(version) > _parts(SCHEMA_VERSION)
    except ValueError:
        return f"has the schema_version '{version}', which no pbdkit writes"
    if newer:
        return (
            f"has schema_version {version}, and this pbdkit reads up to {SCHEMA_VERSION}; "
            "install a newer pbdkit"
        )
    return None


def _parts(version: Any) -> tuple[int, ...]:
    return tuple(int(part) for part in str(version).split("."))


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
            return picture.figure(self._dataset, time, **look)
        return picture.draw(self._dataset, time, ax=ax, **look)
