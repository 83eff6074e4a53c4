"""Reads an experiment file: YAML 1.2 with the place of every value, and no way to blow up.

The guard works on the events of the parser, before anything is built: size, depth, aliases, merge
keys and tags are what makes YAML dangerous, and an experiment needs none of them.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    NodeEvent,
    ScalarEvent,
)
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

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
        if path.stat().st_size > MAX_BYTES:
            raise ExperimentError(f"{path}: is larger than 1 MiB, which no experiment needs")
        raw = path.read_bytes()
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror}") from None
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


def read_value(text: str, name: str) -> Any:
    """One YAML value, as in ``--set PATH=VALUE``."""
    return _read(text, Source(name))


def _read(text: str, source: Source) -> Any:
    yaml = YAML(typ="safe", pure=True)
    try:
        _guard(yaml, text, source.name)
        node = yaml.compose(io.StringIO(text))
        return None if node is None else _build(node, (), source, yaml)
    except ReaderError as error:
        before = text[: error.position]
        place = f"{before.count(chr(10)) + 1}:{error.position - before.rfind(chr(10))}"
        what = f"the character {error.character!r} is not allowed in YAML"
        raise ExperimentError(f"{source.name}:{place}: {what}") from None
    except YAMLError as error:
        raise _syntax_error(error, source.name) from None


def _guard(yaml: YAML, text: str, name: str) -> None:
    depth = documents = nodes = 0
    for event in yaml.parse(io.StringIO(text)):
        line = f"{name}:{event.start_mark.line + 1}:{event.start_mark.column + 1}"
        if isinstance(event, AliasEvent):
            raise ExperimentError(f"{line}: aliases (*{event.anchor}) are not taken; write it out")
        nodes += isinstance(event, NodeEvent)
        if nodes > MAX_NODES:
            raise ExperimentError(
                f"{line}: more than {MAX_NODES} values, which no experiment needs"
            )
        if isinstance(event, DocumentStartEvent):
            if event.version or event.tags:
                raise ExperimentError(f"{line}: directives (%YAML, %TAG) are not taken")
            documents += 1
            if documents > 1:
                raise ExperimentError(f"{line}: a second document; one file holds one experiment")
        tag = getattr(event, "tag", None)
        if isinstance(event, NodeEvent) and str(tag or "!") != "!":
            raise ExperimentError(f"{line}: tags ({tag}) are not taken")
        if isinstance(event, ScalarEvent) and event.value == "<<" and event.implicit[0]:
            raise ExperimentError(f"{line}: merge keys (<<) are not taken; write the keys out")
        if isinstance(event, CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                raise ExperimentError(f"{line}: nested more than {MAX_DEPTH} levels deep")
        elif isinstance(event, CollectionEndEvent):
            depth -= 1


def _build(node: Any, where: Where, source: Source, yaml: YAML) -> Any:
    source.places.setdefault(where, _place(node, source))
    if isinstance(node, SequenceNode):
        return [_build(item, (*where, n), source, yaml) for n, item in enumerate(node.value)]
    if isinstance(node, MappingNode):
        return _build_map(node, where, source, yaml)
    if str(node.tag).rsplit(":", 1)[-1] not in ("null", "bool", "int", "float"):
        return node.value
    try:
        return yaml.constructor.construct_object(node)
    except ValueError:
        what = f"{dotted(where)}: '{node.value[:20]}...' is too long for a number"
        raise ExperimentError(f"{_place(node, source)}: {what}") from None


def _build_map(node: MappingNode, where: Where, source: Source, yaml: YAML) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key_node, value_node in node.value:
        place = _place(key_node, source)
        if not isinstance(key_node, ScalarNode):
            raise ExperimentError(f"{place}: a key must be a word")
        key = str(key_node.value)
        if key in found:
            first = source.places[(*where, key)]
            raise ExperimentError(
                f"{place}: {dotted((*where, key))}: given twice, first at {first}"
            )
        source.places[(*where, key)] = place
        found[key] = _build(value_node, (*where, key), source, yaml)
    return found


def _place(node: Any, source: Source) -> str:
    return f"{source.name}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"


def _syntax_error(error: YAMLError, name: str) -> ExperimentError:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
    what = getattr(error, "problem", None) or str(error).splitlines()[0]
    return ExperimentError(f"{place}: not valid YAML: {what}")
