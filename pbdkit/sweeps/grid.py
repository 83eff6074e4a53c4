"""The dimensions of a sweep, their names and what stands along them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Set
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.parts import brief
from pbdkit.sweeps.specification import Sweep

CASE, REPLICATE, STATUS, MESSAGE = "case", "replicate", "status", "message"
TEXT = "_text"
"""Added to the name of a dimension for the values that it counts, as text."""
Array = NDArray[Any]


class Setting(NamedTuple):
    """One parameter at one of its values; `section` is where the sweep says so."""

    section: str
    path: str
    value: Any


@dataclass(frozen=True)
class Dimension:
    """One dimension of the grid: its coordinates by name, and what is set at each place of it."""

    name: str
    settings: tuple[tuple[Setting, ...], ...]
    coordinates: dict[str, Array] = field(default_factory=dict)


def dimensions(sweep: Sweep, seed: int, taken: Set[str]) -> list[Dimension]:
    """Those of `vary`, `case`, `replicate`, in this order; `seed` is that of the experiment, and
    `taken` are the names that runs have for other things."""
    names = names_of([*sweep.vary, *sweep.together], {*taken, CASE, REPLICATE, STATUS, MESSAGE})
    found = []
    for path, values in sweep.vary.items():
        settings = tuple((Setting("vary", path, value),) for value in values)
        found.append(Dimension(names[path], settings, _coordinates(names[path], values)))
    if sweep.together:
        each = ([Setting("together", p, v) for v in vs] for p, vs in sweep.together.items())
        along = {CASE: np.arange(sweep.cases)}
        along |= {names[path]: values_along(values) for path, values in sweep.together.items()}
        found.append(Dimension(CASE, tuple(zip(*each, strict=True)), along))
    if sweep.replicates > 1:
        seeds = replicate_seeds(seed, sweep.replicates)
        settings = tuple((Setting("replicates", "seed", value),) for value in seeds)
        along = {REPLICATE: np.arange(sweep.replicates), "seed": np.array(seeds)}
        found.append(Dimension(REPLICATE, settings, along))
    return found


def places(grid: list[Dimension]) -> Iterator[tuple[tuple[int, ...], tuple[Setting, ...]]]:
    """Every place on the grid, and what is set there; the last dimension goes fastest."""
    for place in product(*(range(len(d.settings)) for d in grid)):
        every = (d.settings[n] for d, n in zip(grid, place, strict=True))
        yield place, tuple(setting for some in every for setting in some)


def words(settings: tuple[Setting, ...]) -> str:
    """What a member is called in messages: its parameters."""
    return ", ".join(f"{s.path}={brief(s.value)}" for s in settings) or "the experiment"


def replicate_seeds(seed: int, count: int) -> list[int]:
    """The k-th is ``SeedSequence(seed).spawn(count)[k].generate_state(1)[0]``."""
    return [int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(count)]


def names_of(paths: list[str], taken: Set[str]) -> dict[str, str]:
    """The last word of each path; all of it, with `_` for `.`, where two end alike, where it ends
    in a position of a list, and where something else has the name."""
    last = [path.rpartition(".")[2] for path in paths]
    names: dict[str, str] = {}
    for path, word in zip(paths, last, strict=True):
        plain = last.count(word) == 1 and not word.isdecimal() and word not in taken
        name = word if plain else path.replace(".", "_")
        while name in taken or name in names.values():
            name += "_"
        names[path] = name
    return names


def _coordinates(name: str, values: tuple[Any, ...]) -> dict[str, Array]:
    """Numbers as they are; all else counted from 0, with the text beside it."""
    along = values_along(values)
    if along.dtype.kind != "U":
        return {name: along}
    return {name: np.arange(len(values)), name + TEXT: along}


def type_alone(text: str) -> str:
    """Of the text of a part that says nothing but its type, that; else the text as it is."""
    with suppress(ValueError, RecursionError):
        part = json.loads(text)
        if isinstance(part, dict) and part.keys() == {"type"}:
            return str(part["type"])
    return text


def values_along(values: tuple[Any, ...]) -> Array:
    """The values of a parameter as a coordinate: numbers, or texts."""
    if any(type(value) not in (int, float) for value in values):
        return np.array([v if isinstance(v, str) else json.dumps(v) for v in values])
    whole = all(type(value) is int and abs(value) < 2**63 for value in values)
    return np.array(values, np.int64 if whole else np.float64)
