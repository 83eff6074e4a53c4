"""What is asked before the first step: that scenes can be built, with numbers and variables as they
are declared."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from pbdkit.interfaces import Diagnostic, Draws, FollowerRule, FractureModel, Remembered
from pbdkit.results.layout import reserved_names
from pbdkit.scene.declarations import remembered_names
from pbdkit.scene.directions import rotations_of
from pbdkit.scene.scene import Scene
from pbdkit.testing.states import SEED, numbers_of, owners
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of

NAME = r"[a-z][a-z0-9_]*"


@asked_of(Diagnostic)
def labels_its_variables(subject: Subject) -> None:
    """Every variable has a name in lower case, a long name and units ("1" where it has none), so
    that a dataset can be read without the program; none is a name that the dataset has already."""
    diagnostic = subject.component
    variables = {variable.name: variable for variable in diagnostic.variables()}
    for name in (*diagnostic.coordinates(), diagnostic.own_dimension, *variables):
        if name in reserved_names():
            raise PropertyError(f"the dataset has '{name}' already: give it another name")
    for name, variable in variables.items():
        _refuse_unlabelled(variable, f"the variable '{name}'", "my_quantity")


def _refuse_unlabelled(quantity: Any, told: str, example: str) -> None:
    if not re.fullmatch(NAME, quantity.name):
        raise PropertyError(f"{told} is not named as `{example}` is")
    for what in ("long_name", "units"):
        if not getattr(quantity, what).strip():
            raise PropertyError(f"{told} has no {what}")


@asked_of(is_needed=True)
def takes_part(subject: Subject) -> None:
    """A scene can be built with it: at least one of those tried takes it, and none makes it fail
    with anything but an ExperimentError."""
    assert subject.scenes


@asked_of(FollowerRule, FractureModel, is_needed=True)
def declares_what_it_remembers(subject: Subject) -> None:
    """Every number that it remembers has a name in lower case that is free in the dataset, a long
    name, units ("1" where it has none), and an initial value that its dtype holds."""
    for scene in subject.scenes:
        numbers = remembered(subject, scene)
        remembered_names(scene.experiment)  # refuses what is declared twice
        for number in numbers:
            if number.name in reserved_names():
                raise PropertyError(f"every dataset has a '{number.name}': give it another name")
            _refuse_unlabelled(number, f"'{number.name}'", "my_number")
            _refuse_unheld(number, number.initial, "starts at")
        rotations_of(scene.experiment)  # refuses what is not remembered


def remembered(subject: Subject, scene: Scene) -> tuple[Remembered, ...]:
    """The numbers that a rule or a fracture model remembers; NotAskedError where there are none."""
    if numbers := numbers_of(subject.component, scene):
        return numbers
    whose = "particles" if isinstance(subject.component, FollowerRule) else "bonds"
    raise NotAskedError(f"it remembers nothing of {whose}")


@asked_of(FollowerRule, FractureModel, is_needed=True)
def draws_what_it_remembers(subject: Subject) -> None:
    """`draw` gives one finite value a bond or particle, by the name of a number that it remembers,
    such as its dtype holds; all numbers at random are of the generator that it is given."""
    part = subject.component
    for scene in subject.scenes:
        numbers = {number.name: number for number in remembered(subject, scene)}
        if not isinstance(subject.component, Draws):
            raise NotAskedError("all that it remembers starts at its `initial`")
        rows = owners(part, scene)
        for name, values in part.draw(rows, np.random.default_rng(SEED)).items():
            if name not in numbers:
                known = ", ".join(numbers)
                raise PropertyError(f"`draw` gives '{name}'; what it remembers is {known}")
            if (shape := np.shape(values)) != (len(rows),):
                needed = f"not ({len(rows)},)"
                raise PropertyError(f"`draw` gives '{name}' with the shape {shape}, {needed}")
            if not np.isfinite(values).all():
                raise PropertyError(f"`draw` gives '{name}' that is not finite")
            _refuse_unheld(numbers[name], values, "is drawn as")


def _refuse_unheld(number: Remembered, values: Any, how: str) -> None:
    """PropertyError where writing the values into arrays of the dtype would change them."""
    given = np.asarray(values)
    with np.errstate(all="ignore"):
        lost = given[given.astype(number.dtype) != given]
    if lost.size:
        fault = f"'{number.name}' {how} {lost.flat[0]}, which {number.dtype} does not hold"
        raise PropertyError(f"{fault}: declare another `dtype`")
