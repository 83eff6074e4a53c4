"""The sweep file: an experiment, what is varied of it, and what is kept of each run."""

from __future__ import annotations

import json
from itertools import combinations
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    ValidationError,
    model_validator,
)

from pbdkit.errors import did_you_mean
from pbdkit.experiment.base import Base, base_source
from pbdkit.experiment.kinds import SWEEP, of_kind
from pbdkit.experiment.names import Version
from pbdkit.experiment.parts import brief, fault, report
from pbdkit.experiment.schema import DIALECT
from pbdkit.experiment.settings import plain
from pbdkit.experiment.shipped import shipped_names, shipped_text
from pbdkit.experiment.source import Source, read_file, read_text
from pbdkit.interfaces.component import Strict

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
