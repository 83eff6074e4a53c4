"""Sweep files: an experiment, the parameters that vary, and the selected variables and steps.

Members of the sweep are identified by a digest of all data on which their result depends.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import combinations, product
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import xxhash
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError, PluginError, did_you_mean
from pbdkit.hooks import pbdkit_version
from pbdkit.io.layout import SCHEMA_VERSION, reserved_names
from pbdkit.io.members import PARAMETER, STATUS, TEXT
from pbdkit.io.physical import IN_MM
from pbdkit.model.experiment import Experiment, Version
from pbdkit.model.loading import Base, base_source
from pbdkit.model.reading import SWEEP, Source, of_kind, plain, read_file, read_text, with_value
from pbdkit.model.schema import DIALECT
from pbdkit.model.shipped import shipped_names, shipped_text
from pbdkit.model.validation import brief, fault, report
from pbdkit.plugin import Component
from pbdkit.plugin.component import Strict
from pbdkit.plugin.units import TEXT as WITH_UNIT, Quantity, is_unit, magnitude
from pbdkit.seeds import replicate_seeds

MAX_MEMBERS = 100_000
"""Largest number of members.

The validation of a member takes about a millisecond, and a member occupies some kilobytes of memory
during the sweep.
"""
DIGITS = 15
"""Number of significant digits of evenly spaced values.

They are rounded, so that a value is 0.6 and not 0.6000000000000001.
"""


class Range(Strict):
    """`count` values from one to another, both included, with equal differences or equal ratios."""

    from_: Annotated[int | float, Field(alias="from")]
    to: int | float
    count: Annotated[int, Field(ge=2, le=MAX_MEMBERS)]
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _has_a_logarithm(self) -> Self:
        if self.scale == "log" and not (self.from_ > 0 and self.to > 0):
            raise ValueError("`scale: log` requires `from` and `to` above 0")
        return self

    def values(self) -> list[int | float]:
        """Return the values.

        They are integers if both ends and all values between are whole numbers.
        """
        space = np.linspace if self.scale == "linear" else np.geomspace
        numbers = space(float(self.from_), float(self.to), self.count)
        values = [float(f"{value:.{DIGITS}g}") for value in numbers.tolist()]
        are_integers = isinstance(self.from_, int) and isinstance(self.to, int)
        return (
            [int(number) for number in values]
            if are_integers and all(number % 1 == 0 for number in values)
            else values
        )


def _listed(value: Any) -> tuple[Any, ...]:
    """Return the values of one parameter."""
    value = plain(value)
    if isinstance(value, dict):
        if any(isinstance(value.get(end), str) for end in ("from", "to")):
            raise fault(
                "`from` and `to` of a range are numbers without units; list values with units, "
                "for example [6 mm, 10 mm, 14 mm]"
            )
        value = Range.model_validate(value).values()
    if not isinstance(value, list) or not value:
        remedy = f"; write [{brief(value)}]" if isinstance(value, (str, int, float)) else ""
        raise fault(f"expected a list of values or {{from, to, count}}, got {brief(value)}{remedy}")
    value = _in_one_unit(value)
    try:
        texts = [json.dumps(item, sort_keys=True, allow_nan=False) for item in value]
    except (TypeError, ValueError):
        raise fault(
            "expected values that an experiment file can contain: no infinity, no objects"
        ) from None
    if len(set(texts)) < len(texts):
        duplicate = next(item for n, item in enumerate(value) if texts.index(texts[n]) < n)
        raise fault(f"{brief(duplicate)} is listed twice")
    return tuple(value)


def _in_one_unit(values: list[Any]) -> list[Any]:
    """Convert values with different units to the unit of the first value.

    Texts of which one is no number with a known unit are returned unchanged.
    """
    parts = [WITH_UNIT.fullmatch(value) if isinstance(value, str) else None for value in values]
    units = [part[2] for part in parts if part]
    are_numbers = all(
        part or type(value) in (int, float) for part, value in zip(parts, values, strict=True)
    )
    if units and are_numbers and len(units) < len(values):
        plain_value = next(value for part, value in zip(parts, values, strict=True) if not part)
        raise fault(
            f"{brief(plain_value)} has no unit, but other values have one; write all values with "
            "their units, or all as numbers of lattice units"
        )
    if len(units) < len(values) or len(set(units)) == 1:
        return values
    if not all(is_unit(unit) for unit in units):
        return values
    unit = units[0]
    numbers = [magnitude(value, unit, f"quantity in {unit} as '{values[0]}'") for value in values]
    return [f"{number:.{DIGITS}g} {unit}" for number in numbers]


Values = Annotated[
    tuple[Any, ...], BeforeValidator(_listed, json_schema_input_type=Range | list[Any])
]
Times = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False, min_length=1)]


class Keep(Strict):
    """Selection of those variables and steps of each run that the dataset contains.

    `variables` are names of variables, by default all. `times` are `all` recorded steps, the `last`
    step, or a list of steps, which are then recorded.
    """

    variables: Annotated[tuple[str, ...] | None, Field(strict=False, min_length=1)] = None
    times: Literal["all", "last"] | Times = "all"


class Sweep(Strict):
    """An experiment with varied parameters.

    The members are all combinations of the values in `vary`, of the entries of the lists in
    `together`, and of the replicates. Entries with the same position in all lists of `together`
    belong together; replicates differ in their seed. `names` maps paths of parameters to their
    names in the dataset.
    """

    version: Version = 1
    experiment: Base
    vary: dict[str, Values] = Field(default_factory=dict)
    together: dict[str, Values] = Field(default_factory=dict)
    replicates: Annotated[int, Field(ge=1, le=MAX_MEMBERS)] = 1
    keep: Keep = Field(default_factory=Keep)
    names: dict[str, Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]] = Field(
        default_factory=dict
    )

    @model_validator(mode="after")
    def _of_parameters(self) -> Self:
        parameters = [*self.vary, *self.together]
        for path in self.names:
            if path not in parameters:
                hint = did_you_mean(path, parameters)
                raise fault(f"'{path}' is not varied{hint} ({', '.join(parameters)})", key="names")
        if len({*self.names.values()}) < len(self.names):
            raise fault("two parameters have the same name", key="names")
        return self

    @model_validator(mode="after")
    def _together(self) -> Self:
        lengths = {path: len(values) for path, values in self.together.items()}
        if len(set(lengths.values())) > 1:
            text = ", ".join(f"{path} has {length}" for path, length in lengths.items())
            raise fault(f"expected lists of equal length: {text}", key="together")
        paths = [*self.vary, *self.together, *(["seed"] if self.replicates > 1 else [])]
        for first, second in combinations(sorted(paths), 2):
            if f"{second}.".startswith(f"{first}."):
                reason = (
                    "also by replicates" if first == second == "seed" else f"also by '{second}'"
                )
                raise fault(f"'{first}' is varied twice: {reason}", key="vary")
        if self.count > MAX_MEMBERS:
            raise fault(f"{self.count} members exceed the maximum of {MAX_MEMBERS}", key="vary")
        return self

    @property
    def cases(self) -> int:
        """Return the length of the lists of `together`; 1 if there are none."""
        return max(map(len, self.together.values()), default=1)

    @property
    def count(self) -> int:
        """Return the number of members."""
        return prod(map(len, self.vary.values())) * self.cases * self.replicates


def checked(data: Any, source: Source) -> Sweep:
    """Validate the data of a sweep.

    Raises
    ------
    ExperimentError
        If the data are invalid. The message contains the place in the source.
    """
    try:
        return Sweep.model_validate(data)
    except ValidationError as error:
        raise report(error, source) from None


def read_sweep(path: Path) -> tuple[Sweep, Source, Source]:
    """Read a sweep file.

    Returns
    -------
    sweep
        The sweep.
    base
        Source of its experiment.
    source
        Source of the file.

    Raises
    ------
    ExperimentError
        If the file is invalid.
    """
    name = path.as_posix()
    shipped = not path.is_file() and name in shipped_names()
    source = of_kind(SWEEP, read_text(shipped_text(name), name) if shipped else read_file(path))
    sweep = checked(source.data, source)
    return sweep, base_source(path, sweep.experiment, source), source


def sweep_schema() -> dict[str, Any]:
    """Return the JSON Schema of sweep files, without that of their experiments."""
    model_schema = Sweep.model_json_schema(by_alias=True)
    return {"$schema": DIALECT, **model_schema, "title": "pbdkit sweep"}


CASE = "case"
"""Name of the dimension of the lists of `together`."""

REPLICATE = "replicate"
"""Name of the dimension of replicates."""

MESSAGE = "message"
"""Variable with the message of each member."""
UNNAMED_ENDS = (".otherwise", ".type")
"""Ends of paths that are not used in names.

They denote the value outside all regions, and the type of a part.
"""


class MemberSetting(NamedTuple):
    """One parameter with one of its values; `section` is the key of the sweep file."""

    section: str
    path: str
    value: Any


class Coordinate(NamedTuple):
    """Values along a dimension, and their attributes."""

    values: Array
    attributes: dict[str, str]


@dataclass(frozen=True)
class Dimension:
    """One dimension of the grid.

    Parameters
    ----------
    name
        Name of the dimension.
    settings
        Settings at each position along the dimension.
    coordinates
        Coordinates by name.
    """

    name: str
    settings: tuple[tuple[MemberSetting, ...], ...]
    coordinates: dict[str, Coordinate] = field(default_factory=dict)


def dimensions(sweep: Sweep, experiment: Experiment, reserved: Set[str]) -> list[Dimension]:
    """Return the dimensions of `vary`, `together` and `replicates`, in this order.

    Parameters
    ----------
    reserved
        Names that have other meanings in results.

    Raises
    ------
    ExperimentError
        If `reserved` contains a name of the sweep file.
    """
    names = _names(sweep, {*reserved, CASE, REPLICATE, STATUS, MESSAGE})
    result = []

    def labelled(path: str, values: tuple[Any, ...]) -> Coordinate:
        return coordinate(path, values, experiment, sweep.names.get(path, path))

    for path, values in sweep.vary.items():
        settings = tuple((MemberSetting("vary", path, value),) for value in values)
        coordinates = _coordinates(names[path], labelled(path, values))
        result.append(Dimension(names[path], settings, coordinates))
    if sweep.together:
        columns = (
            [MemberSetting("together", key, v) for v in items]
            for key, items in sweep.together.items()
        )
        coordinates = {CASE: Coordinate(np.arange(sweep.cases), {})}
        for path, values in sweep.together.items():
            coordinates[names[path]] = labelled(path, values)
        result.append(Dimension(CASE, tuple(zip(*columns, strict=True)), coordinates))
    if sweep.replicates > 1:
        seeds = replicate_seeds(experiment.seed, sweep.replicates)
        settings = tuple((MemberSetting("replicates", "seed", value),) for value in seeds)
        coordinates = {REPLICATE: Coordinate(np.arange(sweep.replicates), {})}
        coordinates["seed"] = labelled("seed", tuple(seeds))
        result.append(Dimension(REPLICATE, settings, coordinates))
    return result


def _names(sweep: Sweep, reserved: Set[str]) -> dict[str, str]:
    """Return the names of all parameters.

    A name that the sweep file lacks is made automatically.
    """
    for path, name in sweep.names.items():
        if name in reserved:
            text = f"names: {path}: '{name}' has another meaning in results; choose another name"
            raise ExperimentError(text, ("names",))
    unnamed = [path for path in (*sweep.vary, *sweep.together) if path not in sweep.names]
    return sweep.names | names_of(unnamed, {*reserved, *sweep.names.values()})


def places(grid: list[Dimension]) -> Iterator[tuple[tuple[int, ...], tuple[MemberSetting, ...]]]:
    """Yield every position on the grid with its settings; the last dimension varies fastest."""
    for place in product(*(range(len(dimension.settings)) for dimension in grid)):
        groups = (dimension.settings[index] for dimension, index in zip(grid, place, strict=True))
        yield place, tuple(setting for group in groups for setting in group)


def describe(settings: tuple[MemberSetting, ...]) -> str:
    """Return the parameters of a member as text for messages."""
    return (
        ", ".join(f"{setting.path}={brief(setting.value)}" for setting in settings)
        or "the experiment"
    )


def names_of(paths: list[str], reserved: Set[str]) -> dict[str, str]:
    """Return a name for each path: its last word, preceded by further words until it is unique.

    Words are joined by `_`. `otherwise` and `type` at the end of a path are ignored. A name does
    not begin with an index of a list.

    Parameters
    ----------
    paths
        Paths of parameters.
    reserved
        Names that have other meanings.
    """
    tails = {path: _tails(path) for path in paths}
    names: dict[str, str] = {}
    for path, candidates in tails.items():
        tails_of_others = {
            tail for other, other_tails in tails.items() if other != path for tail in other_tails
        }
        name = next(
            (
                candidate
                for candidate in candidates
                if candidate not in tails_of_others and candidate not in reserved
            ),
            candidates[-1],
        )
        while name in reserved or name in names.values():
            name += "_"
        names[path] = name
    return names


def _tails(path: str) -> list[str]:
    """Return the last word, the last two words and so on, as names."""
    end = next((end for end in UNNAMED_ENDS if path.endswith(end)), "")
    words = path.removesuffix(end).split(".")
    tails = ["_".join(words[n:]) for n in reversed(range(len(words)))]
    return [tail for tail in tails if not tail[:1].isdecimal()] or [f"_{tails[-1]}"]


def _coordinates(name: str, texts: Coordinate) -> dict[str, Coordinate]:
    """Return the coordinates of the values of a parameter.

    Numbers are unchanged. Other values are numbered from 0, with an additional coordinate for their
    text.
    """
    if texts.values.dtype.kind != "U":
        return {name: texts}
    numbers = Coordinate(np.arange(len(texts.values)), texts.attributes)
    return {name: numbers, name + TEXT: texts}


def coordinate(
    path: str, values: tuple[Any, ...], experiment: Experiment, long_name: str
) -> Coordinate:
    """Return the values of a parameter and, as attributes, its long name, its path and its unit (if
    it has one).

    If all values are texts with numbers of the same unit, they are converted to numbers.
    """
    attributes = {"long_name": long_name, PARAMETER: path}
    parts = [WITH_UNIT.fullmatch(value) if isinstance(value, str) else None for value in values]
    units = {part[2] if part else "" for part in parts}
    if len(units) == 1 and "" not in units:
        numbers = [float(part[1]) for part in parts if part]
        return Coordinate(np.array(numbers), attributes | {"units": units.pop()})
    array = values_along(values)
    if array.dtype.kind != "U" and (unit := _unit(path, experiment)):
        attributes["units"] = unit
    return Coordinate(array, attributes)


def _unit(path: str, experiment: Experiment) -> str:
    """Return the unit of a parameter; empty if it is unknown."""
    part: Any = experiment
    for word in path.split("."):
        fields = getattr(type(part), "model_fields", {})
        if word in fields:
            quantities = [entry for entry in fields[word].metadata if isinstance(entry, Quantity)]
            if quantities or fields[word].annotation in (int, float):
                return quantities[0].unit_of_numbers if quantities else "1"
            part = getattr(part, word)
        elif isinstance(part, tuple) and word.isdecimal() and int(word) < len(part):
            part = part[int(word)]
        else:
            return ""
    return ""


def values_along(values: tuple[Any, ...]) -> Array:
    """Return the values of a parameter as an array of numbers or texts."""
    if any(type(value) not in (int, float) for value in values):
        return np.array([item if isinstance(item, str) else json.dumps(item) for item in values])
    are_integers = all(type(value) is int and abs(value) < 2**63 for value in values)
    return np.array(values, np.int64 if are_integers else np.float64)


class Job(NamedTuple):
    """Data that are needed to run a member.

    Parameters
    ----------
    key
        Digest of all other fields.
    experiment
        Experiment as JSON, without records and diagnostics that the sweep does not select.
    variables
        Names of the selected variables; None for all.
    times
        Selected recorded steps.
    versions
        Versions of pbdkit and of plugins.
    """

    key: str
    experiment: str
    variables: tuple[str, ...] | None
    times: str | tuple[int, ...]
    versions: dict[str, str]


@dataclass(frozen=True)
class Member:
    """One member of a sweep.

    Parameters
    ----------
    place
        Position of the member on the grid.
    words
        Parameters of the member as text.
    job
        The run.
    """

    place: tuple[int, ...]
    words: str
    job: Job


@dataclass(frozen=True)
class SweepPlan:
    """A sweep with its experiment.

    Parameters
    ----------
    sweep
        The sweep file.
    base, source
        Sources of the experiment and of the sweep.
    components
        Component classes that were passed as Python objects and that the experiment uses.
    """

    sweep: Sweep
    base: Source
    source: Source
    components: tuple[type[Component], ...] = ()

    def experiment(self) -> Experiment:
        """Build the experiment without variations.

        Raises
        ------
        ExperimentError, PluginError
            If it is invalid.
        """
        return Experiment.build(self.base, self.components)

    def grid(self, experiment: Experiment) -> list[Dimension]:
        """Return the dimensions of the sweep."""
        variables = (
            variable for diagnostic in experiment.diagnostics for variable in diagnostic.variables()
        )
        reserved = reserved_names() | {
            name for variable in variables for name in (variable.name, *variable.dims)
        }
        return dimensions(self.sweep, experiment, reserved)

    def members(
        self, grid: list[Dimension], show: Callable[[float], None]
    ) -> Iterator[tuple[Member, Experiment]]:
        """Yield each member with its experiment.

        Parameters
        ----------
        show
            Function that is called with the fraction of members that have been validated.

        Raises
        ------
        ExperimentError, PluginError
            If a member is invalid. The message contains the parameters of the member.
        """
        installed, count = pbdkit_version(), self.sweep.count
        for n, (place, settings) in enumerate(places(grid)):
            show(n / count)
            with named(describe(settings)):
                experiment = self._with(settings)
                versions = {"pbdkit": installed} | experiment.distributions()
                job = job_of(experiment, self.sweep.keep, versions)
            yield Member(place, describe(settings), job), experiment

    def _with(self, settings: Iterable[MemberSetting]) -> Experiment:
        source, defaults = self.base, Experiment.defaults()
        for section, path, value in settings:
            label = self.source.places.get((section, path), section)
            source = with_value(source, path, value, label, defaults)
        return Experiment.build(source, self.components)


@contextmanager
def named(member: str) -> Iterator[None]:
    """Add the parameters of a member to errors in the block."""
    try:
        yield
    except (ExperimentError, PluginError) as error:
        raise type(error)(f"member {member}: {error}", error.where) from None


def job_of(experiment: Experiment, keep: Keep, versions: dict[str, str]) -> Job:
    """Return the job of an experiment.

    Records and diagnostics that the sweep does not select are removed. Because members run in
    parallel, a run uses one thread unless the experiment gives a number of threads.
    """
    data = experiment.model_dump(mode="json", by_alias=True)
    steps = experiment.steps
    if keep.times != "all":
        wanted = (steps,) if keep.times == "last" else keep.times
        recorded_steps = sorted({step for step in wanted if step <= steps}) or [0]
        record = {key: value for key, value in data["record"].items() if key != "every"}
        data["record"] = record | {"at": recorded_steps}
    if keep.variables is not None:
        names = {*keep.variables, *(name.removesuffix(IN_MM) for name in keep.variables)}
        measured = zip(experiment.diagnostics, data["diagnostics"], strict=True)
        data["diagnostics"] = [
            part
            for diagnostic, part in measured
            if "bonds" in diagnostic.needs
            or {variable.name for variable in diagnostic.variables()} & names
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
