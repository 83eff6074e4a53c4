"""Reads an experiment file: YAML 1.2 with the place of every value, and no way to blow up.

The guard works on the events of the parser, before anything is built: size, depth, aliases, merge
keys and tags are what makes YAML dangerous, and an experiment needs none of them.
"""

from __future__ import annotations

import io
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Sequence
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
from pbdkit.experiment.beside import Beside

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
    beside: Beside = field(default_factory=Beside)
    """The files that it may name."""

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
    if raw.startswith(b"SQLite format 3"):
        raise ExperimentError(
            f"{path}: is what was kept of an unfinished run or of a sweep, no experiment; `pbdkit "
            "resume OUT.nc` goes on with a run, `pbdkit sweep` with a sweep"
        )
    if len(raw) > MAX_BYTES:
        raise ExperimentError(f"{path}: is larger than 1 MiB, which no experiment needs")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if 0 in raw and not raw.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
            raise ExperimentError(f"{path}: is no text, and no experiment") from None
        raise ExperimentError(
            f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8"
        ) from None
    source = read_text(text, str(path))
    source.beside = Beside(path.parent)
    return source


def read_text(text: str, name: str) -> Source:
    """The experiment in a text; `name` is what messages call it."""
    source = Source(name)
    source.data = parsed(text, source)
    if source.data is None:
        raise ExperimentError(f"{name}: is empty; `pbdkit init` writes an experiment to start from")
    if not isinstance(source.data, dict):
        raise ExperimentError(f"{name}:1:1: expected keys such as `lattice:` at the top level")
    return source


def parsed(text: str, source: Source) -> Any:
    """The data of a text; the places of its values go into the source. Raises ExperimentError."""
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
        raise ExperimentError(
            f"{source.name}{place}: not valid YAML: {what}{_remedy(error)}"
        ) from None


def _remedy(error: YAMLError) -> str:
    """What to write instead, of the frequent faults."""
    what, within = (str(getattr(error, name, "") or "") for name in ("problem", "context"))
    mark = getattr(error, "context_mark", None)
    place = f" at {mark.line + 1}:{mark.column + 1}" if mark else ""
    if "\\t" in what:
        return "; indent with spaces, not with tabs"
    if "flow sequence" in within or "flow mapping" in within:
        bracket = "[" if "sequence" in within else "{"
        return f"; the '{bracket}'{place} is not closed, or a comma is missing before"
    if "quoted scalar" in within:
        return f"; the quotation mark{place} is not closed"
    if "mapping values" in what:
        return "; put a text with a colon in quotes, and begin each key on a line of its own"
    if "block" in what or "block" in within:
        return f"; indent all entries alike that belong together, as those that begin{place}"
    return ""


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
