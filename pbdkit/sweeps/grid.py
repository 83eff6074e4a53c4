"""The dimensions of a sweep, their names and what stands along them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.parts import brief
from pbdkit.interfaces.units import TEXT as WITH_UNIT
from pbdkit.interfaces.units import Quantity
from pbdkit.results.members import PARAMETER, STATUS, TEXT
from pbdkit.sweeps.specification import Sweep

CASE, REPLICATE, MESSAGE = "case", "replicate", "message"
NAMELESS = (".otherwise", ".type")
"""Ends of paths that name nothing: a number outside all regions, and the type of a part."""
Array = NDArray[Any]


class Setting(NamedTuple):
    """One parameter at one of its values; `section` is where the sweep says so."""

    section: str
    path: str
    value: Any


class Coordinate(NamedTuple):
    """Values along a dimension, and their attributes."""

    values: Array
    attributes: dict[str, str]


@dataclass(frozen=True)
class Dimension:
    """One dimension of the grid: its coordinates by name, each with its attributes, and what is set
    at each place of it."""

    name: str
    settings: tuple[tuple[Setting, ...], ...]
    coordinates: dict[str, Coordinate] = field(default_factory=dict)


def dimensions(sweep: Sweep, experiment: Experiment, taken: Set[str]) -> list[Dimension]:
    """Return those of `vary`, `case`, `replicate`, in this order; `taken` are the names that runs
    have for other things. Raises ExperimentError where a name that is asked for is taken."""
    names = _names(sweep, {*taken, CASE, REPLICATE, STATUS, MESSAGE})
    found = []
    for path, values in sweep.vary.items():
        settings = tuple((Setting("vary", path, value),) for value in values)
        along = _coordinates(names[path], path, values, experiment)
        found.append(Dimension(names[path], settings, along))
    if sweep.together:
        each = ([Setting("together", p, v) for v in vs] for p, vs in sweep.together.items())
        along = {CASE: Coordinate(np.arange(sweep.cases), {})}
        for path, values in sweep.together.items():
            along[names[path]] = coordinate(path, values, experiment)
        found.append(Dimension(CASE, tuple(zip(*each, strict=True)), along))
    if sweep.replicates > 1:
        seeds = replicate_seeds(experiment.seed, sweep.replicates)
        settings = tuple((Setting("replicates", "seed", value),) for value in seeds)
        along = {REPLICATE: Coordinate(np.arange(sweep.replicates), {})}
        along["seed"] = coordinate("seed", tuple(seeds), experiment)
        found.append(Dimension(REPLICATE, settings, along))
    return found


def _names(sweep: Sweep, taken: Set[str]) -> dict[str, str]:
    """The names of all parameters: those that the sweep gives, and automatic ones."""
    for path, name in sweep.names.items():
        if name in taken:
            text = f"names: {path}: results have a '{name}' already; give another name"
            raise ExperimentError(text, ("names",))
    others = [path for path in (*sweep.vary, *sweep.together) if path not in sweep.names]
    return sweep.names | names_of(others, {*taken, *sweep.names.values()})


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
    """Return a name for each path: its last word, or as many of the last words, with `_` between
    them, as are needed for a name that no other path has, and nothing else.

    `otherwise` and `type` at the end count for nothing. A name does not begin with a position in
    a list.
    """
    tails = {path: _tails(path) for path in paths}
    names: dict[str, str] = {}
    for path, own in tails.items():
        others = {tail for other, some in tails.items() if other != path for tail in some}
        name = next((t for t in own if t not in others and t not in taken), own[-1])
        while name in taken or name in names.values():
            name += "_"
        names[path] = name
    return names


def _tails(path: str) -> list[str]:
    """The last word, the last two words and so on, as names."""
    end = next((end for end in NAMELESS if path.endswith(end)), "")
    words = path.removesuffix(end).split(".")
    tails = ["_".join(words[n:]) for n in reversed(range(len(words)))]
    return [tail for tail in tails if not tail[:1].isdecimal()] or [f"_{tails[-1]}"]


def _coordinates(
    name: str, path: str, values: tuple[Any, ...], experiment: Experiment
) -> dict[str, Coordinate]:
    """Numbers as they are; all else counted from 0, with the text beside it."""
    along = coordinate(path, values, experiment)
    if along.values.dtype.kind != "U":
        return {name: along}
    counted = Coordinate(np.arange(len(values)), along.attributes)
    return {name: counted, name + TEXT: along}


def coordinate(path: str, values: tuple[Any, ...], experiment: Experiment) -> Coordinate:
    """Return the values of a parameter with its path, and their unit as far as it is known.

    Texts that are all numbers of one unit become these numbers.
    """
    attributes = {"long_name": path, PARAMETER: path}
    parts = [WITH_UNIT.fullmatch(value) if isinstance(value, str) else None for value in values]
    units = {part[2] if part else "" for part in parts}
    if len(units) == 1 and "" not in units:
        numbers = [float(part[1]) for part in parts if part]
        return Coordinate(np.array(numbers), attributes | {"units": units.pop()})
    along = values_along(values)
    if along.dtype.kind != "U" and (unit := _unit(path, experiment)):
        attributes["units"] = unit
    return Coordinate(along, attributes)


def _unit(path: str, experiment: Experiment) -> str:
    """The unit in which a parameter is counted; empty where it is not known."""
    part: Any = experiment
    for word in path.split("."):
        fields = getattr(type(part), "model_fields", {})
        if word in fields:
            found = [m for m in fields[word].metadata if isinstance(m, Quantity)]
            if found or fields[word].annotation in (int, float):
                return found[0].lattice if found else "1"
            part = getattr(part, word)
        elif isinstance(part, tuple) and word.isdecimal() and int(word) < len(part):
            part = part[int(word)]
        else:
            return ""
    return ""


def values_along(values: tuple[Any, ...]) -> Array:
    """The values of a parameter as a coordinate: numbers, or texts."""
    if any(type(value) not in (int, float) for value in values):
        return np.array([v if isinstance(v, str) else json.dumps(v) for v in values])
    whole = all(type(value) is int and abs(value) < 2**63 for value in values)
    return np.array(values, np.int64 if whole else np.float64)
