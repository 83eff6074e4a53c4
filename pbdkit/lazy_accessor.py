"""Registration of the accessor `pbd` of xarray.Dataset as soon as xarray is imported.

This module does not import xarray itself.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

    import xarray

    from pbdkit.accessor import PbdAccessor

LIBRARY = "xarray"
"""Module that the accessor extends."""


def register_accessor() -> None:
    """Register `pbd` now if xarray has been imported, and otherwise when it is imported."""
    if LIBRARY in sys.modules:
        _register(sys.modules[LIBRARY])
    else:
        sys.meta_path.insert(0, AccessorFinder())


class AccessorFinder:
    """Module finder that delegates the search for xarray to the other finders, and registers the
    accessor after the import of xarray."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the specification of xarray, and None for every other module."""
        if name != LIBRARY:
            return None
        finders = [finder for finder in sys.meta_path if finder is not self]
        specs = (finder.find_spec(name, path, target) for finder in finders)
        spec = next((candidate for candidate in specs if candidate is not None), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            _register(module)
            sys.meta_path.remove(self)

        # The loader belongs to this import alone, so that its method can be replaced.
        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]  # of this loader
        return spec


def _register(library: ModuleType) -> None:
    library.register_dataset_accessor("pbd")(_accessor_of)
    library.register_dataarray_accessor("pbd")(_OfArray)


class _OfArray:
    """Accessor of a single variable, which has no methods."""

    def __init__(self, array: xarray.DataArray) -> None:
        self._name = array.name

    def __getattr__(self, name: str) -> None:
        raise AttributeError(
            f"`pbd` belongs to datasets: write ds.pbd.{name}(...), with '{self._name}' as the name "
            "of a variable"
        )


def _accessor_of(dataset: xarray.Dataset) -> PbdAccessor:
    from pbdkit.accessor import PbdAccessor

    return PbdAccessor(dataset)
