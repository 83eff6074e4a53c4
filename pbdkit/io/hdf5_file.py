"""HDF5 files for h5netcdf, which looks up each object of a file many times. This module is imported
only where a file is opened, because h5py takes long to import."""

from __future__ import annotations

from typing import Any

import h5py

from pbdkit.memory import refuse_no_file_cache


class Hdf5File(h5py.File):  # type: ignore[misc]  # h5py has no annotations
    """HDF5 file that keeps the objects that have been looked up by their path."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._objects: dict[str, Any] = {}
        refuse_no_file_cache()
        super().__init__(*arguments, **options)

    def __getitem__(self, name: Any) -> Any:
        if not isinstance(name, str):
            return super().__getitem__(name)
        if name == "/":
            return self
        if name not in self._objects:
            self._objects[name] = super().__getitem__(name)
        return self._objects[name]

    def __delitem__(self, name: Any) -> None:
        self._objects.clear()
        super().__delitem__(name)
