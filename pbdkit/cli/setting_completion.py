"""Completion of ``--set PATH=VALUE``. The candidates are determined from the experiment in the
command line and from the JSON Schema."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import click

from pbdkit.cli.completion import completer
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source, with_settings
from pbdkit.model.schema import experiment_schema
from pbdkit.model.shipped import read_experiment
from pbdkit.plugin.registry import Registry

Schema = Mapping[str, Any]
MISSING = object()
"""Value of an entry that is omitted in an experiment."""
NEEDS_QUOTES = {*" \"'{}$"}
"""Characters that have a special meaning in a shell."""


@dataclass(frozen=True)
class Entry:
    """An entry of an experiment: its path, its value or default, and its schema."""

    path: str
    value: Any
    schema: Schema


def _entry(path: str, data: Mapping[str, Any], key: str, schema: Schema) -> Entry:
    return Entry(f"{path}{key}", data.get(key, schema.get("default", MISSING)), schema)


class SettingPaths:
    """The paths that can be set in an experiment. `data` are its values, and `schema` is the JSON
    Schema of experiments."""

    def __init__(self, data: Mapping[str, Any], schema: Schema) -> None:
        self._definitions, self._root = schema.get("$defs", {}), Entry("", data, schema)

    def paths(self) -> list[str]:
        """Return the paths of single values, and of lists of single values."""
        return [entry.path for entry in self._leaves(self._root)]

    def values(self, path: str) -> list[str]:
        """Return the words that the schema permits at a path, and the present value."""
        entry, keys = self._root, path.split(".")
        for depth in range(1, len(keys) + 1):
            inner = {entry.path: entry for entry in self._entries(entry)}
            if ".".join(keys[:depth]) not in inner:
                return []
            entry = inner[".".join(keys[:depth])]
        words, value = dict.fromkeys(self._words(entry.schema)), entry.value
        if value is not MISSING and value is not None:
            text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
            words[text] = None
        return [word for word in words if not {*word} & NEEDS_QUOTES]

    def _leaves(self, entry: Entry) -> Iterator[Entry]:
        entries = [*self._entries(entry)]
        for inner in entries:
            yield from self._leaves(inner)
        if not entries:
            yield entry

    def _entries(self, entry: Entry) -> Iterator[Entry]:
        """Yield the entries of a map or of a list of maps. A single value has no entries."""
        path, data = f"{entry.path}." if entry.path else "", entry.value
        forms = [*self._forms(entry.schema)]
        if isinstance(data, list):
            items: Schema = next((form["items"] for form in forms if "items" in form), {})
            if any(isinstance(item, dict) for item in data) and items:
                yield from (Entry(f"{path}{n}", item, items) for n, item in enumerate(data))
            return
        maps = [form for form in forms if "properties" in form]
        if isinstance(data, dict):
            fitting = [form for form in maps if _fits(form, data)] or maps[:1]
            schemas: dict[str, Any] = dict(fitting[0]["properties"]) if fitting else {}
            types = [form["properties"]["type"] for form in maps if "type" in form["properties"]]
            schemas |= {"type": {"anyOf": types}} if types else {}
            additional = (form.get("additionalProperties") for form in forms)
            default: Schema = next((form for form in additional if isinstance(form, Mapping)), {})
            for key in dict.fromkeys([*data, *schemas]):
                yield _entry(path, data, key, schemas.get(key, default))
        elif data is MISSING and len(maps) == len(forms) == 1:
            for key, schema in maps[0]["properties"].items():
                yield _entry(path, {}, key, schema)

    def _forms(self, schema: Schema) -> Iterator[Schema]:
        """Yield the alternatives of a schema, with references resolved. Deprecated alternatives are
        omitted."""
        if "$ref" in schema:
            yield from self._forms(self._definitions.get(schema["$ref"].split("/")[-1], {}))
            return
        alternatives = [form for key in ("anyOf", "oneOf", "allOf") for form in schema.get(key, ())]
        for form in alternatives:
            if not form.get("deprecated"):
                yield from self._forms(form)
        if not alternatives or "properties" in schema:
            yield schema

    def _words(self, schema: Schema) -> Iterator[str]:
        for form in self._forms(schema):
            if form.get("type") == "boolean":
                yield from ("true", "false")
            words = [*form.get("enum", ()), *([form["const"]] if "const" in form else [])]
            yield from (word for word in words if isinstance(word, str))


def _fits(form: Schema, data: Mapping[str, Any]) -> bool:
    """Return whether a map may have this form of the schema. If the form defines a `type`, the map
    must have the same `type`."""
    kind = form["properties"].get("type")
    return kind is None or data.get("type") in (kind.get("const"), *kind.get("enum", ()))


@completer
def settings(context: click.Context, prefix: str) -> Iterator[str]:
    """Complete a setting. Before `=`, the candidates are the paths that can be set in the
    experiment in the command line, after its other settings are applied. After `=`, they are the
    words that the schema permits, and the present value."""
    path, equals, _ = prefix.partition("=")
    # Plugins are only loaded if their types have to be listed.
    schema = experiment_schema(Registry(), installed=bool(equals))
    setting_paths = SettingPaths(_data(context), schema)
    if equals:
        yield from (f"{path}={value}" for value in setting_paths.values(path))
    else:
        yield from (f"{name}=" for name in setting_paths.paths())


def _data(context: click.Context) -> dict[str, Any]:
    # Click does not assign the arguments as long as an option has no value.
    name = context.params.get("experiment") or next(iter(context.args), None)
    defaults = Experiment.defaults()
    source = read_experiment(name) if name else Source(data={})
    source = with_settings(source, context.params.get("settings") or (), defaults)
    return {**defaults, **source.data}
