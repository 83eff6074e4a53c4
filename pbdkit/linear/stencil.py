"""Stencil of a rule at rest on the infinite lattice. It consists of the derivatives of the rule's
functions; its symbol describes the effect on plane waves.

Derivatives of elementwise functions are computed by a complex step if that is valid, otherwise by
differences. Functions that consist of arithmetic and roots are analytic, so that ∂f = Im f(x + ih)
/ h is exact except for rounding. Other functions, such as an absolute value, discard the imaginary
part or raise an error. This is detected by comparison with a central difference, which has about
nine correct digits and is then used instead.

A plane wave is a displacement exp(iθ·c) that depends on the repeat cell c. A step multiplies it by
the symbol, a matrix with a block (axis, axis) for each pair of sublattices. If the frame of a
finite body copies or mirrors displacements, the eigenvalues of the body lie within the range of the
eigenvalues of plane waves. This bound is computed within milliseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import add
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.linear.spectrum import Complex, modes
from pbdkit.plugin import Here, Slot
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.rule_evaluation import Evaluator

TINY = 1e-100
"""Imaginary step of derivatives, as a fraction of the spacing."""

SMALL = 1e-6
"""Real step of derivatives, as a fraction of the spacing."""

Moved = Callable[[complex], tuple[Any, Any]]
"""Type of a function that maps the size of a step along one direction to the components of a value
after the step."""


def derivative(moved: Moved, shape: tuple[int, ...], unit: float) -> NDArray[np.float64]:
    """Differentiate a function of a displacement at zero displacement. The result has the shape
    (component, *shape).

    Parameters
    ----------
    moved
        Function of the displacement. Its values are vectors.
    shape
        Shape of its components.
    unit
        Length by which the small displacements of the differentiation are multiplied.
    """
    small, tiny = SMALL * unit, TINY * unit
    with np.errstate(all="ignore"):
        ahead, behind = array_of(moved(small), shape), array_of(moved(-small), shape)
        difference: NDArray[np.float64] = (ahead - behind).real / (2 * small)
        try:
            exact: NDArray[np.float64] = array_of(moved(1j * tiny), shape).imag / tiny
        except (TypeError, ValueError):  # The function does not accept complex numbers.
            return difference
    finite = np.isfinite(exact) & np.isfinite(difference)
    scale = np.abs(difference).max(initial=1.0, where=finite)
    error = np.abs(exact - difference).max(initial=0.0, where=finite)
    return exact if error <= 1e-4 * scale else difference


def array_of(components: tuple[Any, ...], shape: tuple[int, ...]) -> NDArray[Any]:
    """Broadcast components to a shape, and stack them to an array (component, *shape)."""
    return np.array([np.broadcast_to(component, shape) for component in components])


NOWHERE = Here(cast(Any, None))
"""Place of a particle that is passed to rules that do not depend on the place."""


@dataclass(frozen=True)
class Stencil:
    """Derivatives of a rule's move at rest, W_k = ∂move/∂u_k.

    Parameters
    ----------
    centre : (sublattice, axis of the move, axis of u)
        Derivative with respect to the particle's own displacement.
    neighbours : (axis of the move, axis of u) by slot
        Derivative with respect to the displacement of each neighbour.
    """

    centre: Floats
    neighbours: dict[Slot, Floats]


def move(
    scene: Scene,
    slots: Sequence[Slot],
    difference: Callable[[Slot], Any],
    here: Here,
    missing: Container[Slot] = (),
) -> Any:
    """Compute the move of a particle.

    Parameters
    ----------
    slots
        All slots of its sublattice.
    difference
        Difference d of the displacements along each slot.
    here
        Place of the particle and its displacement.
    missing
        Slots along which there is no neighbour.
    """
    evaluator = Evaluator(scene)
    neighbours = [
        replace(neighbour, present=np.zeros((), bool)) if slot in missing else neighbour
        for slot, neighbour in zip(slots, evaluator.everywhere(slots), strict=True)
    ]
    total = evaluator.total([*map(difference, slots)], here.u, neighbours)
    return evaluator.move(total, here._replace(own=evaluator.initial_own()))


def _derivatives(scene: Scene, slots: Sequence[Slot], at: Here) -> Floats:
    """Compute the derivatives of the move at rest, (1 + slot, axis of the move, axis of u).

    The first entry is the derivative with respect to the displacement of the particle itself.
    """
    count, axes = 1 + len(slots), scene.axes
    steps = np.eye(count * axes).reshape(count, axes, -1)
    differences = dict(zip(slots, steps[1:] - steps[0], strict=True))

    def moved(step: complex) -> Any:
        def difference(slot: Slot) -> Any:
            return vector(step * differences[slot])

        return move(scene, slots, difference, at._replace(u=vector(step * steps[0])))

    derivatives = derivative(moved, steps.shape[-1:], scene.neighbourhood.nudge_unit)
    return derivatives.reshape(axes, count, axes).swapaxes(0, 1)


def linearised(scene: Scene, at: Here = NOWHERE) -> Stencil:
    """Return the stencil of the scene's rule. If there is an inner rule, both stencils are
    composed.

    Parameters
    ----------
    at
        Place of the particle, for rules that depend on the place.
    """
    slot_lists = scene.neighbourhood.slots
    derivatives = [_derivatives(scene, slots, at) for slots in slot_lists]
    centre = np.array([entries[0] for entries in derivatives])
    neighbours = {
        slot: entry
        for slots, entries in zip(slot_lists, derivatives, strict=True)
        for slot, entry in zip(slots, entries[1:], strict=True)
    }
    stencil = Stencil(centre, neighbours)
    return _composed(stencil, linearised(scene.inner, at)) if scene.inner else stencil


def _composed(outer: Stencil, inner: Stencil) -> Stencil:
    """Return the stencil of a rule (`outer`) that is applied to the moves of another rule
    (`inner`)."""
    centre = np.zeros_like(outer.centre)
    neighbours: dict[Slot, Floats] = {}
    slots: dict[tuple[int, int, Index], Slot] = {}
    for (first, W), (second, V) in product(_with_itself(outer), _with_itself(inner)):
        if first.target != second.source:
            continue
        slot = _after(first, second)
        if slot.source == slot.target and not any(slot.cell):
            centre[slot.source] += W @ V
        else:
            slot = slots.setdefault((slot.source, slot.target, slot.cell), slot)
            neighbours[slot] = neighbours.get(slot, 0.0) + W @ V
    return Stencil(centre, neighbours)


def _with_itself(stencil: Stencil) -> Iterator[tuple[Slot, Floats]]:
    for s, centre in enumerate(stencil.centre):
        nowhere = (0,) * len(centre)
        yield Slot(s, s, nowhere, nowhere, vector(np.zeros(len(centre))), 0), centre
    yield from stencil.neighbours.items()


def _after(first: Slot, second: Slot) -> Slot:
    """Return the slot from the start of the first slot to the end of the second slot, where the
    second begins at the end of the first."""
    cell, site = map(add, first.cell, second.cell), map(add, first.site, second.site)
    rest, shell = first.rest + second.rest, first.shell + second.shell
    return Slot(first.source, second.target, tuple(cell), tuple(site), rest, shell)


def stability_remedy(bound: float | None, memory: float) -> str:
    """Return the end of a message about divergence.

    Parameters
    ----------
    bound
        Largest stable relaxation; None if no relaxation is stable.
    memory
        Momentum of the solver.
    """
    if bound:
        return f"; it is stable below {bound:.4g}"
    momentum = ", and keep |memory| below 1" if memory else ""
    return f"; no relaxation makes it stable: check the rule{momentum}"


WAVES = 48
"""Number of wave numbers along each axis. It is even, so that the shortest waves are included."""

MAX_EVALUATIONS = 100_000
"""Largest number of evaluations of a rule, counted by pairs of neighbours. They take about half a
second."""
LITTLE_MEMORY = 0.9
"""Largest momentum for which, in tests with random bodies, plane waves bounded the spectrum
(tests/stability/test_forecast.py)."""


@dataclass(frozen=True)
class Bound:
    """Bounds of eigenvalues λ over all plane waves.

    Parameters
    ----------
    smallest, largest
        min Re λ and max Re λ of the rule's step without relaxation and momentum.
    imaginary
        max |Im λ| of the same step.
    radius
        max |μ| of the step with the relaxation and momentum of the solver.
    """

    smallest: float
    largest: float
    imaginary: float
    radius: float

    def largest_stable_relaxation(self, memory: float) -> float | None:
        """Return 2 (1 + memory) / (1 - λ_min).

        Return None if eigenvalues are complex or exceed 1, or if |memory| ≥ 1, because no such
        bound exists in these cases.
        """
        if self.imaginary > 1e-9 or self.largest > 1.0 + 1e-9 or abs(memory) >= 1.0:
            return None
        return 2.0 * (1.0 + memory) / (1.0 - self.smallest) if self.smallest < 1.0 - 1e-9 else None


def wave_bound(scene: Scene) -> Bound | None:
    """Compute the bound of plane waves for the scene's rule at rest.

    Return None for rules that depend on the place or do not accept scalars. Also return None if
    neighbours are searched at every step, or if there are more than about 300 neighbours. Return
    None, too, if the frame has a delay, because a delay can cause growth of modes that are not
    plane waves.
    """
    if sum(len(slots) ** 2 for slots in scene.neighbourhood.slots) > MAX_EVALUATIONS:
        return None
    solver = scene.experiment.stepping
    if (
        scene.frame_delay
        or scene.experiment.rule.uses_reference
        or scene.experiment.neighbours.nearness()
    ):
        return None
    try:
        with errors_attributed_to(scene.experiment.rule, "when evaluated for plane waves"):
            eigenvalues = _eigenvalues(_symbols(scene)).ravel()
    except MemoryError:
        raise
    except (
        Exception,
        SystemExit,
    ):  # A failed prediction must not stop a run; the run reports the error.
        return None
    if not np.isfinite(eigenvalues).all():
        return None
    radius = float(np.abs(modes(eigenvalues, solver.relaxation, solver.memory)).max())
    real, imaginary = eigenvalues.real, float(np.abs(eigenvalues.imag).max())
    return Bound(float(real.min()), float(real.max()), imaginary, radius)


def bounds_the_body(scene: Scene) -> bool:
    """Return whether plane waves bound the modes of the finite body.

    They may not bound them if particles lack neighbours, if the body consists of several materials
    or, with large momentum, if the body has a frame on an oblique lattice.
    """
    reach = scene.neighbourhood.reach
    whole = scene.experiment.frame.depth(reach) >= reach and not scene.experiment.rule.varying
    return whole and abs(scene.experiment.stepping.memory) <= LITTLE_MEMORY


def _eigenvalues(matrices: Complex) -> Complex:
    """Compute the eigenvalues of matrices, (wave, n, n). For n = 2, they are computed in closed
    form."""
    if matrices.shape[-1] > 2:
        eigenvalues: Complex = np.linalg.eigvals(matrices)
        return eigenvalues
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    middle, half = (a + d) / 2, (a - d) / 2
    root = np.sqrt(half * half + b * c)
    return np.stack([middle + root, middle - root])


def _symbols(scene: Scene) -> Complex:
    """Return the symbols of the rule's step, (wave, axes · S, axes · S).

    Only one of each pair of opposite waves is included; both have the same eigenvalues.
    """
    stencil = linearised(scene)
    axes, sites, numbers = scene.axes, len(stencil.centre), np.arange(WAVES)
    along = [numbers[: WAVES // 2 + 1], *[numbers] * (axes - 1)]
    waves = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, axes)
    matrices = np.zeros((1 + len(stencil.neighbours), sites, axes, sites, axes), complex)
    matrices[0] = np.eye(sites * axes).reshape(matrices.shape[1:])
    for s, centre in enumerate(stencil.centre):
        matrices[0, s, :, s] += centre
    for n, (slot, matrix) in enumerate(stencil.neighbours.items(), 1):
        matrices[n, slot.source, :, slot.target] = matrix
    cells = np.array([[0] * axes, *(slot.cell for slot in stencil.neighbours)])
    phases = np.exp(2j * np.pi / WAVES * numbers)[waves @ cells.T % WAVES]
    symbols: Complex = phases @ matrices.reshape(len(matrices), -1)
    return symbols.reshape(len(waves), sites * axes, sites * axes)
