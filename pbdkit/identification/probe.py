"""Identify a rule from its own functions: whether it rests, is linear, turns with the body and is
the same everywhere, and its response to small displacements and long waves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.identification.elastic_constants import (
    DIFFUSION,
    ELASTICITY,
    NEITHER,
    SAME,
    diffusion,
    elasticity,
    second_order,
)
from pbdkit.identification.report import Identity, notes_on
from pbdkit.identification.waves import (
    LongWaves,
    Primitive,
    gradients,
    primitive,
    ranges,
    slow_waves,
    spacing_of,
    spectrum,
)
from pbdkit.lattice.neighbourhood import body_box
from pbdkit.linear.stencil import NOWHERE, Stencil, linearised, move
from pbdkit.plugin import Here, Slot
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene

Floats = NDArray[np.float64]
Slots = tuple[Slot, ...]
Differences = dict[Slot, Floats]
ROUNDING, STILL = 1e-9, 1e-8
SLANT = 0.3137
"""Of a free edge: no row of a lattice lies along it."""
ANGLE = 1.0
"""A finite rotation, in radians: any but a symmetry of some lattice."""
AMPLITUDE, SMALL = 0.1, 1e-5
"""Of the displacements that a rule is tried with, in units of the spacing."""
STRAIGHT = 1e-3
"""How far the answer to small displacements may be from a linear one."""


@dataclass(frozen=True)
class Probed:
    """What a rule answers: `stencil` in the middle of the body; `reasons`, in words, why no long
    wave tells what it is; `linear` and `turns` anywhere in the body, `symmetric`, and
    `rests_at_edges`, whether it leaves a body at rest alone with half the neighbours missing."""

    stencil: Stencil
    reasons: tuple[str, ...]
    linear: bool
    turns: bool
    symmetric: bool
    rests_at_edges: bool


def probed(scene: Scene, spacing: float) -> Probed:
    """The answers of the scene's rule, in the middle and, where it asks for the place, in the
    corners of the body."""
    stencils = {at: linearised(scene, at) for at in _places(scene)}
    half = tuple(_one_side(own) for own in scene.neighbourhood.slots)
    passes = [(one, at) for one in _passes(scene) for at in stencils]
    return Probed(
        next(iter(stencils.values())),
        tuple(_reasons(scene, passes, stencils, spacing)),
        all(_answers(one, at, AMPLITUDE * spacing, ROUNDING) for one, at in passes),
        all(_turns_with_the_body(one, at, spacing) for one, at in passes),
        all(_is_symmetric(of) for of in stencils.values()),
        all(_move_at_rest(one, at, half) <= ROUNDING * spacing for one, at in passes),
    )


def _reasons(
    scene: Scene, passes: list[tuple[Scene, Here]], stencils: dict[Here, Stencil], spacing: float
) -> Iterator[str]:
    """Why the rule is no diffusion and no elasticity, apart from what long waves see."""
    moved = max(_move_at_rest(one, at, scene.neighbourhood.slots) for one, at in passes) / spacing
    if not moved <= STILL:
        yield f"a body at rest does not stay: the rule moves it by {moved:.6g} h a step"
    if not all(_answers(one, at, SMALL * spacing, STRAIGHT) for one, at in passes):
        yield (
            "small displacements do not add up, however small: the rule is not differentiable at "
            "rest, and no plane wave answers for another"
        )
    yield from _place_dependence(scene, stencils)


def _passes(scene: Scene) -> list[Scene]:
    """The scene with each of its rules alone, where one works on the moves of another."""
    inner = _passes(scene.inner) if scene.inner else []
    return [replace(scene, inner=None), *inner]


def _places(scene: Scene) -> list[Here]:
    """The middle of the body, and its corners, for rules that ask for the place."""
    if not scene.experiment.rule.uses_reference:
        return [NOWHERE]
    lower, upper = body_box(scene.raster)
    local = [scene.middle, *map(vector, product(*zip(lower, upper, strict=True)))]
    origin = vector(scene.experiment.lattice.origin)
    return [
        Here(cast(Any, None), (at + origin).each(np.float64), at - scene.middle) for at in local
    ]


def _one_side(slots: Slots) -> Slots:
    """The neighbours that a particle on a free edge has: those on one side of a slanted line."""
    return tuple(slot for slot in slots if slot.rest.x + SLANT * slot.rest.y > 0.0)


def _move_at_rest(scene: Scene, at: Here, slots: tuple[Slots, ...]) -> float:
    moves = [np.abs(_moved(scene, own, {}, at)).max() for own in slots if own]
    return float(max(moves, default=0.0))


def _answers(scene: Scene, at: Here, size: float, within: float) -> bool:
    """Whether the rule's move is Σ W d for random differences d of that size."""
    stencil = linearised(scene, at)
    for slots, d in _random(scene, size, seed=0):
        moved = _moved(scene, slots, d, at) - _moved(scene, slots, {}, at)
        expected = sum(stencil.neighbours[slot] @ d[slot] for slot in slots)
        if not np.abs(moved - expected).max() <= within * size:
            return False
    return True


def _turns_with_the_body(scene: Scene, at: Here, spacing: float) -> bool:
    """Whether a finite rotation of all neighbours about the particle rotates its move."""
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    turn = np.array([[c, -s], [s, c]])
    for slots, d in _random(scene, AMPLITUDE * spacing, seed=1):
        turned = {k: turn @ (np.array(k.rest) + d[k]) - np.array(k.rest) for k in slots}
        apart = _moved(scene, slots, turned, at) - turn @ _moved(scene, slots, d, at)
        if not np.abs(apart).max() < ROUNDING * spacing:
            return False
    return True


def _random(scene: Scene, size: float, seed: int) -> Iterator[tuple[Slots, Differences]]:
    """The slots of each sublattice with differences of that size."""
    generator = np.random.default_rng(seed)
    for slots in scene.neighbourhood.slots:
        yield slots, {slot: size * generator.uniform(-1, 1, 2) for slot in slots}


def _is_symmetric(stencil: Stencil) -> bool:
    """Whether the matrix of j for k is the transpose of that of k for j."""
    by_key = {(s.source, s.target, s.cell): matrix for s, matrix in stencil.neighbours.items()}
    apart = [matrix - by_key[t, s, (-m, -n)].T for (s, t, (m, n)), matrix in by_key.items()]
    apart += [own - own.T for own in stencil.own]
    return bool(np.abs(apart).max() <= ROUNDING * np.abs(list(by_key.values())).max())


def _place_dependence(scene: Scene, stencils: dict[Here, Stencil]) -> Iterator[str]:
    """How the rule differs between the body's middle and the corner where it differs most."""
    places, slots = list(stencils), scene.neighbourhood.slots
    weights = np.array([[*of.neighbours.values(), *of.own] for of in stencils.values()])
    differences = weights - weights[0]
    worst = int(np.abs(differences).max(axis=(1, 2, 3)).argmax())
    if not np.abs(differences[worst]).max() > ROUNDING * np.abs(weights[0]).max():
        return
    corner = f"({places[worst].X.x:.6g}, {places[worst].X.y:.6g})"
    parameters = ", ".join(scene.experiment.rule.numeric_parameters())
    verdict = f"; no constant of a material does that: {parameters} is no Poisson ratio"
    text = f"it depends on the place: the weights at {corner} are not those in the middle"
    # The effect on a translation, where there is one.
    defect = differences[worst, : len(slots[0])].sum(axis=0) + differences[worst, -len(slots)]
    pushed = int(np.abs(defect).argmax())
    if abs(defect.ravel()[pushed]) >= ROUNDING:
        to, along = "xy"[pushed // 2], "xy"[pushed % 2]
        text = (
            f"it depends on the place: when everything moves by 1 along {along}, the particle at "
            f"{corner} of the body moves {defect.ravel()[pushed]:.6g} more along {to} a step than "
            "the one in the middle"
        )
    yield text + (verdict if parameters else "")


def _moved(scene: Scene, slots: Slots, d: Differences, at: Here) -> Floats:
    still = vector(np.zeros(scene.axes))
    with np.errstate(all="ignore"):
        moved = move(
            scene, slots, lambda k: vector(d[k]) if k in d else still, at._replace(u=still)
        )
    return np.array(moved, float)


def identified(scene: Scene) -> Identity:
    """The identity of the scene's rule on its lattice and neighbours.

    PluginError where the rule's own code fails, ExperimentError where it answers without numbers.
    """
    experiment, cell = scene.experiment, scene.experiment.lattice.cell()
    spacing = spacing_of(cell)
    with blaming(experiment.rule, "when asked for its answer to small displacements", "rule"):
        answers = probed(scene, spacing)
    _refuse_no_numbers(answers.stencil, experiment.rule.type)
    stencil, around = primitive(cell, answers.stencil), len(scene.neighbourhood.slots[0])
    long, against = _long_waves(stencil)
    reasons = (*answers.reasons, *against)
    kind = ELASTICITY if long is not None and long.diffusivity is None else DIFFUSION
    found = Identity(
        name=experiment.name,
        lattice=experiment.lattice.type,
        neighbours=f"{around} neighbours ({experiment.neighbours.type})",
        rule=experiment.rule.type,
        reasons=reasons,
        spacing=spacing,
        linear=answers.linear,
        turns=answers.turns,
        symmetric=answers.symmetric,
        rests_at_edges=answers.rests_at_edges,
        stencil=stencil,
        spectrum=spectrum(stencil, experiment.stepping.memory),
        relaxation=experiment.stepping.relaxation,
        memory=experiment.stepping.memory,
        kind=NEITHER if reasons else kind,
        long=long,
    )
    return replace(found, notes=tuple(notes_on(found, scene)))


def _refuse_no_numbers(stencil: Stencil, rule: str) -> None:
    if not np.isfinite([*stencil.own, *stencil.neighbours.values()]).all():
        raise ExperimentError(
            f"'{rule}' answers small displacements of a body at rest with numbers that are not "
            "finite: look at what it divides by",
            ("rule",),
        )


def _long_waves(stencil: Primitive) -> tuple[LongWaves | None, list[str]]:
    """What long waves see, and why that is no diffusion and no elasticity."""
    waves = slow_waves(stencil)
    if isinstance(waves, str):
        return None, [waves]
    along = [waves.series(np.array(k), 2) for k in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]
    second = second_order(*(np.array(series[2].real, float) for series in along))
    reasons = [*_drift(np.array([series[1].imag for series in along[:2]], float))]
    if np.abs(second).max() <= SAME * np.abs(stencil.matrix).max():
        reasons.append("nothing of second order is left: long waves do not decay as diffusion does")
        return None, reasons
    fast, slow = ranges(second)
    if slow.smallest < -SAME * abs(fast.largest):
        reasons.append(
            f"long waves along {slow.at_smallest:.4g}° grow instead of decaying: their diffusivity "
            f"is {slow.smallest:.6g}"
        )
    diffusivity, body = diffusion(second), elasticity(second)
    if isinstance(body, str) and diffusivity is None:
        reasons.append(body)
    lengths = () if slow.smallest <= SAME * abs(fast.largest) else gradients(waves)
    solid = None if isinstance(body, str) else body
    return LongWaves(second, diffusivity, solid, fast, slow, lengths), reasons


def _drift(first: Floats) -> list[str]:
    """Of the first-order terms i A_1 k, along x and y: a step takes u(x) to u(x - A_1)."""
    if np.abs(first).max() < SAME:
        return []
    velocity = first.trace(axis1=1, axis2=2) / 2
    return [
        "neighbours opposite to each other do not weigh the same: a displacement is carried along, "
        f"on average by ({velocity[0]:.6g}, {velocity[1]:.6g}) h a step"
    ]
