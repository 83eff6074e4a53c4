"""Fields of a live session: values of particles that determine their colours, computed from a state
only while they are selected."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from pbdkit.array_types import Array, Floats
from pbdkit.components.diagnostics import PE2
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.io.layout import When, when_measured
from pbdkit.io.physical import Physical
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.plotting.style import signed
from pbdkit.plugin import Diagnostic, Variable
from pbdkit.plugin.component import as_values
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.registry import Registry
from pbdkit.plugin.units import LENGTH, QUANTITIES, STRESS, Units
from pbdkit.scene.constants import bond_numbers, check_diagnostics, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

AXES = {"axis": "xy", "principal": "12"}
"""Dimensions of vectors, with the labels of their components."""
LENGTH_OF = "axis"
"""Dimension over which the length of a vector is a field, too."""
Part = Literal["length"] | int | None
"""Part of a vector: its length or one of its components; None of a scalar."""
MODULUS = "youngs_modulus"
"""Parameter that is 1 if the experiment does not define it. Stresses are then ratios to it."""


@dataclass(frozen=True)
class ParticleField:
    """Scalar field on the particles.

    `values` computes it from a moment, in an array of shape (particle,), in the given `units`,
    which are those of the user. It is NaN where the field is not defined.
    """

    meaning: str
    units: str
    values: Callable[[StateMoment], Array]


class FieldEvaluator:
    """Fields that a scene offers, and their evaluation in its states. Among them are those of the
    `diagnostics` of the experiment."""

    def __init__(self, scene: Scene, diagnostics: Sequence[Diagnostic]) -> None:
        self._fields = dict(_fields(scene, diagnostics))
        self._tables = Tables(scene)

    @property
    def labels(self) -> dict[str, dict[str, str]]:
        """Return the meaning and the units of each field by its name."""
        return {
            name: {"meaning": field.meaning, "units": field.units}
            for name, field in self._fields.items()
        }

    def values(self, name: str, scene: Scene, state: State) -> Array:
        """Return the values of a field, (particle,). Raises PbdkitError if the field cannot be
        computed in this state."""
        if self._tables.scene is not scene:
            self._tables = Tables(scene)
        try:
            with np.errstate(all="ignore"):  # Values that are not finite are not shown.
                return self._fields[name].values(StateMoment(state, self._tables))
        except (FloatingPointError, ValueError) as error:
            raise ExperimentError(f"{name} cannot be computed: {error}") from None


def _fields(scene: Scene, diagnostics: Sequence[Diagnostic]) -> Iterator[tuple[str, ParticleField]]:
    """Generate names and fields."""
    units = scene.experiment.units
    yield "u", _field("displacement, length", LENGTH.lattice, units, _displacement)
    yield "last-step", _field("move in the last step", LENGTH.lattice, units, _last_move)
    for diagnostic in (*diagnostics, *_others(scene, diagnostics)):
        yield from _of_diagnostic(diagnostic, units)
    if not scene.experiment.neighbours.nearness():
        yield "broken", ParticleField("fraction of broken bonds", "", _broken_fraction)
        for number in bond_numbers(scene.experiment):
            compute = partial(_largest_of_bonds, number.name)
            meaning = f"{number.long_name}, largest of the bonds"
            yield number.name, _field(meaning, number.units, units, compute)
    for number in particle_numbers(scene.experiment):
        compute = partial(_remembered, number.name)
        yield number.name, _field(number.long_name, number.units, units, compute)


def _others(scene: Scene, diagnostics: Sequence[Diagnostic]) -> Iterator[Diagnostic]:
    """Generate diagnostics of other types that the scene supports with their default
    parameters."""
    experiment = scene.experiment
    used = {PE2, *map(type, diagnostics)}  # PE2 is the move in the last step.
    parts = experiment.model_dump(mode="json", by_alias=True)
    candidates: tuple[dict[str, Any], ...] = ({}, {MODULUS: 1.0})
    for kind, (name, *_) in Registry().spellings(Diagnostic).items():
        if kind in used or not _has_particle_values(kind):
            continue
        for parameters in candidates:
            with suppress(PbdkitError):
                single = experiment.of_parts(
                    parts | {"diagnostics": [{"type": name, **parameters}]}
                )
                check_diagnostics(single, scene.raster, scene.neighbourhood)
                yield single.diagnostics[0]
                break


def _has_particle_values(kind: Any) -> bool:
    with suppress(Exception):  # Code of a plugin that the user has not selected must not fail here.
        return any(
            "particle" in variable.dims for variable in kind.model_construct(type="").variables()
        )
    return False


def _of_diagnostic(
    diagnostic: Diagnostic, units: Units | None
) -> Iterator[tuple[str, ParticleField]]:
    """Generate the scalar fields of a diagnostic: its scalars, and the lengths and components of
    its vectors."""
    if when_measured(diagnostic) is When.END:
        return
    for n, (variable, scale) in enumerate(Physical(units).scaled(diagnostic)):
        meaning, lattice = variable.long_name, variable.units
        if lattice == STRESS.lattice and getattr(diagnostic, MODULUS, 0.0) == 1.0:
            meaning, lattice = f"{meaning} / Young's modulus", "1"
        for suffix, label, part in _scalars(variable):
            compute = partial(_measured, diagnostic, n, part, scale)
            of_part = f"{meaning}, {label}" if label else meaning
            yield f"{variable.name}{suffix}", _field(of_part, lattice, units, compute)


def _scalars(variable: Variable) -> Iterator[tuple[str, str, Part]]:
    """Generate suffix, label and part of each scalar field that a variable contains."""
    if variable.dims == ("particle",):
        yield "", "", None
    elif variable.dims[:1] == ("particle",) and variable.dims[1:] in {(dim,) for dim in AXES}:
        dim = variable.dims[1]
        if dim == LENGTH_OF and variable.name != "u":  # The length of u is a field in any case.
            yield "", "length", "length"
        yield from ((f"_{label}", label, k) for k, label in enumerate(AXES[dim]))


def _measured(diagnostic: Diagnostic, n: int, part: Part, factor: float, now: StateMoment) -> Array:
    with errors_attributed_to(diagnostic, f"at step {now.step}"):
        values = np.asarray(as_values(diagnostic.measure(now), "measure")[n])
        if part is not None:
            values = _lengths(values) if part == "length" else values[:, part]
    return np.asarray(factor * values)


def _field(
    meaning: str, lattice: str, units: Units | None, compute: Callable[[StateMoment], Array]
) -> ParticleField:
    """Return a field in the units of the user. Quantities that contain a modulus are converted
    together with their diagnostic."""
    quantity = QUANTITIES.get(lattice)
    if units is None or quantity is None or quantity.youngs_modulus:
        return ParticleField(meaning, signed(lattice), compute)
    factor = (units.value("length") or 1.0) ** quantity.length
    return ParticleField(meaning, signed(quantity.unit), lambda now: factor * compute(now))


def _lengths(vectors: Floats) -> Array:
    return np.asarray(np.sqrt((vectors.astype(float) ** 2).sum(axis=1)))


def _displacement(now: StateMoment) -> Array:
    return _lengths(now.displacement())


def _last_move(now: StateMoment) -> Array:
    return _lengths(now.displacement() - now.previous_displacement())


def _remembered(name: str, now: StateMoment) -> Array:
    return np.where(now.body, now.remembered(name), np.nan)


def _largest_of_bonds(name: str, now: StateMoment) -> Array:
    """Return the largest value of the bonds of each particle, NaN without bonds."""
    largest = np.full(len(now.body), np.nan)
    np.fmax.at(largest, now.bonds().ends.ravel() - 1, np.repeat(now.remembered(name), 2))
    return largest


def _broken_fraction(now: StateMoment) -> Array:
    """Return the fraction of the bonds of each particle that are broken, NaN without bonds."""
    bonds, count = now.bonds(), len(now.body)
    rows, broken = bonds.ends.ravel() - 1, np.repeat(bonds.broken_step >= 0, 2)
    return np.asarray(np.bincount(rows, broken, count) / np.bincount(rows, None, count))
