"""Read, change and write experiment files in YAML 1.2.

The position of every value is stored for messages. Values are changed by their path, as in `--set`
and sweeps. The size and depth of files are limited, and aliases, merge keys and tags are refused,
because they could make YAML dangerous and are not needed. These limits are applied to the events of
the parser, before any object is created.
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

from pbdkit.errors import ExperimentError, dotted, unreadable

if TYPE_CHECKING:
    from pydantic import ValidationInfo


ALLOW_OUTSIDE = "PBDKIT_ALLOW_OUTSIDE"
"""Environment variable that, unless it is empty, permits files outside the folder."""
ALLOW = (
    "allow it with --allow-outside (in Python pbdkit.load(..., allow_outside=True), or "
    f"{ALLOW_OUTSIDE}=1)"
)
"""Remedy in messages about files outside the folder."""


@dataclass(frozen=True)
class FileResolver:
    """Resolve the names of files relative to the folder of the file that refers to them.

    Parameters
    ----------
    folder
        The folder. It is None for an experiment that cannot refer to files; for example, an
        experiment in a result contains the contents of its files instead.
    outside
        Whether files outside the folder are permitted, as for a dict in a Python program. The
        environment variable `ALLOW_OUTSIDE` permits them too.
    """

    folder: Path | None = None
    outside: bool = False

    def path(self, name: Any, what: str) -> Path:
        """Return the path of a regular file.

        Parameters
        ----------
        name
            Name of the file.
        what
            Kind of the file in messages.

        Raises
        ------
        ValueError
            If the name is not a file name, or if the file does not exist. Also if the file lies
            outside the folder, after links are resolved, and files outside are not permitted.
        """
        if not isinstance(name, str) or not name or "\0" in name:
            raise ValueError(f"expected the name of a {what} file, got {name!r:.40}")
        if self.folder is None:
            raise ValueError(
                f"{name:.80}: an experiment in a result or in a store cannot refer to files; "
                "replace the file name by the content"
            )
        path = self.folder / name
        try:
            inside, regular = self.holds(path), path.is_file()
        except OSError as error:
            raise ValueError(f"{str(path)[:80]}...: {error.strerror}") from None
        if not inside:
            folder = self.folder.absolute()
            text = f"{name} lies outside the folder of the file that refers to it, {folder}"
            raise ValueError(f"{text}; copy it there, or {ALLOW}")
        if not regular:
            problem = "is not a regular file" if path.exists() else "does not exist"
            text = "paths are relative to the experiment file"
            raise ValueError(f"{path}: {problem}; {text}")
        return path

    def holds(self, path: Path) -> bool:
        """Return whether a path is permitted.

        It must lie in the folder after links are resolved, unless files outside are permitted.

        Raises
        ------
        OSError
            If the path cannot be resolved.
        """
        if self.outside or os.environ.get(ALLOW_OUTSIDE):
            return True
        assert self.folder is not None
        try:
            return path.resolve().is_relative_to(self.folder.resolve())
        except RuntimeError as error:  # Symbolic links form a circle.
            raise OSError(0, str(error)) from None


OF_PROGRAM = FileResolver(Path(), outside=True)
"""Resolver for a dict in a Python program."""


def file_resolver(info: ValidationInfo) -> FileResolver:
    """Return the file resolver of a validation context."""
    resolver: FileResolver = (info.context or {}).get("files") or FileResolver()
    return resolver


MAX_BYTES = 2**20
"""Maximum size of an experiment file in bytes."""
MAX_DEPTH = 32
"""Maximum depth of nested values."""
MAX_NODES = 20_000
"""Maximum number of values."""
Where = tuple[str | int, ...]
"""Type of the path of a value."""


@dataclass
class Source:
    """Raw data of an experiment, and the place of each value in its file.

    Parameters
    ----------
    name
        Name of the file.
    data
        Raw data.
    places
        Place (file:line:column) of each value, by its path.
    files
        Resolver for the files to which the experiment refers.
    """

    name: str = ""
    data: Any = None
    places: dict[Where, str] = field(default_factory=dict)
    files: FileResolver = field(default_factory=FileResolver)

    def message(self, where: Sequence[str | int], text: str) -> str:
        """Return ``file:line:column: field: text``.

        For a field that does not exist, it contains the place of the parent.
        """
        path = tuple(where)
        while path and path not in self.places:
            path = path[:-1]
        parts = [self.places.get(path, self.name), dotted(where), text]
        return ": ".join(part for part in parts if part)


def read_file(path: Path) -> Source:
    """Read the experiment in a file.

    Raises
    ------
    ExperimentError
        If the file cannot be read. The message contains the place and the remedy.
    StorageError
        If the disk fails.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise unreadable(path, error) from None
    if raw.startswith((b"\x89HDF", b"CDF\x01", b"CDF\x02", b"CDF\x05")):
        raise ExperimentError(
            f"{path}: is a result, not an experiment; `pbdkit plot {path}` draws it, and "
            "pbdkit.rerun(pbdkit.open(...)) runs it again"
        )
    if raw.startswith(b"SQLite format 3"):
        raise ExperimentError(
            f"{path}: is the store of an unfinished run or of a sweep, not an experiment; `pbdkit "
            "resume OUT.nc` continues a run, `pbdkit sweep` a sweep"
        )
    if len(raw) > MAX_BYTES:
        raise ExperimentError(
            f"{path}: is larger than 1 MiB, the maximum for experiments; move tables to CSV files"
        )
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if 0 in raw and not raw.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
            raise ExperimentError(f"{path}: is not text, and not an experiment") from None
        raise ExperimentError(
            f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8"
        ) from None
    source = read_text(text, str(path))
    source.files = FileResolver(path.parent)
    return source


def read_text(text: str, name: str) -> Source:
    """Read an experiment from text; `name` is the name of the source in messages.

    Raises
    ------
    ExperimentError
        If the text is not a valid experiment file. The message contains the place and the remedy.
    """
    source = Source(name)
    source.data = parsed(text, source)
    if source.data is None:
        raise ExperimentError(f"{name}: is empty; `pbdkit init` writes an experiment to start from")
    if not isinstance(source.data, dict):
        raise ExperimentError(f"{name}:1:1: expected keys such as `lattice:` at the top level")
    return source


def parsed(text: str, source: Source) -> Any:
    """Return the data of YAML text, and store the places of its values in the source.

    Raises
    ------
    ExperimentError
        If the text is not valid YAML, or exceeds the limits.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Scanner = _Scanner
    try:
        return _Reading(yaml, text, source).document()
    except ReaderError as error:
        prefix = text[: error.position]
        place = f"{prefix.count(chr(10)) + 1}:{error.position - prefix.rfind(chr(10))}"
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
    """Return the remedy for frequent errors."""
    what, context = (str(getattr(error, name, "") or "") for name in ("problem", "context"))
    mark = getattr(error, "context_mark", None)
    place = f" at {mark.line + 1}:{mark.column + 1}" if mark else ""
    if "\\t" in what:
        return "; indent with spaces, not with tabs"
    if "flow sequence" in context or "flow mapping" in context:
        bracket = "[" if "sequence" in context else "{"
        return f"; the '{bracket}'{place} is not closed, or a comma is missing before"
    if "quoted scalar" in context:
        return f"; the quotation mark{place} is not closed"
    if "mapping values" in what:
        return "; put text with a colon in quotes, and begin each key on a new line"
    if "block" in what or "block" in context:
        return f"; indent all entries of a group equally, as those that begin{place}"
    return ""


class _Scanner(Scanner):
    """Scanner that stores no keys beyond the maximum depth.

    The standard scanner compares every character with all stored keys, which takes too long for
    deeply nested text.
    """

    def save_possible_simple_key(self) -> None:
        """Store a possible key up to the maximum depth."""
        if self.flow_level <= MAX_DEPTH:
            super().save_possible_simple_key()


class _Reading:
    """Construction of data from the events of the parser, with their places."""

    def __init__(self, yaml: YAML, text: str, source: Source) -> None:
        self._yaml, self._source, self._nodes = yaml, source, 0
        self._events = (self._allowed(event) for event in yaml.parse(io.StringIO(text)))

    def document(self) -> Any:
        """Return the data of the single document, or None."""
        data, documents = None, 0
        for event in self._events:
            if isinstance(event, DocumentStartEvent):
                if event.version or event.tags:
                    self._refuse(event, "directives (%YAML, %TAG) are not supported")
                documents += 1
                if documents > 1:
                    self._refuse(event, "a second document; a file contains one experiment")
                data = self._value(next(self._events), ())
        return data

    def _allowed(self, event: Any) -> Any:
        if not isinstance(event, NodeEvent):
            return event
        self._nodes += 1
        if isinstance(event, AliasEvent):
            self._refuse(event, f"aliases (*{event.anchor}) are not supported; repeat the value")
        if self._nodes > MAX_NODES:
            self._refuse(event, f"more than {MAX_NODES} values, the maximum for experiments")
        tag = getattr(event, "tag", None)
        if str(tag or "!") != "!":
            self._refuse(event, f"tags ({tag}) are not supported")
        if isinstance(event, ScalarEvent):
            if event.value == "<<" and event.implicit[0]:
                self._refuse(event, "merge keys (<<) are not supported; repeat the keys")
            if any("\ud800" <= c <= "\udfff" for c in event.value):
                self._refuse(event, "an unpaired surrogate (\\ud800 to \\udfff) is not supported")
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
        result: dict[str, Any] = {}
        for event in self._inner():
            if not isinstance(event, ScalarEvent):
                self._refuse(event, "a key must be a word")
            key, places = str(event.value), self._source.places
            if key in result:
                first = places[(*where, key)]
                text = f"{dotted((*where, key))}: occurs twice, first at {first}; remove one"
                self._refuse(event, text)
            places[(*where, key)] = self._place(event)
            result[key] = self._value(next(self._events), (*where, key))
        return result

    def _inner(self) -> Iterator[Any]:
        """Yield the events in a collection up to its end.

        The caller must read the events of nested collections itself.
        """
        while not isinstance(event := next(self._events), CollectionEndEvent):
            yield event

    def _place(self, event: Any) -> str:
        mark = event.start_mark
        return f"{self._source.name}:{mark.line + 1}:{mark.column + 1}"

    def _refuse(self, event: Any, what: str) -> NoReturn:
        raise ExperimentError(f"{self._place(event)}: {what}")


COMMON_KEYS = {"version", "name", "seed", "units", "steps", "record"}
"""Keys of experiments that files of sweeps and fits may have too."""
PARTS = COMMON_KEYS | {
    *("lattice", "body", "regions", "neighbours", "rule", "frame", "fracture", "cuts", "initial"),
    *("leaders", "loads", "obstacles", "operations", "diagnostics", "solver"),
}
"""Keys that may occur in experiments."""
EXPERIMENT = "an experiment"
"""Kind of an experiment file in messages."""
SWEEP = "a sweep"
"""Kind of a sweep file in messages."""
FIT = "a fit"
"""Kind of a fit file in messages."""


def kind_of(data: Mapping[str, Any]) -> str:
    """Return the kind of a file, determined from its keys, or an empty string.

    Misspelt keys are ignored.
    """
    if "unknown" in data and "measured" in data:
        return FIT
    if data.keys() & {"lattice", "body", "rule"}:
        return EXPERIMENT
    if data.keys() & {"experiment", "vary", "together"}:
        return SWEEP
    return EXPERIMENT if data.keys() & (PARTS - COMMON_KEYS) or data.keys() <= PARTS else ""


def command_for(kind: str, name: str) -> str:
    """Return the command of pbdkit that reads files of a kind."""
    if kind == SWEEP:
        return f"`pbdkit sweep {name}` runs it"
    if kind == EXPERIMENT:
        return f"`pbdkit run {name}` runs it"
    return f"`pbdkit fit {name}` runs it"


def of_kind(required: str, source: Source) -> Source:
    """Return the source if it is of the required kind.

    Raises
    ------
    ExperimentError
        If the source is of another kind.
    """
    kind, name = kind_of(source.data), source.name
    if kind == required:
        return source
    if kind:
        hints = {SWEEP: "; a sweep refers to it by `experiment`, and lists parameters in `vary`"}
        hint = hints.get(required, "") if kind == EXPERIMENT else ""
        command = command_for(kind, name)
        raise ExperimentError(f"{name}: is {kind}, not {required}; {command}{hint}")
    remedy = {
        EXPERIMENT: "it requires `lattice`, `body`, `rule`, `steps`; `pbdkit init` writes one",
        SWEEP: "it requires `experiment` and `vary`",
        FIT: "it requires `experiment`, `unknown` and `measured`",
    }
    first = ", ".join(f"`{key}`" for key in [*source.data][:3])
    raise ExperimentError(f"{name}: is not {required}, it has {first}; {remedy[required]}")


Settings = str | Iterable[str] | Mapping[str, Any]
"""Type of changes of an experiment."""
EXPECTED = "settings: expected a map, as {'steps': 20}, or a list of texts, as ['steps=20']"
"""Message about settings of a wrong type."""
MAX_LABEL = 80
"""Maximum number of characters of a setting in messages."""


def with_settings(source: Source, settings: Settings, defaults: Mapping[str, Any]) -> Source:
    """Return a copy of the source with some values set.

    Parameters
    ----------
    source : Source
        Raw data.
    settings : mapping, str, or iterable of str
        A map changes the values of its keys at any depth, for example ``{"rule": {"relaxation":
        0.3}}`` or ``{"rule.relaxation": 0.3}``. A map with a `type` replaces the whole part. A text
        has the form ``path=value``.
    defaults : mapping
        Initial values of parts that the source does not have.

    Raises
    ------
    ExperimentError
        If a setting is malformed, or its path does not exist.
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
        parts, current = str(key).split("."), data
        path = (*where, *parts)
        for part in parts:
            entries = dict(enumerate(current)) if isinstance(current, list) else current
            is_map = isinstance(entries, Mapping)
            current = entries.get(part, entries.get(_position(part))) if is_map else None
        if isinstance(value, Mapping) and "type" not in value and isinstance(current, (dict, list)):
            yield from _leaves(current, value, path)
        else:
            yield path, value


def plain(value: Any) -> Any:
    """Convert arrays and components to the values that a file would contain."""
    # The methods are called without importing pydantic or numpy, so that an error in a name is
    # reported quickly.
    if hasattr(value, "model_dump") and not isinstance(value, type):
        return value.model_dump(mode="json", by_alias=True)
    if hasattr(value, "tolist") and not isinstance(value, type):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value


def with_setting(source: Source, setting: str, defaults: Mapping[str, Any]) -> Source:
    """Return a copy of the source with one value set.

    Parameters
    ----------
    source
        Raw data.
    setting
        ``path=value`` with a dotted path, list indices from 0 and a YAML value.
    defaults
        Initial values of parts that the source does not have.

    Raises
    ------
    ExperimentError
        If the setting is malformed, or its path does not exist.
    """
    label = f"setting {setting if len(setting) <= MAX_LABEL else setting[:MAX_LABEL] + '...'}"
    path, equals, value = setting.partition("=")
    if not equals or not path:
        raise ExperimentError(f"{label}: expected PATH=VALUE, for instance rule.K=-0.002")
    return with_value(source, path, parsed(value, Source(label)), label, defaults)


def with_value(
    source: Source, path: str, value: Any, label: str, defaults: Mapping[str, Any]
) -> Source:
    """Return a copy of the source with another value at a dotted path.

    `label` is the place of the value in messages.
    """
    where = tuple(map(_position, path.split(".")))
    places = {k: place for k, place in source.places.items() if k[: len(where)] != where}
    changed = Source(source.name, copy.deepcopy(source.data), places, source.files)
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
        raise ExperimentError(f"{label}: '{part}' is given as a key below a single value; omit it")
    if not isinstance(part, int) or part >= len(data):
        text = f"'{part}' is not an index of a list of {len(data)}; indices are counted from 0"
        raise ExperimentError(f"{label}: {text}")
    return data[part]


WIDTH = 88
"""Maximum number of characters in a line."""


def yaml_text(parts: dict[str, Any]) -> str:
    """Return the parts as YAML, in their order and with all digits of numbers."""
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.width = WIDTH
    text = StringIO()
    yaml.dump(parts, text)
    return text.getvalue()
