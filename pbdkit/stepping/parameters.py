"""Numbers with names, as elementwise functions read them."""

from __future__ import annotations

from collections import namedtuple
from typing import Any


def named(values: dict[str, float]) -> Any:
    """A tuple of the numbers whose entries are read as ``p.K``."""
    return namedtuple("Parameters", values)(**values)
