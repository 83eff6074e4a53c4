"""A sink that keeps the dataset in memory, and makes an xarray.Dataset of it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.results.layout import Column, Values
from pbdkit.results.recorder import Sink

if TYPE_CHECKING:
    import xarray


class MemorySink(Sink):
    """Grows every column in memory."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Nothing is allocated before it comes."""
        self._columns = columns
        self._sizes = sizes
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

        import_module("pbdkit.results.accessor")  # gives every dataset its `pbd`
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
