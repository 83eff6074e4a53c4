"""The strength fit file: an experiment, what is unknown of its bonds, and how repeats broke."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, ValidationInfo, model_validator

from pbdkit.experiment.base import Base, base_source
from pbdkit.experiment.beside import OF_PROGRAM
from pbdkit.experiment.columns import read_columns
from pbdkit.experiment.kinds import FIT, of_kind
from pbdkit.experiment.names import Version
from pbdkit.experiment.parts import fault, report
from pbdkit.experiment.source import Source, read_file
from pbdkit.fitting.measurements import Positive
from pbdkit.fitting.specification import FOLDER, Bounds
from pbdkit.interfaces.component import Strict
from pbdkit.stepping.state import Floats

KIND = "strength"
"""What a strength fit says under `kind`."""
FEWEST = 3
"""So many specimens have to break: of fewer nothing is known of the scatter."""


class Peaks(Strict):
    """How far each specimen bore the load, one number each: `peaks` themselves, or the `column` of
    a CSV `file` beside this one. `of` says what they are: the `force` or the `displacement` of the
    leader group `group` at the peak, or `factor`, the share of the experiment's own load.

    In place of `column`, `curve` names the columns specimen, displacement and force of whole
    curves, of which the peaks are taken. `broke` is 1 where a specimen broke and 0 where its test
    ended before; a list, or the name of a column. Without it all broke. Forces are those of a body
    of `youngs_modulus` and `thickness`; `group` is by default the one that moves farthest.
    """

    file: str | None = None
    column: str = "peak"
    curve: Annotated[tuple[str, str, str] | None, Field(strict=False)] = None
    peaks: Annotated[tuple[float, ...], Field(strict=False)] = ()
    broke: str | Annotated[tuple[Annotated[int, Field(ge=0, le=1)], ...], Field(strict=False)] = ()
    of: Literal["force", "displacement", "factor"]
    group: Annotated[int, Field(ge=0)] | None = None
    youngs_modulus: Positive = 1.0
    thickness: Positive = 1.0
    _values: Any = None
    _broke: Any = None

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> Self:
        if (self.file is None) == (not self.peaks):
            raise fault("needs either a file, or the peaks themselves", key="file")
        values, broke = self._columns(info) if self.file is not None else self._given()
        for n, value in enumerate(values):
            if not 0.0 < value < np.inf:
                text = f"peaks are above 0; that of specimen {n + 1} is {value:g}"
                raise fault(text, key="file" if self.file else "peaks")
        if broke.sum() < FEWEST:
            raise fault(
                f"{int(broke.sum())} specimens broke; scatter needs at least {FEWEST}",
                key="file" if self.file else "peaks",
            )
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "_broke", broke)
        return self

    def _given(self) -> tuple[Floats, Any]:
        if isinstance(self.broke, str):
            raise fault("names a column, and there is no file; give a list of 0 and 1", key="broke")
        broke = np.array(self.broke or [1] * len(self.peaks), bool)
        if len(broke) != len(self.peaks):
            text = f"{len(broke)} numbers for {len(self.peaks)} peaks; give one each"
            raise fault(text, key="broke")
        return np.array(self.peaks), broke

    def _columns(self, info: ValidationInfo) -> tuple[Floats, Any]:
        if self.broke and not isinstance(self.broke, str):
            raise fault("is a list, and peaks are in a file; name its column", key="broke")
        more = (self.broke,) if isinstance(self.broke, str) else ()
        if self.curve is None:
            rows = np.array(read_columns(self.file, info, (self.column, *more)))
        else:
            if self.of == "factor":
                raise fault("curves tell forces and displacements, no factor", key="of")
            rows = _of_curves(
                np.array(read_columns(self.file, info, (*self.curve, *more))), self.of
            )
        return rows[:, 0], rows[:, 1] != 0.0 if more else np.ones(len(rows), bool)

    @property
    def values(self) -> Floats:
        """(specimen,): the peaks."""
        return np.asarray(self._values)

    @property
    def failed(self) -> Any:
        """(specimen,): whether it broke."""
        return self._broke


def _of_curves(rows: Floats, of: str) -> Floats:
    """Of each specimen its largest force, or the displacement there, and the rest of the row."""
    kept = []
    for specimen in np.unique(rows[:, 0]):
        own = rows[rows[:, 0] == specimen]
        top = own[own[:, 2].argmax()]
        kept.append([top[2] if of == "force" else top[1], *top[3:]])
    return np.array(kept)


class StrengthFit(Strict):
    """Looks for the strength of bonds and its scatter, the `unknown` parameters between bounds, in
    repeats of one experiment.

    `law` is the distribution of strengths, by default that of the experiment's fracture. `method`:
    `likelihood` counts the first bond that breaks as the failure of the specimen, `simulation`
    compares with specimens that are torn, `auto` takes the second where the first does not hold.
    So many specimens are torn to `check` that, so many sets of them make the `simulations`; `seed`
    is of the random numbers of both.
    """

    version: Version = 1
    kind: Literal["strength"]
    experiment: Base
    law: Literal["weibull", "uniform"] | None = None
    unknown: Annotated[dict[str, Bounds], Field(min_length=1)]
    measured: Peaks
    method: Literal["auto", "likelihood", "simulation"] = "auto"
    check: Annotated[int, Field(ge=0, le=1000)] = 8
    simulations: Annotated[int, Field(ge=100, le=1_000_000)] = 2000
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0

    @model_validator(mode="after")
    def _positive(self) -> Self:
        for path, (low, _) in self.unknown.items():
            if low <= 0.0:
                raise fault(f"strengths and their scatter are above 0; got {low:g}", key=path)
        return self


def is_strength_fit(description: Mapping[str, Any] | str | Path) -> bool:
    """Whether a fit file, a shipped fit or a dict describes a strength fit: by its `kind`. False
    where nothing can be read there; whoever reads it next says why."""
    if isinstance(description, Mapping):
        return description.get("kind") == KIND
    path = _file(description)
    return path.is_file() and dict(of_kind(FIT, read_file(path)).data).get("kind") == KIND


def described_strength_fit(
    description: Mapping[str, Any] | str | Path, *, given: bool
) -> tuple[StrengthFit, Source]:
    """The strength fit in a file, of a shipped name or in a dict, and the source of its experiment;
    none is looked for where one is `given`. Raises ExperimentError."""
    if isinstance(description, Mapping):
        path, source = Path("fit"), Source("fit", dict(description), {}, OF_PROGRAM)
    else:
        path = _file(description)
        source = of_kind(FIT, read_file(path))
    if given and isinstance(source.data, dict):
        data = {"experiment": "", **source.data}
        source = Source(source.name, data, source.places, source.beside)
    try:
        fit = StrengthFit.model_validate(source.data, context={"beside": source.beside})
    except ValidationError as error:
        raise report(error, source) from None
    return fit, source if given else base_source(path, fit.experiment, source)


def _file(name: str | Path) -> Path:
    shipped = FOLDER / f"{name}.yaml"
    return shipped if not Path(name).is_file() and shipped.is_file() else Path(name)
