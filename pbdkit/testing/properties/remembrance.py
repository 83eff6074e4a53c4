"""What is asked of parts that remember numbers of bonds or particles."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from pbdkit.interfaces import Draws, FollowerRule, FractureModel, Remembered
from pbdkit.results.layout import base_columns, bond_columns, broken_columns
from pbdkit.scene.declarations import remembered_names
from pbdkit.testing.properties.measurements import NAME
from pbdkit.testing.properties.repetition import REPEATABLE
from pbdkit.testing.property import Arrays, NotAskedError, PropertyError, asked_of
from pbdkit.testing.states import SEED, drawn, numbers_of, owners
from pbdkit.testing.subject import Subject

PARTS = (FollowerRule, FractureModel)


@asked_of(*PARTS, needs=("takes-part",))
def declares_what_it_remembers(subject: Subject) -> None:
    """Every number that it remembers has a name in lower case that is free in the dataset, a long
    name, units ("1" where it has none), and an initial value that its dtype holds."""
    for scene in subject.scenes:
        numbers = numbers_of(subject.component, scene)
        remembered_names(scene.experiment)  # refuses what is declared twice
        columns = [*base_columns(), *bond_columns(), *broken_columns()]
        taken = {c.name for c in columns} | {d for c in columns for d in c.dims}
        for number in numbers:
            if not re.fullmatch(NAME, number.name):
                raise PropertyError(f"'{number.name}' is not named as `my_number` is")
            if number.name in taken:
                raise PropertyError(f"every dataset has a '{number.name}': give it another name")
            for what in ("long_name", "units"):
                if not getattr(number, what).strip():
                    raise PropertyError(f"'{number.name}' has no {what}")
            _refuse_unheld(number, number.initial, "starts at")


@asked_of(*PARTS, needs=("takes-part", "declares-what-it-remembers"))
def draws_what_it_remembers(subject: Subject) -> None:
    """`draw` gives one finite value a bond or particle, by the name of a number that it remembers,
    such as its dtype holds; all numbers at random are of the generator that it is given."""
    part: Any = subject.component
    draws = isinstance(part, Draws)
    for scene in subject.scenes:
        numbers = {number.name: number for number in numbers_of(part, scene)}
        if not draws:
            raise NotAskedError("all that it remembers starts at its `initial`")
        shown = owners(part, scene)
        for name, values in drawn(part, shown, np.random.default_rng(SEED)).items():
            if name not in numbers:
                raise PropertyError(
                    f"`draw` gives '{name}'; what it remembers is {', '.join(numbers)}"
                )
            if np.shape(values) != (len(shown),):
                raise PropertyError(
                    f"`draw` gives '{name}' with the shape {np.shape(values)}, not ({len(shown)},)"
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


@asked_of(*PARTS, needs=REPEATABLE)
def renews_what_it_remembers(subject: Subject) -> None:
    """`update`, or `remember`, returns one value for each number that changes, in their order, and
    a whole number where one is declared."""
    numbers = numbers_of(subject.component, subject.scene())
    changing = [number for number in numbers if number.changes]
    asked = [q for q in subject.questions() if q.what in ("update", "remember")]
    if not asked:
        raise NotAskedError("what it remembers stays as it starts")
    for values in _by_slot(asked[0].answer()):
        if len(values) != len(changing):
            raise PropertyError(
                f"`{asked[0].what}` returns {len(values)} value{'s' * (len(values) != 1)}, and "
                f"{len(changing)} of the numbers change: declare `changes=False` for those that "
                "stay"
            )
        for number, value in zip(changing, values, strict=True):
            if not np.can_cast(value.dtype, number.dtype, "same_kind"):
                raise PropertyError(
                    f"`{asked[0].what}` returns {value.dtype} for '{number.name}', which is "
                    f"declared as {number.dtype}: fractions would be lost"
                )


def _by_slot(answer: Arrays) -> list[list[Any]]:
    """The values that were returned together."""
    slots: dict[str, list[Any]] = {}
    for name, value in answer.items():
        slots.setdefault(name.rpartition(": ")[0], []).append(value)
    return list(slots.values()) or [[]]
