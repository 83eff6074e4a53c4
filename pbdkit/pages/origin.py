"""What was run, and how it is run again."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from pbdkit.drawing.labels import LONGEST
from pbdkit.errors import PbdkitError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.source import Source
from pbdkit.experiment.yaml_text import yaml_text
from pbdkit.registry.retired import retired_parts
from pbdkit.results.carried import carried

if TYPE_CHECKING:
    import xarray

Path = tuple[str | int, ...]
MOST_TRIED = 150
"""Of so many keys it is tried whether they can be left out."""
PARTS = ("lattice", "body", "neighbours", "rule", "frame", "fracture", "solver")


def facts(dataset: xarray.Dataset) -> list[list[str]]:
    """A name and a value each."""
    said, parts = dataset.attrs, carried(dataset, "experiment")
    times = dataset["time"].values
    sizes = {str(name): size for name, size in dataset.sizes.items()}
    ended = ": ".join(filter(None, (str(said.get(n, "")) for n in ("status", "stop_reason"))))
    kinds = {name: _type(parts.get(name)) for name in PARTS}
    found = {
        "ended": ended,
        "created": str(said.get("created", "")),
        "by": made_by(dataset),
        **{name: kind for name, kind in kinds.items() if kind not in ("", "none")},
        "particles": f"{sizes.get('particle', 0)}",
        "bonds": f"{sizes['bond']}" if sizes.get("bond") else "",
        "steps": str(parts.get("steps", "")),
        "recorded": f"{len(times)} steps, {times[0]} to {times[-1]}",
    }
    return [[name, value] for name, value in found.items() if value]


def made_by(dataset: xarray.Dataset) -> str:
    """pbdkit and the plugins, with their versions."""
    given = {"pbdkit": dataset.attrs.get("pbdkit_version", "")} | carried(dataset, "plugins")
    return ", ".join(f"{name} {version}".strip() for name, version in given.items())


def _type(part: Any) -> str:
    return str(part.get("type", "")) if isinstance(part, dict) else ""


def experiment_text(parts: dict[str, Any]) -> str:
    """The experiment, or the sweep, as YAML; of an experiment without what is default, as far as
    that can be told."""
    can_be_brief = "lattice" in parts and not retired_parts(parts)
    return yaml_text(_brief(parts) if can_be_brief else parts)


def _brief(parts: dict[str, Any]) -> dict[str, Any]:
    """Without every key that can be left out, so that the same experiment is built."""
    left: list[Path] = []
    for path in list(_paths(parts))[:MOST_TRIED]:
        inside = any(path[: len(gone)] == gone for gone in left)
        if not inside and _same(_without(parts, [*left, path]), parts):
            left.append(path)
    return dict(_without(parts, left))


def _paths(part: Any, path: Path = ()) -> Iterator[Path]:
    """Of every key but types, those of the whole before those in it."""
    if isinstance(part, dict):
        yield from ((*path, key) for key in part if key not in ("version", "name", "type"))
    inner = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in inner:
        if isinstance(value, dict | list):
            yield from _paths(value, (*path, key))


def _without(part: Any, left: list[Path], path: Path = ()) -> Any:
    if isinstance(part, dict):
        kept = {k: v for k, v in part.items() if (*path, k) not in left}
        return {key: _without(value, left, (*path, key)) for key, value in kept.items()}
    if isinstance(part, list):
        return [_without(value, left, (*path, n)) for n, value in enumerate(part)]
    return part


def _same(brief: dict[str, Any], parts: dict[str, Any]) -> bool:
    try:
        found: dict[str, Any] = Experiment.build(Source("page", brief)).model_dump(
            mode="json", by_alias=True
        )
    except PbdkitError:  # what is needed, or a part that is not installed here
        return False
    return found == parts


def title_of(dataset: xarray.Dataset) -> str:
    """What the page is called."""
    return str(dataset.attrs.get("title", ""))[:LONGEST] or "a result without a title"


def file_name(title: str) -> str:
    """A plain name for the files of an experiment."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", title).strip("-")[:60] or "experiment"
