"""Changes of an experiment by path and value, as ``--set`` and sweeps make them."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from pbdkit.errors import ExperimentError, dotted
from pbdkit.experiment.source import Source, Where, parsed

Settings = str | Iterable[str] | Mapping[str, Any]
"""Changes of an experiment, as Python users give them."""
EXPECTED = "settings: expected a map, as {'steps': 20}, or a list of texts, as ['steps=20']"
LONGEST = 80
"""So many characters of a setting are repeated in messages."""


def with_settings(source: Source, settings: Settings, defaults: Mapping[str, Any]) -> Source:
    """Return a copy of the source with some values set.

    Parameters
    ----------
    settings : mapping, str, or iterable of str
        A map changes the keys that it names, at any depth: ``{"rule": {"relaxation": 0.3}}`` or
        ``{"rule.relaxation": 0.3}``; a map with a `type` replaces the whole part. A text is
        ``path=value``.
    defaults : mapping
        The entries from which parts start that the source leaves out.
    """
    if isinstance(settings, Mapping):
        for where, value in _leaves({**defaults, **source.data}, settings, ()):
            source = with_value(source, dotted(where), plain(value), "settings", defaults)
        return source
    texts = [settings] if isinstance(settings, str) else settings
    if not isinstance(texts, Iterable):
        raise ExperimentError(f"{EXPECTED}, got {settings!r}")
    for text in texts:
        if not isinstance(text, str):
            raise ExperimentError(f"{EXPECTED}, got {text!r} in the list")
        source = with_setting(source, text, defaults)
    return source


def _leaves(data: Any, changes: Mapping[Any, Any], where: Where) -> Iterator[tuple[Where, Any]]:
    """Yield the values to set, each with its path."""
    for key, value in changes.items():
        parts, now = str(key).split("."), data
        path = (*where, *parts)
        for part in parts:
            entries = dict(enumerate(now)) if isinstance(now, list) else now
            is_map = isinstance(entries, Mapping)
            now = entries.get(part, entries.get(_position(part))) if is_map else None
        if isinstance(value, Mapping) and "type" not in value and isinstance(now, (dict, list)):
            yield from _leaves(now, value, path)
        else:
            yield path, value


def plain(value: Any) -> Any:
    """Return the value as a file would hold it: Python users give arrays and components too."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True)
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value


def with_setting(source: Source, setting: str, defaults: Mapping[str, Any]) -> Source:
    """A copy of the source with one value set.

    `setting` is ``path=value`` with a dotted path, list positions from 0 and a YAML value. A part
    that the file leaves out starts from its entry in `defaults`.
    """
    label = f"setting {setting if len(setting) <= LONGEST else setting[:LONGEST] + '...'}"
    path, equals, value = setting.partition("=")
    if not equals or not path:
        raise ExperimentError(f"{label}: expected PATH=VALUE, for instance rule.K=-0.002")
    return with_value(source, path, parsed(value, Source(label)), label, defaults)


def with_value(
    source: Source, path: str, value: Any, label: str, defaults: Mapping[str, Any]
) -> Source:
    """The same of a value that is none of YAML; `label` is what messages call its place."""
    where = tuple(map(_position, path.split(".")))
    places = {k: place for k, place in source.places.items() if k[: len(where)] != where}
    changed = Source(source.name, copy.deepcopy(source.data), places, source.beside)
    _place(changed.data, where, value, label, defaults)
    for depth in range(1, len(where) + 1):
        changed.places.setdefault(where[:depth], label)
    return changed


def _position(part: str) -> str | int:
    return int(part) if part.isascii() and part.isdecimal() and len(part) < 10 else part


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
