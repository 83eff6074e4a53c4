"""What a dataset says of the run that made it, as JSON in its attributes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from pbdkit.errors import StorageError

if TYPE_CHECKING:
    import xarray


def carried(dataset: xarray.Dataset, attribute: str) -> dict[str, Any]:
    """The map in an attribute, or in the coordinate that it is for one run of several; empty where
    there is neither. Raises StorageError where it is damaged."""
    beside = dataset.coords.get(attribute)
    text = "{}" if beside is None or beside.ndim else beside.item()
    try:
        found = json.loads(dataset.attrs.get(attribute, text))
    except (ValueError, TypeError, RecursionError) as error:
        raise StorageError(f"its attribute '{attribute}' is damaged: {error}") from None
    if not isinstance(found, dict):
        raise StorageError(f"its attribute '{attribute}' is damaged: it holds no map of keys")
    return found
