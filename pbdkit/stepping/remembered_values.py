"""What parts remember of bonds and particles: where it starts, and how it is renewed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import PluginError
from pbdkit.interfaces import Bonds, Draws, FollowerRule, FractureModel, Particles, Remembered
from pbdkit.interfaces.component import did_you_mean
from pbdkit.interfaces.values import Drawn
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene

Array = NDArray[Any]
Values = tuple[Array, ...]
"""One array a number that is remembered, in the order in which the part declares them."""


def initial_bond_values(scene: Scene) -> Values:
    """(plane, cell, cell) a number, as the fracture model starts them."""
    model, table = scene.experiment.fracture, scene.neighbourhood.planes
    shape = (len(table), *scene.raster.shape[1:])
    numbers = bond_numbers(scene.experiment)
    values = _started(scene, numbers, shape)
    if numbers and isinstance(model, Draws):
        bonds = scene.bonds
        where = bonds.plane, *np.unravel_index(bonds.place, scene.raster.shape[1:])
        owners = describe_bonds(scene)
        _draw(scene, "fracture", numbers, values, partial(model.draw, owners), len(owners), where)
    return values


def initial_particle_values(scene: Scene) -> Values:
    """(sublattice, cell, cell) a number, as the rule starts them; frame points are left out."""
    rule, numbers = scene.experiment.rule, particle_numbers(scene.experiment)
    values = _started(scene, numbers, scene.raster.shape)
    if numbers and isinstance(rule, Draws):
        owners, place = describe_particles(scene), scene.raster.place_of(scene.raster.body_rows)
        where = np.unravel_index(place, scene.raster.shape)
        _draw(scene, "rule", numbers, values, partial(rule.draw, owners), len(owners), where)
    return values


def generator_for(seed: int, part: str) -> np.random.Generator:
    """The random numbers of one part of the experiment, by its field: the same whatever other parts
    draw."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(part.encode())))


def describe_particles(scene: Scene) -> Particles:
    """The particles of the body with their places."""
    rows = scene.raster.body_rows
    return Particles(rows.astype(np.int64) + 1, scene.raster.reference(rows))


def describe_bonds(scene: Scene) -> Bonds:
    """The table of bonds with their places."""
    table, raster = scene.bonds, scene.raster
    rests = np.array([plane.slot.rest for plane in scene.neighbourhood.planes])
    rest = rests[table.plane]
    return Bonds(table.ends + 1, table.shell, rest, raster.reference(table.ends[:, 0]) + rest / 2)


def renew(old: Sequence[Array], new: Sequence[Any], where: Array | None) -> None:
    """Writes new values over the old ones, in place, where it is asked for (None: everywhere); all
    are there before any is written.

    Raises ValueError for another number of values, TypeError for fractions of an integer.
    """
    if len(new) != len(old):
        raise ValueError(
            f"it returned {len(new)} value{'s' * (len(new) != 1)}, and it remembers {len(old)} "
            "that change: declare `changes=False` for those that stay"
        )
    fresh = [
        np.array(value) if where is None else np.where(where, value, plane)
        for plane, value in zip(old, new, strict=True)
    ]
    for plane, value in zip(old, fresh, strict=True):
        np.copyto(plane, value)


def shown(values: Sequence[Any]) -> tuple[Any, ...]:
    """The same, as components see it: nobody writes to the state but the stepper."""
    return tuple(_read_only(value) if isinstance(value, np.ndarray) else value for value in values)


def _read_only(value: Array) -> Array:
    view = value.view()
    view.flags.writeable = False
    return view


def changing(numbers: Sequence[Remembered], values: Sequence[Array]) -> list[Array]:
    """The arrays of the numbers that change."""
    return [value for number, value in zip(numbers, values, strict=True) if number.changes]


def _started(scene: Scene, numbers: Sequence[Remembered], shape: tuple[int, ...]) -> Values:
    precision = scene.experiment.stepping.precision
    dtypes = [precision if number.dtype == "f8" else number.dtype for number in numbers]
    return tuple(np.full(shape, n.initial, d) for n, d in zip(numbers, dtypes, strict=True))


def _draw(
    scene: Scene,
    field: str,
    numbers: Sequence[Remembered],
    values: Values,
    draw: Callable[[np.random.Generator], Drawn],
    count: int,
    where: tuple[Any, ...],
) -> None:
    part: FractureModel | FollowerRule = getattr(scene.experiment, field)
    generator = generator_for(scene.experiment.seed, field)
    with blaming(part, "to draw where its numbers start", field):
        drawn = draw(generator)
        array_of = {number.name: value for number, value in zip(numbers, values, strict=True)}
        for name, value in drawn.items():
            if name not in array_of:
                raise PluginError(
                    f"'{part.type}' draws '{name}', which it does not remember"
                    f"{did_you_mean(name, array_of)}"
                )
            if np.shape(value) != (count,) or not np.isfinite(value).all():
                raise PluginError(
                    f"'{part.type}' draws '{name}' with the shape {np.shape(value)}, finite: "
                    f"{bool(np.isfinite(value).all())}; needed are ({count},) finite numbers"
                )
            array_of[name][where] = value
