"""Completion by the tabulator key: experiments, results, paths of `--set` and their values.

Click completes files and choices; what is here completes what an experiment or a result contains.
The paths of `--set` are those of the experiment on the line and of the JSON Schema.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
from click.shell_completion import (
    BashComplete,
    CompletionItem,
    add_completion_class,
    split_arg_string,
)

SUFFIXES = (".yaml", ".yml", ".json")
"""Endings of the names of experiment files."""
RESULT = ".nc"
MAX_TIMES = 200
"""Maximum number of steps that are offered at once: the first and the last, and some between."""
Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]
Candidates = Callable[[click.Context, str], Iterable[str | CompletionItem]]


def _completer(candidates: Candidates) -> Completer:
    """Return the candidates that begin as the word does; none where they cannot be computed, as a
    shell has no place for messages."""

    def complete(context: click.Context, _: click.Parameter, begun: str) -> list[CompletionItem]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                every = [*candidates(context, begun)]
        except (Exception, SystemExit):
            return []
        items = [one if isinstance(one, CompletionItem) else CompletionItem(one) for one in every]
        return [item for item in items if item.value.startswith(begun)]

    return complete


@_completer
def experiments(context: click.Context, begun: str) -> Iterator[str | CompletionItem]:
    """Complete shipped experiments and experiment files in this folder; where no shipped one begins
    so, the shell completes files."""
    from pbdkit.model.shipped import shipped_names

    names = [name for name in shipped_names() if name.startswith(begun)]
    if not names:
        yield CompletionItem(begun, type="file")
        return
    yield from names
    yield from sorted(p.name for p in Path().glob(f"{escape(begun)}*") if p.suffix in SUFFIXES)


@_completer
def shipped(context: click.Context, begun: str) -> Iterable[str]:
    """Complete shipped experiments."""
    from pbdkit.model.shipped import shipped_names

    return shipped_names()


@_completer
def results(context: click.Context, begun: str) -> Iterator[str | CompletionItem]:
    """Complete results, unfinished ones too, and folders."""
    from pbdkit.io.run_store import STORE

    folder = begun[: begun.rfind("/") + 1]
    start, found = begun[len(folder) :], False
    for path in sorted(Path(folder).glob(f"{escape(start)}*")):
        if path.name.startswith(".") and not start:
            continue
        name = path.name.removesuffix(STORE)
        if path.is_dir() or name.endswith(RESULT):
            found = True
            yield f"{folder}{name}{'/' * path.is_dir()}"
    if not found:
        yield CompletionItem(begun, type="file")


@_completer
def settings(context: click.Context, begun: str) -> Iterator[str]:
    """Complete the paths that can be set in the experiment on the line, with the settings before;
    behind `=` the words that can stand there, and the present value."""
    from pbdkit.model.schema import experiment_schema
    from pbdkit.plugin.registry import Registry

    path, asks_value, _ = begun.partition("=")
    # Plugins are loaded where their types are asked for.
    schema = experiment_schema(Registry(), installed=bool(asks_value))
    known = SettingPaths(_data(context), schema)
    if asks_value:
        yield from (f"{path}={value}" for value in known.values(path))
    else:
        yield from (f"{one}=" for one in known.paths())


def _data(context: click.Context) -> dict[str, Any]:
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.reading import Source, with_settings
    from pbdkit.model.shipped import read_experiment

    # The option that waits for its value keeps click from giving arguments their names.
    name = context.params.get("experiment") or next(iter(context.args), None)
    defaults = Experiment.defaults()
    source = read_experiment(name) if name else Source(data={})
    source = with_settings(source, context.params.get("settings") or (), defaults)
    return {**defaults, **source.data}


@_completer
def variables(context: click.Context, begun: str) -> Iterator[str]:
    """Complete the variables of particles and bonds of the result on the line, with components."""
    with _content(context) as content:
        variables = dict(content.variables)
        listed = (some.attrs.get("coordinates", "") for some in (content, *variables.values()))
        coordinates = {*" ".join(listed).split()}
        for name, variable in variables.items():
            dims = {*variable.dimensions} - {"time"}
            if name in coordinates | dims or dims - {"axis"} not in ({"particle"}, {"bond"}):
                continue
            yield name
            axes = variables["axis"][...] if "axis" in dims else ()
            yield from (f"{name}_{axis}" for axis in axes)


@_completer
def times(context: click.Context, begun: str) -> Iterator[str]:
    """Complete the recorded steps of the result on the line."""
    with _content(context) as content:
        times = [f"{time}" for time in content.variables["time"][...].tolist()]
    times = [time for time in times if time.startswith(begun)]
    stride = -(-len(times) // MAX_TIMES)
    yield from dict.fromkeys([*times[:: stride or 1], *times[-1:]])


@contextmanager
def _content(context: click.Context) -> Iterator[Any]:
    """Open the first result on the line, without xarray."""
    from pbdkit.io.seal import open_sealed

    given = [v for v in context.params.values() if isinstance(v, Path)]
    given += [Path(word) for word in context.args]
    file = open_sealed(next(path for path in given if path.is_file()))
    try:
        yield file
    finally:
        file.close()


class _Bash(BashComplete):
    """Completion in bash, which splits words at `=` and puts a space behind what it completes.

    Here `--set rule.K=1` has one value, and no space comes behind `=`.
    """

    source_template = BashComplete.source_template.replace(
        "COMPREPLY+=($value)",
        "COMPREPLY+=($value); [[ $value == *[=/] ]] && compopt -o nospace",
    )
    _known = 0

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before, and the word to complete."""
        parts, at = split_arg_string(os.environ["COMP_WORDS"]), int(os.environ["COMP_CWORD"])
        parts = [*parts, ""][: at + 1]
        words = parts[:1]
        for before, part in pairwise(parts):
            if "=" in (before, part) and len(words) > 1:
                words[-1] += part
            else:
                words.append(part)
        _, equals, value = words[-1].partition("=")
        value = value if equals and words[-1].startswith("-") else words[-1]
        self._known = max(0, len(value) - len(parts[-1].removeprefix("=")))
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem) -> str:
        """Return an item without what stands before the part that bash completes."""
        return f"{item.type},{item.value[self._known :]}"


def speak_bash() -> None:
    """Register the completion in bash with click."""
    add_completion_class(_Bash)


Schema = Mapping[str, Any]
MISSING = object()
"""The value of an entry that an experiment leaves out."""
NEEDS_QUOTES = {*" \"'{}$"}
"""Characters that a shell does not leave as they are."""


@dataclass(frozen=True)
class Entry:
    """An entry of an experiment by its path: its value, or the default, and its schema."""

    path: str
    value: Any
    schema: Schema


def _entry(path: str, data: Mapping[str, Any], key: str, schema: Schema) -> Entry:
    return Entry(f"{path}{key}", data.get(key, schema.get("default", MISSING)), schema)


class SettingPaths:
    """The paths that can be set in the `data` of an experiment with that schema."""

    def __init__(self, data: Mapping[str, Any], schema: Schema) -> None:
        self._definitions, self._root = schema.get("$defs", {}), Entry("", data, schema)

    def paths(self) -> list[str]:
        """Return the paths of single values, and of lists of them."""
        return [entry.path for entry in self._leaves(self._root)]

    def values(self, path: str) -> list[str]:
        """Return the words that the schema lists at a path, and the present value."""
        entry, keys = self._root, path.split(".")
        for depth in range(1, len(keys) + 1):
            inner = {entry.path: entry for entry in self._entries(entry)}
            if ".".join(keys[:depth]) not in inner:
                return []
            entry = inner[".".join(keys[:depth])]
        words, now = dict.fromkeys(self._words(entry.schema)), entry.value
        if now is not MISSING and now is not None:
            words[now if isinstance(now, str) else json.dumps(now, separators=(",", ":"))] = None
        return [word for word in words if not {*word} & NEEDS_QUOTES]

    def _leaves(self, entry: Entry) -> Iterator[Entry]:
        entries = [*self._entries(entry)]
        for inner in entries:
            yield from self._leaves(inner)
        if not entries:
            yield entry

    def _entries(self, entry: Entry) -> Iterator[Entry]:
        """Yield the entries of a map, or of a list of maps; none of a single value."""
        path, data = f"{entry.path}." if entry.path else "", entry.value
        forms = [*self._forms(entry.schema)]
        if isinstance(data, list):
            items: Schema = next((form["items"] for form in forms if "items" in form), {})
            if any(isinstance(one, dict) for one in data) and items:
                yield from (Entry(f"{path}{n}", one, items) for n, one in enumerate(data))
            return
        maps = [form for form in forms if "properties" in form]
        if isinstance(data, dict):
            fitting = [form for form in maps if _fits(form, data)] or maps[:1]
            schemas: dict[str, Any] = dict(fitting[0]["properties"]) if fitting else {}
            types = [form["properties"]["type"] for form in maps if "type" in form["properties"]]
            schemas |= {"type": {"anyOf": types}} if types else {}
            more = [form.get("additionalProperties") for form in forms]
            other: Schema = next((one for one in more if isinstance(one, Mapping)), {})
            for key in dict.fromkeys([*data, *schemas]):
                yield _entry(path, data, key, schemas.get(key, other))
        elif data is MISSING and len(maps) == len(forms) == 1:
            for key, schema in maps[0]["properties"].items():
                yield _entry(path, {}, key, schema)

    def _forms(self, schema: Schema) -> Iterator[Schema]:
        """Yield the alternatives of a schema that are not deprecated, references followed."""
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
    """Return whether a map of that `type` may have the form; any map may where it has no type."""
    kind = form["properties"].get("type")
    return kind is None or data.get("type") in (kind.get("const"), *kind.get("enum", ()))
