"""The plan of a kernel: the rules of a scene as its levels, what the kernel has to hold, the words
that its lines are written in, and the sizes of passes of several steps.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.plugin import (
    Component,
    FollowerRule,
    FractureModel,
    Here,
    Loadable,
    RenewsBonds,
    RenewsParticles,
    Softens,
    SoftensCells,
    TearsCells,
    Vector,
)
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.rule import shares_particles
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import (
    Home,
    Number,
    VisibleNumbers,
    bond_numbers,
    numbers_of,
    particle_numbers,
)
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses, tried
from pbdkit.stepping.followers import target
from pbdkit.stepping.kernel import Function, KernelWriter, Lines
from pbdkit.stepping.leaders import Clamps, Guidance, leader_lists
from pbdkit.stepping.numba_engine.cache import load_kernel
from pbdkit.stepping.numba_engine.time_skewing import (
    CACHE,
    Skew,
    cell_bytes,
    exceeds_cache,
    single_steps,
)
from pbdkit.stepping.program import program_of
from pbdkit.stepping.rule_evaluation import Evaluator
from pbdkit.stepping.state import started
from pbdkit.stepping.step import Led


@dataclass(frozen=True)
class Level:
    """A rule whose moves one sweep makes; `scene` has it as its rule. The first works on
    displacements, each other on the moves of the one before."""

    number: int
    scene: Scene
    parts: tuple[int, ...]
    """Of each contribution, the number of its components."""

    @cached_property
    def seen(self) -> VisibleNumbers:
        """The numbers that the rule sees."""
        scene = self.scene
        return numbers_of(scene.experiment, scene.constants, weighs_cells=scene.cells is not None)

    @property
    def fields(self) -> int:
        """How many of the rule's parameters differ from place to place."""
        return len(self.scene.constants.by_particle)

    @property
    def source(self) -> str:
        """The planes that it works on; the first letter names what stands there at a particle."""
        return f"z{self.number - 1}" if self.number else "u"

    @property
    def totals(self) -> list[str]:
        """The names of the sums of contributions, component by component."""
        return [f"t{n}" for n in range(sum(self.parts))]


MOST_BITS = 32
"""Neighbours of a sublattice up to which its slots are written out and lost bonds are bits."""


@dataclass(frozen=True)
class Plan:
    """A scene's levels, the last of which moves the particles, whether it is stepped on several
    threads, the names of what all functions of its kernel may use: mostly arrays; whether
    bonds are judged apart from moves, whatever the model; and whether the kernel is for a GPU,
    whose threads take one place after the other from flat arrays."""

    scene: Scene
    levels: tuple[Level, ...]
    parallel: bool
    shared: tuple[str, ...] = ("step",)
    apart: bool = False
    gpu: bool = False

    @property
    def axes(self) -> str:
        """The names of the axes, a letter each."""
        return "xyz"[: self.scene.axes]

    @cached_property
    def leads(self) -> dict[str, str]:
        """The lists of leaders by the ending of their names, with the axes along which they
        lead."""
        return leader_lists(self.scene)

    @cached_property
    def slanted(self) -> list[tuple[str, str]]:
        """The axes along which moves may add to moves along others, with those others."""
        return list(permutations(self.axes, 2)) if Guidance(self.scene).slanted else []

    @property
    def lead(self) -> tuple[str, ...]:
        """The cell indices of a row of particles."""
        return ("i", "l")[: self.scene.axes - 1]

    @property
    def long(self) -> bool:
        """Whether there are too many neighbours to write them out."""
        return max(map(len, self.scene.neighbourhood.slots)) > MOST_BITS

    def is_loaded(self, level: Level) -> bool:
        """Whether loads act on what moves by the rule of that level: the last alone."""
        return self.scene.loads is not None and level is self.levels[-1]

    @property
    def model(self) -> Any:
        """The fracture model, None where nothing breaks."""
        return self.scene.experiment.fracture if self.scene.has_fracture else None

    @property
    def bonds(self) -> int:
        """How many numbers are remembered of each bond."""
        return sum(number.home is Home.BOND for number in self.levels[-1].seen.bond)

    @cached_property
    def rotations(self) -> tuple[int, ...]:
        """The numbers of each particle that clamped leaders prescribe."""
        return Clamps(self.scene).numbers

    @cached_property
    def kept(self) -> tuple[int, ...]:
        """The numbers of each particle that are kept as they were before the step: all that change
        where neighbours see them, else those that clamped leaders prescribe."""
        if not self.shares:
            return self.rotations
        own = self.levels[-1].seen.own
        return tuple(m for m, number in enumerate(own) if number.changes)

    @property
    def shares(self) -> bool:
        """Whether neighbours see what is remembered of each other."""
        return shares_particles(self.scene.experiment.rule)

    @property
    def read(self) -> tuple[str, ...]:
        """The arrays of what is remembered of particles, as it was before the step where neighbours
        see it."""
        kept, count = self.kept if self.shares else (), len(self.levels[-1].seen.own)
        return tuple(f"was{m}" if m in kept else f"own{m}" for m in range(count))

    @property
    def shown(self) -> tuple[str, ...]:
        """The arrays of what neighbours see of each other."""
        return self.read if self.shares else ()

    @property
    def limits(self) -> int:
        """How many limits differ from bond to bond."""
        return len(self.scene.constants.by_bond)

    @property
    def mixed(self) -> int:
        """Of how many stiffnesses there are cells besides that of the rule."""
        return len(self.scene.cells.mixed) if self.scene.cells else 0

    @property
    def tears(self) -> bool:
        """Whether the rule computes what torn cells exert."""
        return self.scene.tears

    @property
    def softens_cells(self) -> bool:
        """Whether the fracture model softens bonds by the stress of the cells beside them."""
        return isinstance(self.model, SoftensCells)

    @property
    def bonds_first(self) -> bool:
        """Whether bonds are judged in a pass of their own, and not by the sweep at both ends."""
        if self.model is None:
            return False
        renews = isinstance(self.model, RenewsBonds)
        return self.apart or renews or self.long or (self.tears and self.model.can_break)

    @property
    def judged(self) -> bool:
        """Whether the sweep judges the bonds."""
        return self.model is not None and not (self.bonds_first or self.tears)

    @property
    def real(self) -> str:
        """The kind of the scene's numbers."""
        return "real" if self.scene.experiment.stepping.precision == "float32" else "double"

    def over(self, count: str) -> str:
        """The numbers below a count; in a kernel for a GPU those of one of its threads."""
        return f"range(me, {count}, threads)" if self.gpu else f"range({count})"

    def renumbered(self, scene: Scene) -> Plan:
        """The same with other numbers."""
        levels, below = list[Level](), scene
        for level in reversed(self.levels):
            levels.insert(0, replace(level, scene=below))
            below = below.inner or below
        return replace(self, scene=scene, levels=tuple(levels))

    def number(self, value: float) -> str:
        """A literal in the scene's precision."""
        return f"real({float(value)!r})" if self.real == "real" else repr(float(value))

    def rounded(self, value: str) -> str:
        """A word for a value in the scene's precision: numbers of Python's count as such."""
        return f"real({value})" if self.real == "real" else value

    def each(self, pattern: str, axes: str = "") -> list[str]:
        """The pattern for each axis, or some, with its name for `@` and its number for `#`."""
        named = enumerate(axes or self.axes)
        return [pattern.replace("@", c).replace("#", str(a)) for a, c in named]

    def vector(self, pattern: str) -> str:
        """A vector whose components have this pattern."""
        return f"Vector({', '.join(self.each(pattern))})"

    def literal(self, values: Iterable[float]) -> str:
        """A vector of these numbers."""
        return f"Vector({', '.join(map(self.number, values))})"

    def row(self, array: str, first: object, step: Sequence[object] | None = None) -> str:
        """The places j0 to j1 of a row, or those a step of cells away."""
        *lead, last = step or [0] * self.scene.axes
        at = [_sum(name, m) for name, m in zip(self.lead, lead, strict=True)]
        return f"{array}[{', '.join([str(first), *at])}, {_sum('j0', last)}:{_sum('j1', last)}]"

    def local_places(self, s: str) -> list[str]:
        """X from site (0, 0), in the order of operations of the rasters."""
        index = [f"{name} + first[{n}]" for n, name in enumerate((*self.lead, "j + j0"))]
        found = []
        for n, along in enumerate(zip(*self.scene.raster.cell.vectors, strict=True)):
            terms = [f"({at}) * {float(v)!r}" for at, v in zip(index, along, strict=True)]
            found.append(f"at[{s}, {n}] + ({' + '.join(terms)})")
        return found

    def flat(self, s: str) -> str:
        """The place at which a row begins in flat arrays of all sublattices."""
        found = s
        for axis, name in enumerate((*self.lead, "j0")):
            found = f"({found}) * kind.shape[{axis + 1}] + {name}"
        return found


def _sum(name: str, step: object) -> str:
    return name if step == 0 else f"{name} + {step}"


def listed(texts: Iterable[str]) -> str:
    """Arguments of a named tuple, of which there may be none."""
    return "".join(f"{text}, " for text in texts)


def values(numbers: Sequence[Number], where: dict[Home, str]) -> str:
    """The arguments of a named tuple: by home the pattern of where its n-th number is found."""
    counts = defaultdict[Home, Iterator[int]](count)
    return listed(where[number.home].format(n=next(counts[number.home])) for number in numbers)


@dataclass(frozen=True)
class Passes:
    """The functions of a kernel that a step calls: the one that judges bonds, where they are judged
    apart from moves, the sweep of each level, and by name those that operations bring along."""

    judge: Function | None
    sweeps: Sequence[Function]
    others: dict[str, Function] = field(default_factory=dict)


class PlanWriter(KernelWriter):
    """A writer of the kernel of a plan, with the function that it writes into."""

    def __init__(self, plan: Plan, out: Function, passes: Passes) -> None:
        self.plan, self.out, self.passes = plan, out, passes

    def rows(self, name: str, write: Callable[[Function], None]) -> Function:
        """A function of some rows that an operation brings along."""
        if name not in self.passes.others:
            found = Function(self.plan.shared, name, "first_row", "last_row", "moment")
            write(found)
            self.passes.others[name] = found
        return self.passes.others[name]

    def each(self, pattern: str, axes: str = "") -> Lines:
        """As the plan does."""
        return self.plan.each(pattern, axes)

    def vector(self, pattern: str) -> str:
        """As the plan does."""
        return self.plan.vector(pattern)

    def number(self, value: float) -> str:
        """As the plan does."""
        return self.plan.number(value)

    def row(self, array: str, first: str) -> str:
        """As the plan does."""
        return self.plan.row(array, first)

    def places(self, sublattice: str) -> Lines:
        """In the order of operations of the rasters."""
        return self.plan.local_places(sublattice)

    def is_given(self, array: str) -> bool:
        """Among the names that its functions share."""
        return array in self.plan.shared


DEEP, BAND, ROW = 16, 8, 24 * 2**10
"""Steps of a pass, rows of a band, bytes of a row of a tile: all measured."""
SHORTEST = 256
"""Columns of a tile at least."""
AHEAD, ENTRIES = 64, 2**20
"""Steps for which the places of leaders are known beforehand, and their numbers altogether."""


def goes_deep(plan: Plan) -> bool:
    """Whether several steps of a scene go together in a pass."""
    return exceeds_cache(plan.scene) and not single_steps(plan.scene)


def pass_arrays(plan: Plan, pieces: int) -> dict[str, Any]:
    """What does not change from step to step: the sizes of a pass, with the pieces that go side by
    side; and of frame points, which are sorted, the first of each row, their columns, and the first
    rows of those whom they follow."""
    scene = plan.scene
    between = math.prod(scene.raster.shape[2:-1])
    tile = max(SHORTEST, ROW // (cell_bytes(scene) * between))
    sizes = DEEP, BAND, tile, CACHE // cell_bytes(scene), pieces
    arrays: dict[str, Any] = {"sizes": np.array(sizes)}
    if scene.frame:
        order, skew = frame_order(plan), Skew(scene)
        arrays |= _listed(plan, "frame", *skew.ready[:, order])
        arrays["frame_begun"] = skew.begun[0, order]
        if scene.frame.map.lag:
            real = scene.experiment.stepping.precision
            arrays |= {name: np.zeros(len(order), real) for name in plan.each("lag_@")}
    return arrays


def frame_order(plan: Plan) -> NDArray[np.intp]:
    """Frame points by the row and column at which they can follow."""
    return np.lexsort(Skew(plan.scene).ready[::-1])


def banded(plan: Plan, name: str, places: NDArray[np.intp]) -> tuple[Any, dict[str, Any]]:
    """The order of flat places by row and column, and in that order the first of each row and their
    columns."""
    found = np.unravel_index(places, plan.scene.raster.shape)
    order = np.lexsort((found[-1], found[1]))
    return order, _listed(plan, name, found[1][order], found[-1][order])


def _listed(
    plan: Plan, name: str, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> dict[str, Any]:
    first = np.searchsorted(rows, np.arange(plan.scene.raster.shape[1] + 1))
    return {f"{name}_rows": first, f"{name}_columns": columns}


def room_for(leaders: Led) -> int:
    """For how many steps the places of so many leaders are known beforehand."""
    return max(1, min(AHEAD, ENTRIES // max(1, sum(each.u.size for each in leaders))))


FUNCTIONS: dict[type[Any], tuple[str, ...]] = {
    FollowerRule: ("gather", "apply"),
    RenewsParticles: ("remember",),
    FractureModel: ("breaks", "fictitious"),
    Softens: ("seen",),
    RenewsBonds: ("update",),
    TearsCells: ("torn",),
}
"""The elementwise functions of rules and fracture models, and of those with a capability."""


def levels_of(scene: Scene) -> tuple[Level, ...]:
    """The innermost rule first."""
    scenes = [scene]
    while inner := scenes[0].inner:
        scenes.insert(0, inner)
    return tuple(Level(n, of, _parts(of)) for n, of in enumerate(scenes))


def functions_of(levels: Sequence[Level]) -> dict[str, Callable[..., Any]]:
    """The elementwise functions by their names in the kernel, a rule's with its level's number."""
    parts: dict[str, Any] = {str(level.number): level.scene.experiment.rule for level in levels}
    if levels[-1].scene.has_fracture:
        parts[""] = levels[-1].scene.experiment.fracture
    found: dict[str, Callable[..., Any]] = {}
    for number, part in parts.items():
        for kind, names in FUNCTIONS.items():
            if isinstance(part, kind):
                found |= {f"{name}{number}": getattr(part, name) for name in names}
        if isinstance(part, Loadable) and levels[-1].scene.loads:
            found[f"loaded{number}"] = part.loaded
    if isinstance(parts.get(""), SoftensCells):
        found["stress"] = CellStresses(levels[-1].scene).stress
    for operation in program_of(levels[-1].scene):
        found |= operation.functions()
    return found


def load_blamed(
    levels: Sequence[Level],
    source: str,
    arguments: tuple[Any, ...],
    more: Mapping[str, Callable[..., Any]] | None = None,
) -> Any:
    """The kernel, with `more` functions than those of its parts; what does not compile is named as
    the part's whose it is."""
    with blamed(levels):
        return load_kernel(source, functions_of(levels) | dict(more or {}), arguments)


@contextmanager
def blamed(levels: Sequence[Level]) -> Iterator[None]:
    """What does not compile meanwhile is named as the part's whose it is."""
    try:
        yield
    except Exception as error:
        with blaming(_culprit(levels, error), "to compile"):
            raise


def _culprit(levels: Sequence[Level], error: BaseException) -> Component:
    """The part whose function an error of the compiler names, else the rule."""
    functions, text = functions_of(levels).items(), str(error)
    named = [name for name, of in functions if f"function {of.__qualname__} " in text]
    for n, operated in enumerate(levels[-1].scene.operations):
        if f"displacement{n}" in named:
            return operated.operation
    if any(not name[-1].isdigit() for name in named):
        return levels[-1].scene.experiment.fracture
    culprit = next((level for level in levels if f"apply{level.number}" in named), levels[-1])
    return culprit.scene.experiment.rule


def _parts(scene: Scene) -> tuple[int, ...]:
    """The components of each contribution. What functions return by mistake is refused as numpy
    refuses it: a kernel would take some of it for numbers."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    ones = np.ones(1, experiment.stepping.precision)
    one: Vector = vector([ones] * scene.axes)
    own = started(scene, particle_numbers(experiment), (1,))
    slot = scene.neighbourhood.slots[0][0]
    with np.errstate(all="ignore"):
        if scene.has_fracture:
            with blaming(experiment.fracture, "to compile"):
                limits = scene.constants.limits[slot]
                bond = started(scene, bond_numbers(experiment), (1,))
                cells = tried(experiment.fracture, ones)
                evaluator.renew_bonds(one, slot.rest, limits, bond, np.ones(1, bool), cells)
                evaluator.breaks(one, slot.rest, limits, bond)
        with blaming(experiment.rule, "to compile"):
            total = evaluator.contribution(one, one, evaluator.everywhere([slot])[0])
            here = Here(one, one, one, scene.constants.of_particle(*own))
            for component in evaluator.move(total, here, one if scene.loads else None):
                target(ones, component, ones, experiment.stepping)
            evaluator.renew_particles(total, here, own, None)
    return tuple(len(part) if isinstance(part, Vector) else 1 for part in total)
