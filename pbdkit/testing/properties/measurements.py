"""What is asked of diagnostics."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Diagnostic, Variable
from pbdkit.results.layout import reserved_names
from pbdkit.testing.properties.repetition import REPEATABLE
from pbdkit.testing.property import PropertyError, asked_of
from pbdkit.testing.questions import moment_of
from pbdkit.testing.sight import SeenMoment
from pbdkit.testing.subject import Subject

NAME = r"[a-z][a-z0-9_]*"
ROUNDING = 1e-12


@asked_of(Diagnostic)
def labels_its_variables(subject: Subject) -> None:
    """Every variable has a name in lower case, a long name and units ("1" where it has none), so
    that a dataset can be read without the program; none is a name that the dataset has already."""
    own = [*subject.component.coordinates(), subject.component.own_dimension]
    for name in (*own, *(variable.name for variable in subject.component.variables())):
        if name in reserved_names():
            raise PropertyError(f"the dataset has '{name}' already: give it another name")
    for variable in subject.component.variables():
        if not re.fullmatch(NAME, variable.name):
            raise PropertyError(f"the variable '{variable.name}' is not named as `my_quantity` is")
        for what in ("long_name", "units"):
            if not getattr(variable, what).strip():
                raise PropertyError(f"the variable '{variable.name}' has no {what}")


@asked_of(Diagnostic, needs=REPEATABLE)
def measures_what_it_declares(subject: Subject) -> None:
    """`measure` returns one array for each of its variables, shaped as their `dims` say, of numbers
    that go into the declared dtype without loss of kind."""
    diagnostic, scene = subject.component, subject.scene()
    sizes = {"particle": scene.raster.count, "axis": 2, "leader_group": len(scene.leading)}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    variables, measured = diagnostic.variables(), diagnostic.measure(moment_of(scene, 0))
    if len(variables) != len(measured):
        raise PropertyError(f"{len(measured)} arrays for {len(variables)} variables")
    if diagnostic.own_dimension:
        if not diagnostic.at_end:
            raise PropertyError(
                f"its `own_dimension` '{diagnostic.own_dimension}' has a length only where it "
                "declares `at_end` too"
            )
        sizes = _with_its_own(diagnostic, measured, sizes)
    for variable, value in zip(variables, measured, strict=True):
        unknown = [dim for dim in variable.dims if dim not in sizes]
        if unknown:
            raise PropertyError(
                f"'{variable.name}' has the dimension '{unknown[0]}', which `coordinates` does not "
                "give"
            )
        _refuse_unfit(variable, np.asarray(value), tuple(sizes[dim] for dim in variable.dims))


def _with_its_own(
    diagnostic: Diagnostic, measured: tuple[Any, ...], sizes: dict[str, int]
) -> dict[str, int]:
    """The sizes with that of the diagnostic's own dimension, as the first variable that has it
    gives it."""
    name = diagnostic.own_dimension
    for variable, value in zip(diagnostic.variables(), measured, strict=True):
        if name in variable.dims and np.ndim(value) == len(variable.dims):
            return {name: np.shape(value)[variable.dims.index(name)]} | sizes
    return sizes


def _refuse_unfit(variable: Variable, value: NDArray[Any], shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise PropertyError(f"'{variable.name}' has the shape {value.shape}, not {shape}")
    if not np.can_cast(value.dtype, variable.dtype, "same_kind"):
        raise PropertyError(
            f"'{variable.name}' is declared as {variable.dtype} and measured as {value.dtype}: "
            "digits would be lost without a word"
        )


@asked_of(Diagnostic, needs=(*REPEATABLE, "measures-what-it-declares"))
def takes_rows_in_any_order(subject: Subject) -> None:
    """Particles in another order have the same values in that order, and all else stays, to
    rounding: rows are found by `now.rows(numbers)` and mean nothing else."""
    diagnostic, scene = subject.component, subject.scene()
    moment, count = moment_of(scene, 0), scene.raster.count
    order = np.random.default_rng(0).permutation(count)
    seen = diagnostic.measure(SeenMoment(moment, order=order))
    for variable, one, other in zip(
        diagnostic.variables(), diagnostic.measure(moment), seen, strict=True
    ):
        expected = np.asarray(one)
        for axis, dim in enumerate(variable.dims):
            expected = np.take(expected, order, axis) if dim == "particle" else expected
        size = float(np.nanmax(np.abs(expected), initial=1e-300))
        if not np.allclose(other, expected, rtol=0.0, atol=ROUNDING * size, equal_nan=True):
            raise PropertyError(
                f"'{variable.name}' depends on the order of the rows: ask `now.rows(numbers)` for "
                "particles by number"
            )
