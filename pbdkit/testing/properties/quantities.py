"""What is asked of the quantities that parts remember and diagnostics measure."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import (
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    Remembered,
    Variable,
)
from pbdkit.results.layout import reserved_names
from pbdkit.scene.declarations import remembered_names
from pbdkit.testing.fault import NotAskedError, PropertyError
from pbdkit.testing.property import asked_of
from pbdkit.testing.states import SEED, moment_of, numbers_of, owners, shown
from pbdkit.testing.subject import Subject

NAME = r"[a-z][a-z0-9_]*"
ROUNDING = 1e-12
PARTS = (FollowerRule, FractureModel)


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
        _refuse_unlabelled(variable, f"the variable '{variable.name}'")


def _refuse_unlabelled(quantity: Variable | Remembered, name: str) -> None:
    for what in ("long_name", "units"):
        if not getattr(quantity, what).strip():
            raise PropertyError(f"{name} has no {what}")


@asked_of(Diagnostic, is_needed=True)
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


@asked_of(Diagnostic)
def takes_rows_in_any_order(subject: Subject) -> None:
    """Particles in another order have the same values in that order, and all else stays, to
    rounding: rows are found by `now.rows(numbers)` and mean nothing else."""
    diagnostic, scene = subject.component, subject.scene()
    moment, count = moment_of(scene, 0), scene.raster.count
    order = np.random.default_rng(0).permutation(count)
    seen = diagnostic.measure(shown(moment, order))
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


@asked_of(*PARTS, is_needed=True)
def declares_what_it_remembers(subject: Subject) -> None:
    """Every number that it remembers has a name in lower case that is free in the dataset, a long
    name, units ("1" where it has none), and an initial value that its dtype holds."""
    for scene in subject.scenes:
        numbers = numbers_of(subject.component, scene)
        remembered_names(scene.experiment)  # refuses what is declared twice
        for number in numbers:
            if not re.fullmatch(NAME, number.name):
                raise PropertyError(f"'{number.name}' is not named as `my_number` is")
            if number.name in reserved_names():
                raise PropertyError(f"every dataset has a '{number.name}': give it another name")
            _refuse_unlabelled(number, f"'{number.name}'")
            _refuse_unheld(number, number.initial, "starts at")


@asked_of(*PARTS, is_needed=True)
def draws_what_it_remembers(subject: Subject) -> None:
    """`draw` gives one finite value a bond or particle, by the name of a number that it remembers,
    such as its dtype holds; all numbers at random are of the generator that it is given."""
    part: Any = subject.component
    draws = isinstance(part, Draws)
    for scene in subject.scenes:
        numbers = {number.name: number for number in numbers_of(part, scene)}
        if not draws:
            raise NotAskedError("all that it remembers starts at its `initial`")
        rows = owners(part, scene)
        for name, values in part.draw(rows, np.random.default_rng(SEED)).items():
            if name not in numbers:
                raise PropertyError(
                    f"`draw` gives '{name}'; what it remembers is {', '.join(numbers)}"
                )
            if np.shape(values) != (len(rows),):
                raise PropertyError(
                    f"`draw` gives '{name}' with the shape {np.shape(values)}, not ({len(rows)},)"
                )
            if not np.isfinite(values).all():
                raise PropertyError(f"`draw` gives '{name}' that is not finite")
            _refuse_unheld(numbers[name], values, "is drawn as")


def _refuse_unheld(number: Remembered, values: Any, how: str) -> None:
    """PropertyError where writing the values into arrays of the dtype would change them."""
    given = np.asarray(values)
    with np.errstate(all="ignore"):
        lost = given[given.astype(number.dtype) != given]
    if lost.size:
        raise PropertyError(
            f"'{number.name}' {how} {lost.flat[0]}, which {number.dtype} does not hold: declare "
            "another `dtype`"
        )


@asked_of(*PARTS, is_needed=True)
def renews_what_it_remembers(subject: Subject) -> None:
    """`update`, or `remember`, returns one value for each number that changes, in their order, and
    a whole number where one is declared."""
    numbers = numbers_of(subject.component, subject.scene())
    changing = [number for number in numbers if number.changes]
    asked = [q for q in subject.questions() if q.what in ("update", "remember")]
    if not asked:
        raise NotAskedError("what it remembers stays as it starts")
    answer = asked[0].asked()
    for values in answer if asked[0].what == "update" else [answer]:
        if len(values) != len(changing):
            raise PropertyError(
                f"`{asked[0].what}` returns {len(values)} value{'s' * (len(values) != 1)}, and "
                f"{len(changing)} of the numbers change: declare `changes=False` for those that "
                "stay"
            )
        for number, value in zip(changing, map(np.asarray, values), strict=True):
            if not np.can_cast(value.dtype, number.dtype, "same_kind"):
                raise PropertyError(
                    f"`{asked[0].what}` returns {value.dtype} for '{number.name}', which is "
                    f"declared as {number.dtype}: fractions would be lost"
                )
