"""Stencil of a rule at rest on the infinite lattice: derivatives of its functions, and their symbol
for waves.

Derivatives of elementwise functions are taken by a complex step where that is valid, else by
differences. Functions built from arithmetic and roots are analytic, and ∂f = Im f(x + ih) / h is
exact to rounding. Others (an absolute value, a hypotenuse) drop the imaginary part or refuse it: a
central difference detects this and replaces it with about nine digits.

A step multiplies a displacement exp(iθ·c) over repeat cells c by the symbol, a matrix of blocks
(axis, axis) over sublattices. Modes of a finite body lie within the range of the waves as long as
its frame copies or mirrors: a bound that costs milliseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from operator import add
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pbdkit.linear.spectrum import Complex, modes
from pbdkit.plugin import Here, Slot
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.rule_evaluation import Evaluator, summed

NO_REMEDY = "; no relaxation helps: look at the rule, and keep |memory| below 1"
"""What a bound adds where no relaxation is stable."""
TINY, SMALL = 1e-100, 1e-6
"""The steps of derivatives, imaginary and real, as shares of the spacing."""
Moved = Callable[[complex], tuple[Any, Any]]
"""The components of a function's value, for a step along one direction."""


def derivative(moved: Moved, shape: tuple[int, ...], unit: float) -> NDArray[np.float64]:
    """(component, *shape): the derivative at a step of zero; steps are shares of a unit."""
    small, tiny = SMALL * unit, TINY * unit
    with np.errstate(all="ignore"):
        ahead, behind = array_of(moved(small), shape), array_of(moved(-small), shape)
        difference: NDArray[np.float64] = (ahead - behind).real / (2 * small)
        try:
            exact: NDArray[np.float64] = array_of(moved(1j * tiny), shape).imag / tiny
        except (TypeError, ValueError):  # a function that takes no complex numbers
            return difference
    known = np.isfinite(exact) & np.isfinite(difference)
    scale = np.abs(difference).max(initial=1.0, where=known)
    off = np.abs(exact - difference).max(initial=0.0, where=known)
    return exact if off <= 1e-4 * scale else difference


def array_of(components: tuple[Any, ...], shape: tuple[int, ...]) -> NDArray[Any]:
    """(component, *shape) of components that may be the same everywhere."""
    return np.array([np.broadcast_to(component, shape) for component in components])


Floats = NDArray[np.float64]
NOWHERE = Here(cast(Any, None))


@dataclass(frozen=True)
class Stencil:
    """`own` is (sublattice, axis of the move, axis of u), `neighbours` holds W_k of every slot,
    (axis of the move, axis of u)."""

    own: Floats
    neighbours: dict[Slot, Floats]


def move(scene: Scene, slots: Sequence[Slot], difference: Callable[[Slot], Any], here: Here) -> Any:
    """The rule's move of a particle with all its neighbours, d = difference(slot) along each."""
    evaluator = Evaluator(scene)
    neighbours = zip(slots, evaluator.everywhere(slots), strict=True)
    parts = [(evaluator.contribution(difference(s), here.u, to), None) for s, to in neighbours]
    return evaluator.move(summed(parts), here._replace(own=evaluator.initial_own()))


def _derivatives(scene: Scene, slots: Sequence[Slot], at: Here) -> Floats:
    """∂move/∂u_j at rest with all neighbours where they are, and after it ∂move/∂u_k of each slot,
    (1 + slot, axis of the move, axis of u); all of them are asked for at once."""
    count, axes = 1 + len(slots), scene.axes
    nudges = np.eye(count * axes).reshape(count, axes, -1)
    seen = dict(zip(slots, nudges[1:] - nudges[0], strict=True))

    def moved(step: complex) -> Any:
        def difference(slot: Slot) -> Any:
            return vector(step * seen[slot])

        return move(scene, slots, difference, at._replace(u=vector(step * nudges[0])))

    found = derivative(moved, nudges.shape[-1:], scene.neighbourhood.nudge_unit)
    return found.reshape(axes, count, axes).swapaxes(0, 1)


def linearised(scene: Scene, at: Here = NOWHERE) -> Stencil:
    """The stencil of the scene's rule, of all its rules together where it works on the moves of
    another; `at` says where for rules that ask."""
    every = scene.neighbourhood.slots
    found = [_derivatives(scene, slots, at) for slots in every]
    own = np.array([answers[0] for answers in found])
    neighbours = {
        slot: answer
        for slots, answers in zip(every, found, strict=True)
        for slot, answer in zip(slots, answers[1:], strict=True)
    }
    stencil = Stencil(own, neighbours)
    return _composed(stencil, linearised(scene.inner, at)) if scene.inner else stencil


def _composed(outer: Stencil, inner: Stencil) -> Stencil:
    """The stencil of a rule that works on the moves of another."""
    own = np.zeros_like(outer.own)
    neighbours: dict[Slot, Floats] = {}
    known: dict[tuple[int, int, Index], Slot] = {}
    for (first, W), (second, V) in product(_with_itself(outer), _with_itself(inner)):
        if first.target != second.source:
            continue
        slot = _after(first, second)
        if slot.source == slot.target and not any(slot.cell):
            own[slot.source] += W @ V
        else:
            slot = known.setdefault((slot.source, slot.target, slot.cell), slot)
            neighbours[slot] = neighbours.get(slot, 0.0) + W @ V
    return Stencil(own, neighbours)


def _with_itself(stencil: Stencil) -> Iterator[tuple[Slot, Floats]]:
    for s, own in enumerate(stencil.own):
        nowhere = (0,) * len(own)
        yield Slot(s, s, nowhere, nowhere, vector(np.zeros(len(own))), 0), own
    yield from stencil.neighbours.items()


def _after(first: Slot, second: Slot) -> Slot:
    """Where two slots lead, one after the other."""
    cell, site = map(add, first.cell, second.cell), map(add, first.site, second.site)
    rest, shell = first.rest + second.rest, first.shell + second.shell
    return Slot(first.source, second.target, tuple(cell), tuple(site), rest, shell)


WAVES = 48
"""Wave numbers along each axis; an even number, so that the shortest waves are among them."""

MOST_ANSWERS = 100_000
"""Of a rule that is asked what each neighbour does to each: about half a second."""
LITTLE_MEMORY = 0.9
"""Up to which plane waves were seen to bound random bodies (tests/stability/test_forecast.py)."""


@dataclass(frozen=True)
class Bound:
    """Over all waves: the smallest and largest real part and the largest imaginary part of the
    eigenvalues of the rule's step without relaxation and memory, and the largest modulus of the
    solver's step with them."""

    smallest: float
    largest: float
    imaginary: float
    radius: float

    def largest_stable_relaxation(self, memory: float) -> float | None:
        """2 (1 + memory) / (1 - λ_min); None where eigenvalues are complex or above 1, or the
        memory grows by itself: no such bound exists there."""
        if self.imaginary > 1e-9 or self.largest > 1.0 + 1e-9 or abs(memory) >= 1.0:
            return None
        return 2.0 * (1.0 + memory) / (1.0 - self.smallest) if self.smallest < 1.0 - 1e-9 else None


def wave_bound(scene: Scene) -> Bound | None:
    """The bound for the scene's rule at rest.

    None for rules that depend on the place or take no single numbers, where neighbours are found
    anew or are more than some 300, and where the frame lags: its delay can make modes grow that no
    plane wave knows.
    """
    if sum(len(slots) ** 2 for slots in scene.neighbourhood.slots) > MOST_ANSWERS:
        return None
    solver = scene.experiment.stepping
    if scene.lag or scene.experiment.rule.uses_reference or scene.experiment.neighbours.nearness():
        return None
    try:
        with blaming(scene.experiment.rule, "when asked about plane waves"):
            eigenvalues = _eigenvalues(_symbols(scene)).ravel()
    except (Exception, SystemExit):  # a prediction stops no run; the run names the rule at fault
        return None
    if not np.isfinite(eigenvalues).all():
        return None
    radius = float(np.abs(modes(eigenvalues, solver.relaxation, solver.memory)).max())
    real, imaginary = eigenvalues.real, float(np.abs(eigenvalues.imag).max())
    return Bound(float(real.min()), float(real.max()), imaginary, radius)


def bounds_the_body(scene: Scene) -> bool:
    """Whether no mode of the body can grow where no wave does: particles with fewer neighbours have
    modes of their own, so have bodies of several materials, and with much memory frames on leaning
    lattices."""
    reach = scene.neighbourhood.reach
    whole = scene.experiment.frame.depth(reach) >= reach and not scene.experiment.rule.varying
    return whole and abs(scene.experiment.stepping.memory) <= LITTLE_MEMORY


def _eigenvalues(matrices: Complex) -> Complex:
    """Of (wave, n, n) matrices; two by two in closed form."""
    if matrices.shape[-1] > 2:
        found: Complex = np.linalg.eigvals(matrices)
        return found
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    middle, half = (a + d) / 2, (a - d) / 2
    root = np.sqrt(half * half + b * c)
    return np.stack([middle + root, middle - root])


def _symbols(scene: Scene) -> Complex:
    """(wave, axes · S, axes · S): the rule's step on plane waves; opposite ones answer
    alike."""
    stencil = linearised(scene)
    angle, axes, sites = 2 * np.pi * np.arange(WAVES) / WAVES, scene.axes, len(stencil.own)
    waves = [angle[: WAVES // 2 + 1], *[angle] * (axes - 1)]
    theta = np.stack(np.meshgrid(*waves, indexing="ij"), axis=-1).reshape(-1, axes)
    symbols: Complex = np.zeros((len(theta), sites, axes, sites, axes), complex)
    symbols += np.eye(sites * axes).reshape(symbols.shape[1:])
    for s, own in enumerate(stencil.own):
        symbols[:, s, :, s] += own
    for slot, matrix in stencil.neighbours.items():
        phase = np.exp(1j * theta @ np.array(slot.cell, float))
        symbols[:, slot.source, :, slot.target] += phase[:, None, None] * matrix
    return symbols.reshape(len(theta), sites * axes, sites * axes)
