"""Where a dataset goes while it is made: an interface, and the memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.results.layout import Column, Values
from pbdkit.storage.standing import Standing

if TYPE_CHECKING:
    import xarray


class Sink(ABC):
    """Where a dataset goes while it is made. It may keep what it is given: nobody changes that
    afterwards."""

    @abstractmethod
    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """The columns to come, the sizes of the dimensions that do not grow, and how many entries
        are planned along those that do."""

    @abstractmethod
    def put(self, values: Values) -> None:
        """One entry for each column that grows, or the whole of a column that does not."""

    @abstractmethod
    def finish(self, attributes: dict[str, str]) -> None:
        """Nothing more comes."""

    @abstractmethod
    def abandon(self) -> None:
        """The run failed: what was put is not wanted."""


class KeepingSink(Sink):
    """A sink that keeps where the run stands, so that it can be gone on with."""

    @abstractmethod
    def due(self) -> bool:
        """Whether it is time to."""

    @abstractmethod
    def keep(self, standing: Standing) -> None:
        """After what was put; what is kept outlives `abandon`."""

    @abstractmethod
    def suspend(self, standing: Standing) -> None:
        """Keeps it; nothing more comes for now."""

    @abstractmethod
    def note_end(self, standing: Standing) -> None:
        """Before `finish`: from there the run can be continued to more steps."""


class MemorySink(Sink):
    """Grows every column in memory."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Nothing is allocated before it comes."""
        self._columns, self._sizes = columns, sizes
        self._entries: dict[str, list[Any]] = {c.name: [] for c in columns}

    def put(self, values: Values) -> None:
        """Keeps what it is given."""
        for name, value in values.items():
            self._entries[name].append(value)

    def finish(self, attributes: dict[str, str]) -> None:
        """Keeps the attributes."""
        self._attributes = attributes

    def abandon(self) -> None:
        """Forgets everything."""
        self._entries = {}

    def dataset(self) -> xarray.Dataset:
        """The dataset as in the file."""
        import xarray

        variables = {c.name: (c.dims, self._values(c), c.attributes) for c in self._columns}
        coordinates = [c.name for c in self._columns if c.coordinate]
        return xarray.Dataset(variables, attrs=self._attributes).set_coords(coordinates)

    def _values(self, column: Column) -> Any:
        entries = self._entries[column.name]
        if column.grows:
            shape = (len(entries), *(self._sizes[d] for d in column.dims[1:]))
            return np.array(entries, column.dtype).reshape(shape)
        dtype = None if column.dtype == "str" else column.dtype
        return np.asarray(entries[0] if entries else [], dtype)
