"""Identify a rule by evaluating its functions.

They are evaluated at rest, for small and for finite displacements, and for plane waves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, cast

import numpy as np

from pbdkit.array_types import Floats
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
from pbdkit.identification.identity import Identity, notes_on
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
from pbdkit.linear.stencil import NOWHERE, Stencil, linearised, move
from pbdkit.plugin import Here, Slot
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene

Slots = tuple[Slot, ...]
Differences = dict[Slot, Floats]
ROUNDING = 1e-9
"""Relative tolerance for equality, above rounding errors."""

STILL = 1e-8
"""Largest move of a body at rest, in units of the spacing."""

SLANT = 0.3137
"""Slope of a free edge that is parallel to no row of a lattice."""
ANGLE = 1.0
"""Angle of a finite rotation in radians, which is a symmetry of no lattice."""
AMPLITUDE = 0.1
"""Size of finite displacements, in units of the spacing."""

SMALL = 1e-5
"""Size of small displacements, in units of the spacing."""
STRAIGHT = 1e-3
"""Largest relative deviation from linearity for small displacements."""


@dataclass(frozen=True)
class RuleProperties:
    """Properties of a rule, found by evaluating it.

    Parameters
    ----------
    stencil
        Derivatives of the move in the middle of the body.
    reasons
        Reasons why the rule is neither diffusion nor elasticity, apart from the response to long
        waves.
    differentiable
        Whether the move is linear in small displacements.
    linear
        Whether the move is linear in finite displacements.
    turns
        Whether a finite rotation of the neighbours rotates the move.
    symmetric
        Whether the stencil is symmetric.
    rests_at_edges
        Whether a particle at rest does not move if half of its neighbours are missing.
    """

    stencil: Stencil
    reasons: tuple[str, ...]
    differentiable: bool
    linear: bool
    turns: bool
    symmetric: bool
    rests_at_edges: bool


def probe(scene: Scene, spacing: float) -> RuleProperties:
    """Evaluate the rule of a scene in the middle of the body.

    If the rule depends on the position, it is also evaluated in the corners of the body.
    """
    stencils = {place: linearised(scene, place) for place in _places(scene)}
    beyond = frozenset(filter(_is_beyond_an_edge, scene.neighbourhood.every))
    cases = [(rule, place) for rule in _single_rules(scene) for place in stencils]
    return RuleProperties(
        next(iter(stencils.values())),
        tuple(_reasons(scene, cases, stencils, spacing)),
        _is_differentiable(cases, spacing),
        all(_is_linear(rule, place, AMPLITUDE * spacing, ROUNDING) for rule, place in cases),
        all(_commutes_with_rotation(rule, place, spacing) for rule, place in cases),
        all(_is_symmetric(stencil) for stencil in stencils.values()),
        all(_move_at_rest(rule, place, beyond) <= ROUNDING * spacing for rule, place in cases),
    )


def _reasons(
    scene: Scene, cases: list[tuple[Scene, Here]], stencils: dict[Here, Stencil], spacing: float
) -> Iterator[str]:
    """Yield reasons why the rule is neither diffusion nor elasticity, except those from long
    waves."""
    drift = max(_move_at_rest(rule, place) for rule, place in cases) / spacing
    if not drift <= STILL:
        yield f"a body at rest does not remain at rest: the rule moves it by {drift:.6g} h per step"
    if not _is_differentiable(cases, spacing):
        yield (
            "arbitrarily small displacements do not superpose: the rule is not differentiable at "
            "rest, and has no plane waves; a table with a corner at the distance of a neighbour "
            "has this effect: move the point"
        )
    yield from _place_dependence(scene, stencils)


def _is_differentiable(cases: list[tuple[Scene, Here]], spacing: float) -> bool:
    return all(_is_linear(rule, place, SMALL * spacing, STRAIGHT) for rule, place in cases)


def _single_rules(scene: Scene) -> list[Scene]:
    """Return scenes with the rule of a scene alone, and with each of its inner rules alone."""
    inner = _single_rules(scene.inner) if scene.inner else []
    return [replace(scene, inner=None), *inner]


def _places(scene: Scene) -> list[Here]:
    """Return the middle of the body and, for rules that depend on the place, its corners."""
    if not scene.experiment.rule.uses_reference:
        return [NOWHERE]
    lower, upper = scene.raster.body_box()
    local = [scene.middle, *map(vector, product(*zip(lower, upper, strict=True)))]
    origin = vector(scene.experiment.lattice.origin)
    return [
        Here(cast(Any, None), (at + origin).each(np.float64), at - scene.middle) for at in local
    ]


def _is_beyond_an_edge(slot: Slot) -> bool:
    """Return whether a particle at a free edge, a slanted line, lacks the neighbour."""
    return not slot.rest.x + SLANT * slot.rest.y > 0.0


def _move_at_rest(scene: Scene, at: Here, missing: frozenset[Slot] = frozenset()) -> float:
    """Return the largest component of the move at rest of a particle with a neighbour."""
    moves = [
        np.abs(_move(scene, slots, {}, at, missing)).max()
        for slots in scene.neighbourhood.slots
        if not missing.issuperset(slots)
    ]
    return float(max(moves, default=0.0))


def _is_linear(scene: Scene, at: Here, size: float, tolerance: float) -> bool:
    """Return whether the move is linear, Σ W d, for random differences d of a given size."""
    stencil = linearised(scene, at)
    for slots, d in _random(scene, size, seed=0):
        change = _move(scene, slots, d, at) - _move(scene, slots, {}, at)
        expected = sum(stencil.neighbours[slot] @ d[slot] for slot in slots)
        if not np.abs(change - expected).max() <= tolerance * size:
            return False
    return True


def _commutes_with_rotation(scene: Scene, at: Here, spacing: float) -> bool:
    """Return whether a finite rotation of all neighbours about the particle rotates its move."""
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    turn = np.array([[c, -s], [s, c]])
    for slots, d in _random(scene, AMPLITUDE * spacing, seed=1):
        turned = {k: turn @ (np.array(k.rest) + d[k]) - np.array(k.rest) for k in slots}
        error = _move(scene, slots, turned, at) - turn @ _move(scene, slots, d, at)
        if not np.abs(error).max() < ROUNDING * spacing:
            return False
    return True


def _random(scene: Scene, size: float, seed: int) -> Iterator[tuple[Slots, Differences]]:
    """Yield the slots of each sublattice with random differences of a given size."""
    generator = np.random.default_rng(seed)
    for slots in scene.neighbourhood.slots:
        yield slots, {slot: size * generator.uniform(-1, 1, 2) for slot in slots}


def _is_symmetric(stencil: Stencil) -> bool:
    """Return whether the derivative of the move of k with respect to j is the transpose of the
    derivative of the move of j with respect to k."""
    by_key = {(s.source, s.target, s.cell): matrix for s, matrix in stencil.neighbours.items()}
    asymmetries = [matrix - by_key[t, s, (-m, -n)].T for (s, t, (m, n)), matrix in by_key.items()]
    asymmetries += [centre - centre.T for centre in stencil.centre]
    return bool(np.abs(asymmetries).max() <= ROUNDING * np.abs(list(by_key.values())).max())


def _place_dependence(scene: Scene, stencils: dict[Here, Stencil]) -> Iterator[str]:
    """Yield a description of how the rule depends on the position.

    The weights in the middle of the body are compared with those at the corner with the largest
    difference.
    """
    places, slots = list(stencils), scene.neighbourhood.slots
    weights = np.array(
        [[*stencil.neighbours.values(), *stencil.centre] for stencil in stencils.values()]
    )
    differences = weights - weights[0]
    worst = int(np.abs(differences).max(axis=(1, 2, 3)).argmax())
    if not np.abs(differences[worst]).max() > ROUNDING * np.abs(weights[0]).max():
        return
    corner = f"({places[worst].X.x:.6g}, {places[worst].X.y:.6g})"
    parameters = ", ".join(scene.experiment.rule.numeric_parameters())
    verdict = f"; a material constant has no such effect: {parameters} is not a Poisson ratio"
    text = (
        f"the rule depends on the position: the weights at {corner} differ from those in the middle"
    )
    # The effect on a translation is the clearest evidence, if there is one.
    defect = differences[worst, : len(slots[0])].sum(axis=0) + differences[worst, -len(slots)]
    entry = int(np.abs(defect).argmax())
    if abs(defect.ravel()[entry]) >= ROUNDING:
        to, along = "xy"[entry // 2], "xy"[entry % 2]
        text = (
            f"the rule depends on the position: under a translation by 1 along {along}, the "
            f"particle at {corner} of the body moves {defect.ravel()[entry]:.6g} more along {to} "
            "per step than the one in the middle"
        )
    yield text + (verdict if parameters else "")


def _move(
    scene: Scene, slots: Slots, d: Differences, at: Here, missing: frozenset[Slot] = frozenset()
) -> Floats:
    zero = vector(np.zeros(scene.axes))
    with np.errstate(all="ignore"):
        move_vector = move(
            scene, slots, lambda k: vector(d[k]) if k in d else zero, at._replace(u=zero), missing
        )
    return np.array(move_vector, float)


def identified(scene: Scene) -> Identity:
    """Identify the scene's rule on its lattice and neighbourhood.

    Raises
    ------
    PluginError
        If the rule's own code fails.
    ExperimentError
        If the rule returns values that are not finite.
    """
    experiment, cell = scene.experiment, scene.experiment.lattice.cell()
    spacing = spacing_of(cell)
    with errors_attributed_to(experiment.rule, "when evaluated for small displacements", "rule"):
        response = probe(scene, spacing)
    _refuse_no_numbers(response.stencil, experiment.rule.type)
    stencil, degree = primitive(cell, response.stencil), len(scene.neighbourhood.slots[0])
    long_waves, reasons_of_waves = _long_waves(stencil)
    if long_waves is None and not response.differentiable:
        reasons_of_waves = []  # They would follow from derivatives that do not exist.
    reasons = (*response.reasons, *reasons_of_waves)
    kind = ELASTICITY if long_waves is not None and long_waves.diffusivity is None else DIFFUSION
    identity = Identity(
        name=experiment.name,
        lattice=experiment.lattice.type,
        neighbours=f"{degree} neighbours ({experiment.neighbours.type})",
        rule=experiment.rule.type,
        reasons=reasons,
        spacing=spacing,
        linear=response.linear,
        turns=response.turns,
        symmetric=response.symmetric,
        rests_at_edges=response.rests_at_edges,
        stencil=stencil,
        spectrum=spectrum(stencil, experiment.stepping.memory),
        relaxation=experiment.stepping.relaxation,
        memory=experiment.stepping.memory,
        kind=NEITHER if reasons else kind,
        long=long_waves,
    )
    return replace(identity, notes=tuple(notes_on(identity, scene)))


def _refuse_no_numbers(stencil: Stencil, rule: str) -> None:
    if not np.isfinite([*stencil.centre, *stencil.neighbours.values()]).all():
        raise ExperimentError(
            (
                f"'{rule}' returns values that are not finite for small displacements of a body at "
                "rest; check its divisions"
            ),
            ("rule",),
        )


def _long_waves(stencil: Primitive) -> tuple[LongWaves | None, list[str]]:
    """Expand the response to long waves, and list reasons why it is neither diffusion nor
    elasticity."""
    waves = slow_waves(stencil)
    if isinstance(waves, str):
        return None, [waves]
    along = [waves.series(np.array(k), 2) for k in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]
    second = second_order(*(np.array(series[2].real, float) for series in along))
    reasons = [*_drift(np.array([series[1].imag for series in along[:2]], float))]
    if np.abs(second).max() <= SAME * np.abs(stencil.matrix).max():
        reasons.append("the second-order terms vanish: long waves do not decay as in diffusion")
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
    """Describe the first-order terms i A_1 k, along x and y: a step takes u(x) to u(x - A_1)."""
    if np.abs(first).max() < SAME:
        return []
    velocity = first.trace(axis1=1, axis2=2) / 2
    return [
        "opposite neighbours have different weights: displacements drift, "
        f"on average by ({velocity[0]:.6g}, {velocity[1]:.6g}) h per step"
    ]
