"""Properties of steps under a change of units, reflection and rotation, and of the stiffness.

The stiffness of a body is tested with all bonds and with bonds broken at random.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from pydantic import BaseModel

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import (
    Axes,
    Component,
    Draws,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    NeighbourMetric,
    Quantity,
    Remembers,
    StoresEnergy,
)
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.testing.mechanics import (
    NoSolidError,
    Solid,
    asymmetry,
    declared_constants,
    energy_given_back,
    force_constants,
    resistance_to_rigid_motions,
    stiffening,
    work_and_energy,
)
from pbdkit.testing.states import DivergenceError, advanced, displacements
from pbdkit.testing.subject import NotApplicableError, PropertyError, Subject, place_of, property_of

STEPS = 3
"""Number of steps in a case."""
ROUNDING = 1e-11
"""Tolerance relative to the largest displacement."""
LARGER = 2.0**20
"""Factor of lengths, a power of two, so that rounding errors do not change."""
AXES: dict[str, Floats] = {
    "reflected in x": np.diag([-1.0, 1.0]),
    "reflected in y": np.diag([1.0, -1.0]),
    "rotated by a right angle": np.array([[0.0, -1.0], [1.0, 0.0]]),
}
"""Matrices of the reflections and the rotation."""
REMEDY = (
    "compare lengths with those of the neighbours at rest; annotate parameters that are lengths "
    "with `pbdkit.plugin.LENGTH`, and powers of lengths with a `pbdkit.plugin.Quantity`"
)
"""Remedy for results that depend on the unit of length."""
EVEN = {"type": "grid", "columns": 5, "rows": 5}
"""Body that is symmetric under reflection and rotation by a right angle."""


@property_of(Lattice, NeighbourMetric, FollowerRule, FramePolicy, FractureModel)
def goes_alike_in_all_units(subject: Subject) -> None:
    """If all lengths are multiplied by a number, so are the displacements of a step: lengths matter
    relative to the spacing only, and parameters that are lengths are annotated as such."""
    if isinstance(subject.component, Lattice) and not _lengths(subject.component):
        raise NotApplicableError("none of its parameters is a length")
    for scene in subject.scenes[:2]:
        u = displacements(scene, 8)
        if np.abs(advanced(scene, 0.0 * u, 1)).max() > 0.0:
            continue  # The property `rests` reports it.
        larger = _scaled_scene(scene.experiment)
        original = advanced(scene, u, STEPS)[-1]
        try:
            scaled = advanced(larger, LARGER * u, STEPS)[-1]
        except DivergenceError:
            fault = f"with all lengths {LARGER:g} times as large the displacements are not finite"
            raise PropertyError(f"{fault}: {REMEDY}") from None
        deviation = np.abs(scaled / LARGER - original).max() / max(1e-300, np.abs(original).max())
        if not deviation <= ROUNDING:
            fault = f"a body with all lengths {LARGER:g} times as large moves differently"
            extent = f"by {deviation:.3g} of its displacement, {place_of(scene.experiment)}"
            raise PropertyError(f"{fault}, {extent}: {REMEDY}")


def _scaled_scene(experiment: Experiment) -> Scene:
    """Return the scene with all lengths of lattice, neighbours, rule, frame and fracture
    multiplied."""
    names = ("lattice", "neighbours", "rule", "frame", "fracture")
    parts = {name: _scaled(getattr(experiment, name)) for name in names}
    try:
        return build_scene(experiment.model_copy(update=parts))
    except ExperimentError as error:
        fault = f"with all lengths {LARGER:g} times as large the scene is refused: {error}"
        raise PropertyError(f"{fault}: {REMEDY}") from None


def _scaled(part: Component) -> Component:
    """Return the component with its lengths multiplied."""
    parameters: dict[str, Any] = part.model_dump(by_alias=True)
    for key, power in _lengths(part).items():
        parameters[key] = _times(LARGER**power, parameters[key])
    for name, field in type(part).model_fields.items():
        for axes in (each for each in field.metadata if isinstance(each, Axes)):
            x, y = (LARGER ** (each.length if each else 0) for each in (axes.x, axes.y))
            table = parameters[field.alias or name]
            parameters[field.alias or name] = [(x * point[0], y * point[1]) for point in table]
    return type(part).model_validate(parameters)


def _lengths(part: Component) -> dict[str, float]:
    """Return the parameters that are powers of lengths, with the power; the origin is excluded."""
    lengths = {}
    for name, field in type(part).model_fields.items():
        powers = {q.length for q in _quantities([field.annotation, *field.metadata])}
        if len(powers) == 1 and name != "origin":
            lengths[field.alias or name] = powers.pop()
    return lengths


def _quantities(annotations: Any) -> Iterator[Quantity]:
    """Yield the quantities that annotations contain at any depth."""
    for annotation in annotations:
        if isinstance(annotation, Quantity):
            yield annotation
        elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
            inner = annotation.model_fields.values()
            yield from _quantities([x for f in inner for x in (f.annotation, *f.metadata)])
        else:
            metadata = getattr(annotation, "__metadata__", ())
            yield from _quantities((*typing.get_args(annotation), *metadata))


def _times(factor: float, value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: v if k == "steps" else _times(factor, v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return type(value)(_times(factor, item) for item in value)
    return factor * value if isinstance(value, (int, float)) else value


@property_of(FollowerRule, FramePolicy, FractureModel)
def goes_alike_mirrored_and_turned(subject: Subject) -> None:
    """If a body on the square lattice is reflected or rotated by a right angle, its motion is
    reflected or rotated alike, up to rounding; components with `has_axes` are exempt."""
    if subject.component.has_axes:
        raise NotApplicableError("it declares `has_axes`, and depends on directions")
    scenes = [scene for each in subject.scenes if (scene := _even_scene(each.experiment))][:2]
    if not scenes:
        if all(scene.experiment.lattice.type != "square" for scene in subject.scenes):
            raise NotApplicableError("no scene on the square lattice accepts the component")
        raise NotApplicableError(
            "every scene on the square lattice has random numbers, state variables, preferred "
            "directions, or neighbours that are not symmetric"
        )
    for scene in scenes:
        u = displacements(scene, 9, share=0.5)
        if np.abs(advanced(scene, 0.0 * u, 1)).max() > 0.0:
            continue  # The property `rests` reports it.
        X = scene.raster.reference(scene.raster.body_rows)
        original = advanced(scene, u, STEPS)[-1]
        for name, matrix in AXES.items():
            order = _images(X, matrix)
            image = np.empty_like(u)
            image[order] = u @ matrix.T
            mapped = advanced(scene, image, STEPS)[-1][order]
            distance = np.abs(mapped - original @ matrix.T).max()
            deviation = distance / max(1e-300, np.abs(original).max())
            if not deviation <= ROUNDING:
                extent = f"by {deviation:.3g} of its displacement"
                fault = f"a body that is {name} moves differently, {extent}"
                remedy = (
                    "use lengths and products instead of single components, or declare `has_axes`"
                )
                raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _even_scene(experiment: Experiment) -> Scene | None:
    """Return the scene on the square lattice with a symmetric body.

    Returns
    -------
    Scene or None
        The result is None if other parts have preferred directions or state variables.
    """
    parts: Any = (experiment.rule, experiment.frame, experiment.fracture)
    if experiment.lattice.type != "square" or any(part.has_axes for part in parts):
        return None
    if any(isinstance(part, (Draws, Remembers)) and part.remembered() for part in parts):
        return None
    if experiment.neighbours.type not in ("coordination", "chebyshev"):
        return None
    body = type(experiment.body).model_validate(EVEN)
    return build_scene(experiment.model_copy(update={"body": body}))


def _images(X: Floats, matrix: Floats) -> Any:
    """Return the particle at the image of each position."""
    middle = X.mean(axis=0)
    images = (X - middle) @ matrix.T + middle
    return np.abs(images[:, None] - X[None]).max(axis=2).argmin(axis=1)


LINEAR = 1e-11
"""Tolerance relative to the largest stiffness for linear rules."""
NEARLY = 1e-8
"""Tolerance relative to the largest stiffness for nonlinear rules.

Their stiffness is computed from differences of forces.
"""


@property_of(FollowerRule, FramePolicy, FractureModel, is_needed=True)
def moves_rigidly_for_nothing(subject: Subject) -> None:
    """If forces are defined and edges are free, a small rigid motion of a body causes no force,
    whatever bonds are broken."""
    _check_stiffness(
        subject,
        resistance_to_rigid_motions,
        "forces under a rigid motion of a {body} body are {measure:.3g} of its stiffness",
        (
            "use forces along the line between two particles, or forces of cells that depend on "
            "strain only"
        ),
    )


@property_of(FollowerRule, FramePolicy, FractureModel, is_needed=True)
def acts_both_ways_alike(subject: Subject) -> None:
    """If forces are defined and edges are free, the stiffness is symmetric (Maxwell and Betti):
    forces have no resultant, and derive from an energy."""
    _check_stiffness(
        subject,
        lambda _, K: asymmetry(K),
        "the stiffness of a {body} body is not symmetric, by {measure:.3g} of the largest",
        "use the same weight at both ends of a bond, the transpose if it is a matrix",
    )


@property_of(FollowerRule, FramePolicy, FractureModel, is_needed=True)
def gives_no_energy_back(subject: Subject) -> None:
    """If forces are defined and edges are free, no displacement from rest has a negative energy."""
    _check_stiffness(
        subject,
        lambda _, K: energy_given_back(K),
        (
            "the energy of some displacement of a {body} body is negative, {measure:.3g} of the "
            "largest stiffness"
        ),
        "let `force` act towards the neighbours",
    )


def _check_stiffness(
    subject: Subject, measure: Callable[[Scene, Floats], float], fault: str, remedy: str
) -> None:
    """Raise PropertyError if the measure, evaluated for the stiffness matrix of a solid, exceeds
    the rounding error of the matrix."""
    for solid in _solids(subject):
        for body, K in solid.stages:
            if (measured := measure(solid.scene, K)) > _rounding(solid.scene):
                _fail(solid.scene, fault.format(body=body, measure=measured), remedy)


@property_of(FollowerRule, FramePolicy, FractureModel)
def does_not_stiffen_by_breaking(subject: Subject) -> None:
    """If forces are defined and edges are free, no displacement requires more force after bonds
    have softened or broken."""
    for solid in _solids(subject):
        for (_, K), (what, K_damaged) in pairwise(solid.stages):
            if (increase := stiffening(K, K_damaged)) > _rounding(solid.scene):
                _fail(
                    solid.scene,
                    (
                        f"some displacement of a {what} body has more stiffness than before, by "
                        f"{increase:.3g} of the largest"
                    ),
                    "scale the difference of a bond by a factor that decreases from 1 to 0",
                )


AGREE = 1e-6
"""Relative tolerance for forces, energy and stiffness, of which differences are computed."""
SHARES = (0.01, 0.2)
"""Largest displacements at which work and energy are compared, relative to the lattice constant."""


@property_of(FollowerRule)
def stores_the_work_of_its_forces(subject: Subject) -> None:
    """If forces are defined, they are the negative derivative of the strain energy of the body, for
    small and for finite displacements."""
    for solid in _solids(subject):
        for share in SHARES:
            work, decrease = work_and_energy(solid.scene, share)
            if fault := _disagreement(decrease, work):
                remedy = (
                    "`energy` is half of the energy of a bond, because it is evaluated at both "
                    "ends, and `force` is its negative derivative"
                    if isinstance(subject.component, StoresEnergy)
                    else "derive a nonlinear rule from `StoresEnergy`, and define `energy`"
                )
                extent = f"under displacements of {share:g} lattice constants"
                _fail(
                    solid.scene,
                    f"the decrease of the energy {fault} the work of the forces {extent}",
                    remedy,
                )


@property_of(FollowerRule)
def is_as_stiff_as_declared(subject: Subject) -> None:
    """If forces are defined, those under small strains in the interior of a body are the forces of
    the material that `elasticity` declares."""
    solids, rule = _solids(subject), subject.component
    if rule.uses_reference:
        raise NotApplicableError("its forces depend on positions")
    solids = [solid for solid in solids if _sites_are_equivalent(solid.scene)]
    if not solids:
        raise NotApplicableError("the sites of each lattice have different neighbours")
    expected = declared_constants(rule.elasticity())
    for solid in solids:
        constants = force_constants(solid.larger)
        if fault := _disagreement(constants, expected):
            _fail(
                solid.scene,
                f"the stiffness of the forces {fault} that of `elasticity`",
                "both are divided by Young's modulus and thickness; a particle exerts the forces "
                "of the area of one site",
            )


def _sites_are_equivalent(scene: Scene) -> bool:
    """Return whether all sites of the lattice have neighbours in the same directions. Otherwise
    sublattices move relative to each other under a strain."""
    rests = [np.array(sorted(slot.rest for slot in slots)) for slots in scene.neighbourhood.slots]
    return all(r.shape == rests[0].shape and np.allclose(r, rests[0]) for r in rests)


def _disagreement(values: Floats, expected: Floats) -> str:
    """Return how two sets of values differ, for messages; empty if they agree."""
    difference = np.abs(values - expected).max()
    if difference <= AGREE * np.abs(expected).max():
        return ""
    factor = float((values * expected).sum() / max(1e-300, float((expected * expected).sum())))
    if np.abs(values - factor * expected).max() <= AGREE * np.abs(expected).max():
        return f"is {factor:.6g} times"
    share = difference / max(1e-300, float(np.abs(expected).max()))
    return f"differs by {share:.3g} of the largest value from"


def _solids(subject: Subject) -> list[Solid]:
    try:
        return subject.solids
    except NoSolidError as reason:
        raise NotApplicableError(str(reason)) from None


def _fail(scene: Scene, fault: str, remedy: str) -> None:
    raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _rounding(scene: Scene) -> float:
    return NEARLY if isinstance(scene.experiment.rule, StoresEnergy) else LINEAR
