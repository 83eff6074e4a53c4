"""Changes of an experiment by path and value, as ``--set`` and sweeps make them."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.experiment.source import Source, Where, parsed

LONGEST = 80
"""So many characters of a setting are repeated in messages."""


def with_setting(source: Source, setting: str, defaults: Mapping[str, Any]) -> Source:
    """A copy of the source with one value set.

    `setting` is ``path=value`` with a dotted path, list positions from 0 and a YAML value. A part
    that the file leaves out starts from its entry in `defaults`.
    """
    label = f"--set {setting if len(setting) <= LONGEST else setting[:LONGEST] + '...'}"
    path, equals, value = setting.partition("=")
    if not equals or not path:
        raise ExperimentError(f"{label}: expected PATH=VALUE, for instance rule.K=-0.002")
    return with_value(source, path, parsed(value, Source(label)), label, defaults)


def with_value(
    source: Source, path: str, value: Any, label: str, defaults: Mapping[str, Any]
) -> Source:
    """The same of a value that is none of YAML; `label` is what messages call its place."""
    where = tuple(
        int(p) if p.isascii() and p.isdecimal() and len(p) < 10 else p for p in path.split(".")
    )
    places = {k: place for k, place in source.places.items() if k[: len(where)] != where}
    changed = Source(source.name, copy.deepcopy(source.data), places, source.folder)
    _place(changed.data, where, value, label, defaults)
    for depth in range(1, len(where) + 1):
        changed.places.setdefault(where[:depth], label)
    return changed


def _place(data: Any, where: Where, value: Any, label: str, defaults: Mapping[str, Any]) -> None:
    *parents, last = where
    for depth, part in enumerate(parents):
        if isinstance(data, dict) and part not in data:
            data[part] = copy.deepcopy(defaults.get(str(part), {})) if depth == 0 else {}
        data = _entry(data, part, label)
    if isinstance(data, dict):
        data[str(last)] = value
    else:
        _entry(data, last, label)
        data[last] = value


def _entry(data: Any, part: str | int, label: str) -> Any:
    if isinstance(data, dict):
        return data[part if part in data else str(part)]
    if not isinstance(data, list):
        raise ExperimentError(f"{label}: '{part}' is looked for in a single value")
    if not isinstance(part, int) or part >= len(data):
        raise ExperimentError(f"{label}: '{part}' is no position in a list of {len(data)}, from 0")
    return data[part]
