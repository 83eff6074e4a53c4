"""Reads an experiment file: YAML 1.2 with the place of every value, and no way to blow up.

The guard works on the events of the parser, before anything is built: size, depth, aliases, merge
keys and tags are what makes YAML dangerous, and an experiment needs none of them.
"""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceStartEvent,
)
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.scanner import Scanner

from pbdkit.errors import ExperimentError, dotted

MAX_BYTES = 2**20
MAX_DEPTH = 32
MAX_NODES = 20_000
Where = tuple[str | int, ...]


@dataclass
class Source:
    """Where an experiment comes from: its raw data, and the place of each value in the file."""

    name: str = ""
    data: Any = None
    places: dict[Where, str] = field(default_factory=dict)

    def message(self, where: Sequence[str | int], text: str) -> str:
        """``file:line:column: field: text``; of an absent field the place of what encloses it."""
        known = tuple(where)
        while known and known not in self.places:
            known = known[:-1]
        parts = [self.places.get(known, self.name), dotted(where), text]
        return ": ".join(part for part in parts if part)


def read_file(path: Path) -> Source:
    """The experiment in a file; ExperimentError names what cannot be read, and where."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror}") from None
    if raw.startswith((b"\x89HDF", b"CDF\x01", b"CDF\x02", b"CDF\x05")):
        raise ExperimentError(
            f"{path}: is a result, no experiment; `pbdkit plot {path}` draws it, and "
            "pbdkit.rerun(pbdkit.open(...)) runs the same again"
        )
    if len(raw) > MAX_BYTES:
        raise ExperimentError(f"{path}: is larger than 1 MiB, which no experiment needs")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ExperimentError(
            f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8"
        ) from None
    return read_text(text, str(path))


def read_text(text: str, name: str) -> Source:
    """The experiment in a text; `name` is what messages call it."""
    source = Source(name)
    source.data = _read(text, source)
    if source.data is None:
        raise ExperimentError(f"{name}: is empty; `pbdkit init` writes an experiment to start from")
    if not isinstance(source.data, dict):
        raise ExperimentError(f"{name}:1:1: expected keys such as `lattice:` at the top level")
    return source


def _read(text: str, source: Source) -> Any:
    yaml = YAML(typ="safe", pure=True)
    yaml.Scanner = _Scanner
    try:
        return _Reading(yaml, text, source).document()
    except ReaderError as error:
        before = text[: error.position]
        place = f"{before.count(chr(10)) + 1}:{error.position - before.rfind(chr(10))}"
        what = f"the character {error.character!r} is not allowed in YAML"
        raise ExperimentError(f"{source.name}:{place}: {what}") from None
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        place = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        what = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ExperimentError(f"{source.name}{place}: not valid YAML: {what}") from None


class _Scanner(Scanner):
    """Notes no keys where nothing is taken: at each character it goes through all that it noted."""

    def save_possible_simple_key(self) -> None:
        """As ruamel's, down to the depth that is taken."""
        if self.flow_level <= MAX_DEPTH:
            super().save_possible_simple_key()


class _Reading:
    """Makes data of the parser's events, one look at each, and notes the places."""

    def __init__(self, yaml: YAML, text: str, source: Source) -> None:
        self._yaml, self._source, self._nodes = yaml, source, 0
        self._events = (self._allowed(event) for event in yaml.parse(io.StringIO(text)))

    def document(self) -> Any:
        """The data of the one document; None where there is none."""
        data, documents = None, 0
        for event in self._events:
            if isinstance(event, DocumentStartEvent):
                if event.version or event.tags:
                    self._refuse(event, "directives (%YAML, %TAG) are not taken")
                documents += 1
                if documents > 1:
                    self._refuse(event, "a second document; one file holds one experiment")
                data = self._value(next(self._events), ())
        return data

    def _allowed(self, event: Any) -> Any:
        if not isinstance(event, NodeEvent):
            return event
        self._nodes += 1
        if isinstance(event, AliasEvent):
            self._refuse(event, f"aliases (*{event.anchor}) are not taken; write it out")
        if self._nodes > MAX_NODES:
            self._refuse(event, f"more than {MAX_NODES} values, which no experiment needs")
        tag = getattr(event, "tag", None)
        if str(tag or "!") != "!":
            self._refuse(event, f"tags ({tag}) are not taken")
        if isinstance(event, ScalarEvent):
            if event.value == "<<" and event.implicit[0]:
                self._refuse(event, "merge keys (<<) are not taken; write the keys out")
            if any("\ud800" <= c <= "\udfff" for c in event.value):
                self._refuse(event, "half a character (\\ud800 to \\udfff) is not taken")
        return event

    def _value(self, event: Any, where: Where) -> Any:
        self._source.places.setdefault(where, self._place(event))
        if len(where) >= MAX_DEPTH and isinstance(event, CollectionStartEvent):
            self._refuse(event, f"nested more than {MAX_DEPTH} levels deep")
        if isinstance(event, SequenceStartEvent):
            return [self._value(item, (*where, n)) for n, item in enumerate(self._inner())]
        if isinstance(event, MappingStartEvent):
            return self._map(where)
        tag = self._yaml.resolver.resolve(ScalarNode, event.value, event.implicit)
        if str(tag).rsplit(":", 1)[-1] not in ("null", "bool", "int", "float"):
            return event.value
        try:
            return self._yaml.constructor.construct_object(ScalarNode(tag, event.value))
        except ValueError:
            return self._refuse(
                event, f"{dotted(where)}: '{event.value[:20]}...' is too long for a number"
            )

    def _map(self, where: Where) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for event in self._inner():
            if not isinstance(event, ScalarEvent):
                self._refuse(event, "a key must be a word")
            key, places = str(event.value), self._source.places
            if key in found:
                first = places[(*where, key)]
                self._refuse(event, f"{dotted((*where, key))}: given twice, first at {first}")
            places[(*where, key)] = self._place(event)
            found[key] = self._value(next(self._events), (*where, key))
        return found

    def _inner(self) -> Iterator[Any]:
        """The events in a collection, up to its end; whoever takes one takes what is in it too."""
        while not isinstance(event := next(self._events), CollectionEndEvent):
            yield event

    def _place(self, event: Any) -> str:
        mark = event.start_mark
        return f"{self._source.name}:{mark.line + 1}:{mark.column + 1}"

    def _refuse(self, event: Any, what: str) -> NoReturn:
        raise ExperimentError(f"{self._place(event)}: {what}")


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
    where = tuple(
        int(p) if p.isascii() and p.isdecimal() and len(p) < 10 else p for p in path.split(".")
    )
    places = {k: place for k, place in source.places.items() if k[: len(where)] != where}
    changed = Source(source.name, copy.deepcopy(source.data), places)
    _place(changed.data, where, _read(value, Source(label)), label, defaults)
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
