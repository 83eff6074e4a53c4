"""The fit file: an experiment, what is unknown of it, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, ValidationError, ValidationInfo, model_validator

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.experiment.base import Base, base_source
from pbdkit.experiment.beside import OF_PROGRAM, Beside, beside
from pbdkit.experiment.kinds import FIT, of_kind
from pbdkit.experiment.names import Version
from pbdkit.experiment.parts import report
from pbdkit.experiment.source import Source, read_file
from pbdkit.fitting.least_squares import Loss
from pbdkit.fitting.measurements import MeasuredCurve, MeasuredField, Measurements, Pair, Positive
from pbdkit.interfaces.component import Strict

FOLDER = Path(__file__).parent.parent / "fits"


def _two(bounds: Pair) -> Pair:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"needs two bounds, the lower first; got {list(bounds)}")
    return bounds


Bounds = Annotated[Pair, AfterValidator(_two)]


class Force(Strict):
    """What a leader group carries, and how thick the body is: Young's modulus follows, in the unit
    of the force over those of thickness and lattice. Where the experiment has units, these are N,
    mm and MPa."""

    group: Annotated[int, Field(ge=0)]
    value: Pair
    thickness: Positive = 1.0
    noise: Annotated[float, Field(ge=0.0)] = 0.0


class Rival(Strict):
    """Another model for the same data: changes of the experiment, by path, and what is unknown of
    it, where that is something else."""

    settings: Annotated[dict[str, Any], Field(min_length=1)]
    unknown: Annotated[dict[str, Bounds], Field(min_length=1)] | None = None


class Sampler(Strict):
    """Walkers of emcee, and their steps, a quarter of which is not counted."""

    walkers: Annotated[int, Field(ge=4, le=1000)] = 16
    steps: Annotated[int, Field(ge=10)] = 200
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


class Fit(Strict):
    """Looks for the `unknown` parameters, between bounds, with which an experiment is nearest to
    what was measured of it: a field of its equilibrium, tracks, a curve, or some of these.

    Groups that move by `measured` are given `modes` smooth displacements along each axis, which
    are estimated too; 0 takes what was measured there as it is. `loss` says how residuals count:
    all but `linear` let outliers count less.

    On request, and at a price: `profile` names parameters whose likelihood is followed by fitting
    all else anew; `sampler` draws from the posterior; `candidates` are other models by name, which
    are compared with this one by what they foretell of points left out, one of so many `folds`
    after another.
    """

    version: Version = 1
    experiment: Base
    unknown: Annotated[dict[str, Bounds], Field(min_length=1)]
    measured: Measurements
    force: Force | None = None
    modes: Annotated[int, Field(ge=0, le=40)] = 6
    loss: Loss = "linear"
    profile: Annotated[tuple[str, ...], Field(strict=False)] = ()
    sampler: Sampler | None = None
    candidates: dict[str, Rival] = Field(default_factory=dict)
    folds: Annotated[int, Field(ge=2, le=20)] = 5

    _beside: Beside = Beside()

    @property
    def beside(self) -> Beside:
        """The files that it may name."""
        return self._beside

    @model_validator(mode="after")
    def _fits_together(self, info: ValidationInfo) -> Self:
        object.__setattr__(self, "_beside", beside(info))
        if len(self.measured) > 1 and any(m.noise is None for m in self.measured):
            raise ValueError("several measurements need the `noise` of each, to be weighed by it")
        if self.force and not isinstance(self.measured[0], MeasuredField):
            raise ValueError(
                "`force` is what a group carries at rest while a field is measured; give forces "
                "over displacement as a curve"
            )
        if self.force and self.force.value == (0.0, 0.0):
            raise ValueError("`force` is 0 both ways, which tells no modulus; leave it out")
        scaled = [m for m in self.measured if isinstance(m, MeasuredCurve) and not m.youngs_modulus]
        if self.force and scaled:
            raise ValueError(
                "both `force` and a curve without `youngs_modulus` tell Young's modulus; leave "
                "`force` out"
            )
        if unknown := [path for path in self.profile if path not in self.unknown]:
            hint = did_you_mean(unknown[0], self.unknown)
            raise ValueError(f"`profile` names '{unknown[0]}', which is not unknown{hint}")
        if self.sampler and self.loss != "linear":
            raise ValueError("a `sampler` draws for normal noise: it needs `loss: linear`")
        if self.sampler and self.sampler.walkers < 2 * len(self.unknown):
            raise ValueError("a `sampler` needs two walkers for each parameter at least")
        return self


def described_fit(
    description: Mapping[str, Any] | str | Path, *, given: bool
) -> tuple[Fit, Source]:
    """The fit in a file, of a shipped name or in a dict, and the source of its experiment; none is
    looked for where one is `given`. Raises ExperimentError."""
    if isinstance(description, Mapping):
        path, source = Path("fit"), Source("fit", dict(description), {}, OF_PROGRAM)
    else:
        path = _file(str(description))
        source = of_kind(FIT, read_file(path))
    if isinstance(source.data, dict) and source.data.get("kind") == "strength":
        raise ExperimentError(
            f"{source.name}: is a fit of strength; pbdkit.fit_strength carries it out", ("kind",)
        )
    if given and isinstance(source.data, dict):
        source = Source(
            source.name, {"experiment": "", **source.data}, source.places, source.beside
        )
    try:
        fit = Fit.model_validate(source.data, context={"beside": source.beside})
    except ValidationError as error:
        raise report(error, source) from None
    return fit, source if given else base_source(path, fit.experiment, source)


def shipped_fits() -> list[str]:
    """The names of the fits that come along, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def _file(name: str) -> Path:
    path = Path(name)
    if path.is_file():
        return path
    if name in (names := shipped_fits()):
        return FOLDER / f"{name}.yaml"
    near = [str(p) for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    hint = did_you_mean(name, [*near, *names])
    raise ExperimentError(f"{name}: is no file and no shipped fit{hint} ({', '.join(names)})")
