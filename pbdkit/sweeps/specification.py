"""The sweep file: an experiment, the parameters that vary, what is kept of each run, and the
members with the digest of each.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import combinations, product
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import xxhash
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from pbdkit.errors import ExperimentError, PluginError, did_you_mean
from pbdkit.io.layout import SCHEMA_VERSION, reserved_names
from pbdkit.io.members import PARAMETER, STATUS, TEXT
from pbdkit.io.physical import IN_MM
from pbdkit.model.experiment import Experiment, Version
from pbdkit.model.reading import SWEEP, Source, of_kind, plain, read_file, read_text, with_value
from pbdkit.model.schema import DIALECT
from pbdkit.model.shipped import Base, base_source, shipped_names, shipped_text
from pbdkit.model.validation import brief, fault, report
from pbdkit.plugin import Component
from pbdkit.plugin.component import Strict
from pbdkit.plugin.units import TEXT as WITH_UNIT
from pbdkit.plugin.units import Quantity

MOST_MEMBERS = 100_000
"""Each takes about a millisecond to be validated, and some kilobytes while the sweep goes on."""
DIGITS = 15
"""Of values between two ends, so that 0.6 is 0.6 and not 0.6000000000000001."""


class Range(Strict):
    """`count` values from one to another, both included, evenly spaced or by equal factors."""

    from_: Annotated[int | float, Field(alias="from")]
    to: int | float
    count: Annotated[int, Field(ge=2, le=MOST_MEMBERS)]
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _has_a_logarithm(self) -> Self:
        if self.scale == "log" and not (self.from_ > 0 and self.to > 0):
            raise ValueError("`scale: log` needs `from` and `to` above 0")
        return self

    def values(self) -> list[int | float]:
        """Whole numbers where both ends are whole and all between them are."""
        between = np.linspace if self.scale == "linear" else np.geomspace
        found = between(float(self.from_), float(self.to), self.count)
        values = [float(f"{value:.{DIGITS}g}") for value in found.tolist()]
        whole = isinstance(self.from_, int) and isinstance(self.to, int)
        return [int(v) for v in values] if whole and all(v % 1 == 0 for v in values) else values


def _listed(value: Any) -> tuple[Any, ...]:
    """The values of one parameter."""
    value = plain(value)
    if isinstance(value, dict):
        value = Range.model_validate(value).values()
    if not isinstance(value, list) or not value:
        raise fault(f"expected a list of values or {{from, to, count}}, got {brief(value)}")
    try:
        texts = [json.dumps(v, sort_keys=True, allow_nan=False) for v in value]
    except (TypeError, ValueError):
        raise fault("takes what an experiment file can hold: no infinity, no objects") from None
    if len(set(texts)) < len(texts):
        twice = next(v for n, v in enumerate(value) if texts.index(texts[n]) < n)
        raise fault(f"{brief(twice)} is given twice")
    return tuple(value)


Values = Annotated[
    tuple[Any, ...], BeforeValidator(_listed, json_schema_input_type=Range | list[Any])
]
Times = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False, min_length=1)]


class Keep(Strict):
    """What is kept of each run: `variables` by name, all if left out; of the recorded steps all,
    the last, or those listed, which are then recorded."""

    variables: Annotated[tuple[str, ...] | None, Field(strict=False, min_length=1)] = None
    times: Literal["all", "last"] | Times = "all"


class Sweep(Strict):
    """Members are the product of the values in `vary`, of the lists in `together`, which are gone
    through at once, and of the replicates, which differ in their seed. `names` are those that
    parameters have in the dataset, by their paths."""

    version: Version = 1
    experiment: Base
    vary: dict[str, Values] = Field(default_factory=dict)
    together: dict[str, Values] = Field(default_factory=dict)
    replicates: Annotated[int, Field(ge=1, le=MOST_MEMBERS)] = 1
    keep: Keep = Field(default_factory=Keep)
    names: dict[str, Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]] = Field(
        default_factory=dict
    )

    @model_validator(mode="after")
    def _of_parameters(self) -> Self:
        varied = [*self.vary, *self.together]
        for path in self.names:
            if path not in varied:
                hint = did_you_mean(path, varied)
                raise fault(f"'{path}' is not varied{hint} ({', '.join(varied)})", key="names")
        if len({*self.names.values()}) < len(self.names):
            raise fault("two parameters have the same name", key="names")
        return self

    @model_validator(mode="after")
    def _together(self) -> Self:
        lengths = {path: len(values) for path, values in self.together.items()}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{path} has {n}" for path, n in lengths.items())
            raise fault(f"lists of one length are wanted: {told}", key="together")
        paths = [*self.vary, *self.together, *(["seed"] if self.replicates > 1 else [])]
        for one, other in combinations(sorted(paths), 2):
            if f"{other}.".startswith(f"{one}."):
                whose = "replicates vary it" if one == other == "seed" else f"so does '{other}'"
                raise fault(f"'{one}' is varied twice: {whose}", key="vary")
        if self.count > MOST_MEMBERS:
            raise fault(f"{self.count} members; at most {MOST_MEMBERS} are taken", key="vary")
        return self

    @property
    def cases(self) -> int:
        """How many entries the lists of `together` have; 1 without any."""
        return max(map(len, self.together.values()), default=1)

    @property
    def count(self) -> int:
        """How many members there are."""
        return prod(map(len, self.vary.values())) * self.cases * self.replicates


def checked(data: Any, source: Source) -> Sweep:
    """The sweep of that data; ExperimentError names what is wrong, with its place in the source."""
    try:
        return Sweep.model_validate(data)
    except ValidationError as error:
        raise report(error, source) from None


def read_sweep(path: Path) -> tuple[Sweep, Source, Source]:
    """The sweep in a file, the source of its experiment, and that of the file itself.

    Raises ExperimentError.
    """
    name = path.as_posix()
    shipped = not path.is_file() and name in shipped_names()
    source = of_kind(SWEEP, read_text(shipped_text(name), name) if shipped else read_file(path))
    sweep = checked(source.data, source)
    return sweep, base_source(path, sweep.experiment, source), source


def sweep_schema() -> dict[str, Any]:
    """The JSON Schema of sweep files; what stands under `experiment` is left to that of
    experiments."""
    described = Sweep.model_json_schema(by_alias=True)
    return {"$schema": DIALECT, **described, "title": "pbdkit sweep"}


CASE, REPLICATE, MESSAGE = "case", "replicate", "message"
NAMELESS = (".otherwise", ".type")
"""Ends of paths that name nothing: a number outside all regions, and the type of a part."""
Array = NDArray[Any]


class MemberSetting(NamedTuple):
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
    settings: tuple[tuple[MemberSetting, ...], ...]
    coordinates: dict[str, Coordinate] = field(default_factory=dict)


def dimensions(sweep: Sweep, experiment: Experiment, taken: Set[str]) -> list[Dimension]:
    """Return those of `vary`, `case`, `replicate`, in this order; `taken` are the names that runs
    have for other things. Raises ExperimentError where a name that is asked for is taken."""
    names = _names(sweep, {*taken, CASE, REPLICATE, STATUS, MESSAGE})
    found = []
    for path, values in sweep.vary.items():
        settings = tuple((MemberSetting("vary", path, value),) for value in values)
        along = _coordinates(names[path], path, values, experiment)
        found.append(Dimension(names[path], settings, along))
    if sweep.together:
        each = ([MemberSetting("together", p, v) for v in vs] for p, vs in sweep.together.items())
        along = {CASE: Coordinate(np.arange(sweep.cases), {})}
        for path, values in sweep.together.items():
            along[names[path]] = coordinate(path, values, experiment)
        found.append(Dimension(CASE, tuple(zip(*each, strict=True)), along))
    if sweep.replicates > 1:
        seeds = replicate_seeds(experiment.seed, sweep.replicates)
        settings = tuple((MemberSetting("replicates", "seed", value),) for value in seeds)
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


def places(grid: list[Dimension]) -> Iterator[tuple[tuple[int, ...], tuple[MemberSetting, ...]]]:
    """Every place on the grid, and what is set there; the last dimension goes fastest."""
    for place in product(*(range(len(d.settings)) for d in grid)):
        every = (d.settings[n] for d, n in zip(grid, place, strict=True))
        yield place, tuple(setting for some in every for setting in some)


def words(settings: tuple[MemberSetting, ...]) -> str:
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


class Job(NamedTuple):
    """What whoever runs a member is told: the experiment as JSON, with all that is not kept left
    out of it, the variables to keep (None: all), the times, and the versions to run it with."""

    key: str
    experiment: str
    variables: tuple[str, ...] | None
    times: str | tuple[int, ...]
    versions: dict[str, str]


@dataclass(frozen=True)
class Member:
    """One place on the grid."""

    place: tuple[int, ...]
    words: str
    job: Job


@dataclass(frozen=True)
class Asked:
    """A sweep as it was asked for: of which experiment, with the classes from Python that it names,
    and the source of the sweep itself."""

    sweep: Sweep
    base: Source
    source: Source
    components: tuple[type[Component], ...] = ()

    def experiment(self) -> Experiment:
        """What is varied, as it is without that. Raises ExperimentError and PluginError."""
        return Experiment.build(self.base, self.components)

    def grid(self, experiment: Experiment) -> list[Dimension]:
        """The dimensions."""
        diagnosed = (v for d in experiment.diagnostics for v in d.variables())
        taken = reserved_names() | {n for v in diagnosed for n in (v.name, *v.dims)}
        return dimensions(self.sweep, experiment, taken)

    def members(
        self, grid: list[Dimension], show: Callable[[float], None]
    ) -> Iterator[tuple[Member, Experiment]]:
        """Each member with its experiment; `show` is told the share that has been validated.

        Raises ExperimentError and PluginError, which name the parameters of the member.
        """
        installed, count = version("pbdkit"), self.sweep.count
        for n, (place, settings) in enumerate(places(grid)):
            show(n / count)
            with named(words(settings)):
                experiment = self._with(settings)
                versions = {"pbdkit": installed} | experiment.distributions()
                job = job_of(experiment, self.sweep.keep, versions)
            yield Member(place, words(settings), job), experiment

    def _with(self, settings: Iterable[MemberSetting]) -> Experiment:
        source, defaults = self.base, Experiment.defaults()
        for section, path, value in settings:
            label = self.source.places.get((section, path), section)
            source = with_value(source, path, value, label, defaults)
        return Experiment.build(source, self.components)


@contextmanager
def named(member: str) -> Iterator[None]:
    """What is wrong in the block is said with the words for the member."""
    try:
        yield
    except (ExperimentError, PluginError) as error:
        raise type(error)(f"member {member}: {error}", error.where) from None


def job_of(experiment: Experiment, keep: Keep, versions: dict[str, str]) -> Job:
    """What is to be run: nothing is recorded or measured that nobody keeps, and on one thread where
    the experiment does not say on how many, as other members run beside it."""
    data = experiment.model_dump(mode="json", by_alias=True)
    steps = experiment.steps
    if keep.times != "all":
        wanted = (steps,) if keep.times == "last" else keep.times
        kept = sorted({step for step in wanted if step <= steps}) or [0]
        data["record"] = {k: v for k, v in data["record"].items() if k != "every"} | {"at": kept}
    if keep.variables is not None:
        asked = {name for kept in keep.variables for name in (kept, kept.removesuffix(IN_MM))}
        measured = zip(experiment.diagnostics, data["diagnostics"], strict=True)
        data["diagnostics"] = [
            part
            for diagnostic, part in measured
            if "bonds" in diagnostic.needs or {v.name for v in diagnostic.variables()} & asked
        ]
    if data["solver"].get("threads") == "auto":
        data["solver"]["threads"] = 1
    text = json.dumps(data)
    content = json.dumps(
        [text, keep.variables, keep.times, sorted(versions.items()), SCHEMA_VERSION]
    )
    return Job(
        xxhash.xxh3_128_hexdigest(content.encode()), text, keep.variables, keep.times, versions
    )
