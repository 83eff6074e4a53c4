"""The paths that `--set` takes, and the values at them, by the JSON Schema of experiments."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Schema = Mapping[str, Any]
MISSING = object()
"""In place of what an experiment leaves out."""

NEEDS_QUOTES = {*" \"'{}$"}
"""A shell would not leave a word with these as it is."""


@dataclass(frozen=True)
class Place:
    """A place in an experiment: what stands there, and what the schema says of it."""

    path: str
    data: Any
    schema: Schema


class SettingPaths:
    """Of one experiment's `data`; `schema` is that of experiments."""

    def __init__(self, data: Mapping[str, Any], schema: Schema) -> None:
        self._definitions, self._whole = schema.get("$defs", {}), Place("", data, schema)

    def paths(self) -> list[str]:
        """Down to single values, and lists of them."""
        return [place.path for place in self._below(self._whole)]

    def values(self, path: str) -> list[str]:
        """What can stand there: the words that the schema lists, and what stands there now."""
        place = self._whole
        for word in path.split("."):
            inner = (one for one in self._inside(place) if one.path.rpartition(".")[-1] == word)
            if (found := next(inner, None)) is None:
                return []
            place = found
        words = dict.fromkeys(self._words(place.schema))
        now = place.data if place.data is not MISSING else place.schema.get("default", MISSING)
        if now is not MISSING and now is not None:
            words[now if isinstance(now, str) else json.dumps(now, separators=(",", ":"))] = None
        return [word for word in words if not {*word} & NEEDS_QUOTES]

    def _below(self, place: Place) -> Iterator[Place]:
        inside = [*self._inside(place)]
        if not inside:
            yield place
        for one in inside:
            yield from self._below(one)

    def _inside(self, place: Place) -> Iterator[Place]:
        """What it holds; nothing where it is a single value, or a list of them."""
        begun = f"{place.path}." if place.path else ""
        data, forms = place.data, [*self._forms(place.schema)]
        if data is MISSING:
            data = place.schema.get("default", MISSING)
        if isinstance(data, list):
            items: Schema = next((form["items"] for form in forms if "items" in form), {})
            if any(isinstance(one, dict) for one in data) and items:
                yield from (Place(f"{begun}{n}", one, items) for n, one in enumerate(data))
            return
        maps = [form for form in forms if "properties" in form]
        if isinstance(data, dict):
            fitting = [form for form in maps if _fits(form, data)] or maps[:1]
            known: dict[str, Any] = dict(fitting[0]["properties"]) if fitting else {}
            types = [form["properties"]["type"] for form in maps if "type" in form["properties"]]
            known |= {"type": {"anyOf": types}} if types else {}
            other: Schema = next((f["additionalProperties"] for f in forms if _is_open(f)), {})
            for key in dict.fromkeys([*data, *known]):
                yield Place(f"{begun}{key}", data.get(key, MISSING), known.get(key, other))
        elif data is MISSING and len(maps) == len(forms) == 1:
            for key, schema in maps[0]["properties"].items():
                yield Place(f"{begun}{key}", MISSING, schema)

    def _forms(self, schema: Schema) -> Iterator[Schema]:
        """The ways to write it that are not deprecated, references followed."""
        if "$ref" in schema:
            yield from self._forms(self._definitions.get(schema["$ref"].split("/")[-1], {}))
            return
        ways = [way for name in ("anyOf", "oneOf", "allOf") for way in schema.get(name, ())]
        for way in ways:
            if not way.get("deprecated"):
                yield from self._forms(way)
        if not ways or "properties" in schema:
            yield schema

    def _words(self, schema: Schema) -> Iterator[str]:
        for form in self._forms(schema):
            if form.get("type") == "boolean":
                yield from ("true", "false")
            words = [*form.get("enum", ()), *([form["const"]] if "const" in form else [])]
            yield from (word for word in words if isinstance(word, str))


def _fits(form: Schema, data: Mapping[str, Any]) -> bool:
    """Whether a part of that type may be so written; anything where it has no type."""
    kind = form["properties"].get("type")
    return kind is None or data.get("type") in (kind.get("const"), *kind.get("enum", ()))


def _is_open(form: Schema) -> bool:
    return isinstance(form.get("additionalProperties"), Mapping)
