"""Who a type belongs to, where its plugin does not load: looked up in the source, not run."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path

from pbdkit.registry.discovery import Point

MOST_FILES, LARGEST_FILE = 500, 2**20


def declares(point: Point, name: str) -> bool:
    """Whether a class in the plugin's source has that `type`, as far as one can see.

    Nothing of the plugin is imported. A type that is put together at run time is not seen.
    """
    declared = re.compile(rf"""\btype\b[^=\n]*=\s*(["']){re.escape(name)}\1""")
    try:
        return any(declared.search(text) for text in _texts(point))
    except Exception:  # whatever cannot be looked at says nothing
        return False


def _texts(point: Point) -> Iterator[str]:
    for n, file in enumerate(_files(point)):
        if n < MOST_FILES and file.stat().st_size <= LARGEST_FILE:
            yield file.read_text("utf-8", errors="replace")


def _files(point: Point) -> Iterator[Path]:
    """The file of the module that the entry point names, and those in its folder if it is in a
    package."""
    if point.entry is None:
        return
    spec = find_spec(point.package)
    folders = list((spec and spec.submodule_search_locations) or ())
    if spec and spec.has_location and not folders:
        yield Path(str(spec.origin))
    for part in point.entry.module.split(".")[1:]:
        spec = spec and PathFinder.find_spec(f"{spec.name}.{part}", folders)
        folders = list((spec and spec.submodule_search_locations) or folders)
    for folder in folders:
        yield from sorted(Path(folder).rglob("*.py"))
