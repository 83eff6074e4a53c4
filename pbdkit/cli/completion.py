"""What the tabulator key offers: experiments, settings, results, and what is in them.

What cannot be found out is not offered: a shell has no place for messages.

The paths that `--set` takes, and the values at them, by the JSON Schema of experiments.
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
RESULT = ".nc"
MOST_TIMES = 200
"""So many steps are offered at once: the first and the last, and some between."""
Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]
Finder = Callable[[click.Context, str], Iterable[str | CompletionItem]]


def _completer(find: Finder) -> Completer:
    """Offers what is found that begins as what is there, and nothing where finding fails."""

    def complete(context: click.Context, _: click.Parameter, begun: str) -> list[CompletionItem]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = [*find(context, begun)]
        except (Exception, SystemExit):
            return []
        items = [one if isinstance(one, CompletionItem) else CompletionItem(one) for one in found]
        return [item for item in items if item.value.startswith(begun)]

    return complete


def _experiments(context: click.Context, begun: str) -> Iterator[str | CompletionItem]:
    """The shipped experiments and the experiment files here; where no shipped one begins so,
    whatever the shell itself offers as files."""
    from pbdkit.model.shipped import shipped_names

    names = [name for name in shipped_names() if name.startswith(begun)]
    if not names:
        yield CompletionItem(begun, type="file")
        return
    yield from names
    yield from sorted(p.name for p in Path().glob(f"{escape(begun)}*") if p.suffix in SUFFIXES)


def _shipped(context: click.Context, begun: str) -> Iterable[str]:
    """The shipped experiments."""
    from pbdkit.model.shipped import shipped_names

    return shipped_names()


def _results(context: click.Context, begun: str) -> Iterator[str | CompletionItem]:
    """The results in a folder, those of runs that are not finished, and the folders in it."""
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


def _settings(context: click.Context, begun: str) -> Iterator[str]:
    """The paths of the experiment on the line, with the settings before; behind `=` the words that
    can stand there, and the present value."""
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


def _variables(context: click.Context, begun: str) -> Iterator[str]:
    """What particles or bonds of the result on the line can be coloured by, the components of
    vectors too."""
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


def _times(context: click.Context, begun: str) -> Iterator[str]:
    """The recorded steps of the result on the line."""
    with _content(context) as content:
        times = [f"{time}" for time in content.variables["time"][...].tolist()]
    times = [time for time in times if time.startswith(begun)]
    stride = -(-len(times) // MOST_TIMES)
    yield from dict.fromkeys([*times[:: stride or 1], *times[-1:]])


@contextmanager
def _content(context: click.Context) -> Iterator[Any]:
    """The first result among what is on the line, opened without xarray."""
    from pbdkit.io.seal import opened

    given = [v for v in context.params.values() if isinstance(v, Path)]
    given += [Path(word) for word in context.args]
    file = opened(next(path for path in given if path.is_file()))
    try:
        yield file
    finally:
        file.close()


experiments = _completer(_experiments)
shipped = _completer(_shipped)
results = _completer(_results)
settings = _completer(_settings)
variables = _completer(_variables)
times = _completer(_times)


class _Bash(BashComplete):
    """Bash parts words at `=`, and puts a space behind what it completes. Here `--set rule.K=1` has
    one value, and no space comes behind `=`."""

    source_template = BashComplete.source_template.replace(
        "COMPREPLY+=($value)",
        "COMPREPLY+=($value); [[ $value == *[=/] ]] && compopt -o nospace",
    )
    _known = 0

    def get_completion_args(self) -> tuple[list[str], str]:
        """The words before, and that which is to be completed."""
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
        """Without what stands before the part that bash completes."""
        return f"{item.type},{item.value[self._known :]}"


def speak_bash() -> None:
    """From now on this is what click takes for bash."""
    add_completion_class(_Bash)


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
