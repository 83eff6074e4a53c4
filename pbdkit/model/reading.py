"""Read and write experiment files: YAML 1.2 with the position of every value, and changes by path
as `--set` and sweeps make them.

The limits on size, depth, aliases, merge keys and tags act on the events of the parser, before
anything is built: they are what makes YAML dangerous, and an experiment needs none of them.
"""

from __future__ import annotations

import copy
import io
import os
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from pydantic import BaseModel
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

if TYPE_CHECKING:
    from pydantic import ValidationInfo


ALLOW_OUTSIDE = "PBDKIT_ALLOW_OUTSIDE"
"""The environment variable that, where it is not empty, allows files outside the folder."""
ALLOW = (
    "allow it with --allow-outside (in Python pbdkit.load(..., allow_outside=True), or "
    f"{ALLOW_OUTSIDE}=1)"
)
"""The remedy in messages."""


@dataclass(frozen=True)
class Beside:
    """Resolve the names of files relative to the folder of the file that names them.

    Attributes
    ----------
    folder : Path or None
        The folder; None for an experiment that names no files, as in a result, where their content
        takes their place.
    outside : bool
        Whether files outside the folder are allowed, as for a dict that a Python program hands
        over. The environment variable `ALLOW_OUTSIDE` allows them, too.
    """

    folder: Path | None = None
    outside: bool = False

    def path(self, name: Any, what: str) -> Path:
        """Return the path of the regular file of that name.

        Raises ValueError for what is no name, for files outside the folder, links followed, where
        these are not allowed, and where there is none; `what` is the kind of file in messages.
        """
        if not isinstance(name, str) or not name or "\0" in name:
            raise ValueError(f"expected the name of a {what} file, got {name!r:.40}")
        if self.folder is None:
            raise ValueError(
                f"{name:.80}: an experiment that lies in a result or in a store names no files; "
                "their content takes their place"
            )
        path = self.folder / name
        try:
            inside, regular = self.holds(path), path.is_file()
        except OSError as error:
            raise ValueError(f"{str(path)[:80]}...: {error.strerror}") from None
        if not inside:
            folder = self.folder.absolute()
            text = f"{name} lies outside the folder of the file that names it, {folder}"
            raise ValueError(f"{text}; copy it there, or {ALLOW}")
        if not regular:
            how = "is no regular file" if path.exists() else "is not there"
            raise ValueError(f"{path}: {how}; its place counts from the experiment's file")
        return path

    def holds(self, path: Path) -> bool:
        """Whether a path, links followed, lies in the folder or is allowed to lie elsewhere. Raises
        OSError."""
        if self.outside or os.environ.get(ALLOW_OUTSIDE):
            return True
        assert self.folder is not None
        try:
            return path.resolve().is_relative_to(self.folder.resolve())
        except RuntimeError as error:  # links in a circle
            raise OSError(0, str(error)) from None


OF_PROGRAM = Beside(Path(), outside=True)
"""The files that a dict names which a Python program hands over."""


def beside(info: ValidationInfo) -> Beside:
    """Return what the validation context says of files."""
    found: Beside = (info.context or {}).get("beside") or Beside()
    return found


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


ANYBODY = {"version", "name", "seed", "units", "steps", "record"}
"""The keys of an experiment that other files may have too."""
PARTS = ANYBODY | {
    *("lattice", "body", "regions", "neighbours", "rule", "frame", "fracture", "cuts", "initial"),
    *("leaders", "loads", "obstacles", "diagnostics", "solver"),
}
"""All of them."""
EXPERIMENT, SWEEP, FIT = "an experiment", "a sweep", "a fit"


def kind_of(data: Mapping[str, Any]) -> str:
    """What it describes, empty where nobody can tell. Keys that are only misspelt do not matter."""
    if "unknown" in data and "measured" in data:
        return FIT
    if data.keys() & {"lattice", "body", "rule"}:
        return EXPERIMENT
    if data.keys() & {"experiment", "vary", "together"}:
        return SWEEP
    return EXPERIMENT if data.keys() & (PARTS - ANYBODY) or data.keys() <= PARTS else ""


def what_takes(kind: str, name: str) -> str:
    """What to do with a file of that kind."""
    if kind == SWEEP:
        return f"`pbdkit sweep {name}` runs it"
    if kind == EXPERIMENT:
        return f"`pbdkit run {name}` runs it"
    return f"`pbdkit fit {name}` carries it out"


def of_kind(wanted: str, source: Source) -> Source:
    """The source. Raises ExperimentError where it describes something else than is wanted."""
    kind, name = kind_of(source.data), source.name
    if kind == wanted:
        return source
    if kind:
        how = {SWEEP: "; a sweep names it under `experiment`, and under `vary` what differs"}
        more = how.get(wanted, "") if kind == EXPERIMENT else ""
        takes = what_takes(kind, name)
        raise ExperimentError(f"{name}: is {kind}, not {wanted}; {takes}{more}")
    remedy = {
        EXPERIMENT: "one has `lattice`, `body`, `rule` and `steps`; `pbdkit init` writes one",
        SWEEP: "one has `experiment` and `vary`",
        FIT: "one has `experiment`, `unknown` and `measured`",
    }
    first = ", ".join(f"`{key}`" for key in [*source.data][:3])
    raise ExperimentError(f"{name}: is not {wanted}, it has {first}; {remedy[wanted]}")


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


WIDTH = 88


def yaml_text(parts: dict[str, Any]) -> str:
    """The parts as YAML, in their order; numbers come back to the bit."""
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.width = WIDTH
    text = StringIO()
    yaml.dump(parts, text)
    return text.getvalue()
