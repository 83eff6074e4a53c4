"""Plan of the kernel of a scene. It describes the levels of nested rules, the contents of the
kernel, the expressions in its lines, and the number of steps and the sizes of tiles in a pass."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Indices
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
    UsesAngles,
    Vector,
)
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.rule import shares_particles
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import (
    Number,
    Owner,
    Pairs,
    VisibleNumbers,
    bond_numbers,
    numbers_of,
    particle_numbers,
)
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses, tried
from pbdkit.stepping.followers import target
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.kernel import Function, KernelWriter, Lines
from pbdkit.stepping.numba_engine.cache import load_kernel
from pbdkit.stepping.numba_engine.time_skewing import (
    CACHE,
    cell_bytes,
    exceeds_cache,
    single_steps,
)
from pbdkit.stepping.program import Program, program_of
from pbdkit.stepping.rule_evaluation import Evaluator
from pbdkit.stepping.state import started


@dataclass(frozen=True)
class Level:
    """Rule that is evaluated in one sweep, and its scene. The first level acts on displacements,
    and every further level on the moves of the previous level."""

    number: int
    scene: Scene
    parts: tuple[int, ...]
    """Number of components of each contribution of a neighbour."""
    pair_parts: tuple[int, ...] = ()
    """Number of components of each contribution of a pair of neighbours."""

    @cached_property
    def seen(self) -> VisibleNumbers:
        """Names of the state variables and parameters that the rule receives."""
        scene = self.scene
        return numbers_of(scene.experiment, scene.constants, weighs_cells=scene.cells is not None)

    @property
    def fields(self) -> int:
        """Number of parameters of the rule that vary in space."""
        return len(self.scene.constants.by_particle)

    @property
    def source(self) -> str:
        """Prefix of the names of the arrays on which the rule acts. The first letter is the name of
        the vector at a particle."""
        return f"z{self.number - 1}" if self.number else "u"

    @property
    def totals(self) -> list[str]:
        """Names of the sums of contributions of neighbours, component by component."""
        return [f"t{n}" for n in range(sum(self.parts))]

    @property
    def pair_totals(self) -> list[str]:
        """Names of the sums of contributions of pairs, component by component."""
        first = sum(self.parts)
        return [f"t{first + n}" for n in range(sum(self.pair_parts))]

    @property
    def pairs(self) -> tuple[Pairs, ...]:
        """Pairs of slots of each sublattice; none if the rule does not use angles."""
        return self.scene.constants.pairs


MAX_BITS = 32
"""Number of neighbours of a sublattice up to which code is written slot by slot and broken bonds
are stored as bits."""


@dataclass(frozen=True)
class Plan:
    """Plan of the kernel of a scene.

    `levels` are the nested rules of the scene; the last one moves the particles. `parallel` is true
    for several threads. `shared` are the names, mostly of arrays, that all functions may use.
    `apart` is true if bonds are updated in a separate pass for every fracture model. `gpu` is true
    for a GPU, where each thread processes one place after the other in flat arrays.
    """

    scene: Scene
    levels: tuple[Level, ...]
    parallel: bool
    shared: tuple[str, ...] = ("step",)
    apart: bool = False
    gpu: bool = False

    @property
    def axes(self) -> str:
        """Names of the axes, one letter for each."""
        return "xyz"[: self.scene.axes]

    @cached_property
    def program(self) -> Program:
        """The operations of a step."""
        return program_of(self.scene)

    def opening(self, step: str) -> Lines:
        """Return the lines of operations at the beginning of a step of a call."""
        return [line for operation in self.program for line in operation.opening(step)]

    @property
    def lead(self) -> tuple[str, ...]:
        """Expression for the indices of a row of particles in rasters."""
        return ("i", "l")[: self.scene.axes - 1]

    @property
    def long(self) -> bool:
        """True if there are too many neighbours to write code for each of them."""
        return max(map(len, self.scene.neighbourhood.slots)) > MAX_BITS

    def is_loaded(self, level: Level) -> bool:
        """Return whether loads are added in the sweep of that level. Loads act in the last level
        only, which moves the particles."""
        return self.scene.loads is not None and level is self.levels[-1]

    @property
    def model(self) -> Any:
        """Fracture model, None if nothing breaks."""
        return self.scene.experiment.fracture if self.scene.has_fracture else None

    @property
    def bonds(self) -> int:
        """Number of state variables of each bond."""
        return sum(number.owner is Owner.BOND for number in self.levels[-1].seen.bond)

    @cached_property
    def prescribed_numbers(self) -> tuple[int, ...]:
        """State variables of particles that are set to prescribed values by operations."""
        return tuple(chain(*(operation.prescribed_numbers() for operation in self.program)))

    @cached_property
    def copied_values(self) -> tuple[int, ...]:
        """State variables of particles of which a copy from before the step is needed.

        If the rule reads state variables of neighbours, these are all variables that change;
        otherwise they are those that operations prescribe.
        """
        if not self.shares:
            return self.prescribed_numbers
        numbers = self.levels[-1].seen.own
        return tuple(m for m, number in enumerate(numbers) if number.changes)

    @property
    def shares(self) -> bool:
        """True if the rule reads state variables of neighbours."""
        return shares_particles(self.scene.experiment.rule)

    @property
    def read(self) -> tuple[str, ...]:
        """Names of the arrays from which state variables of particles are read. If rules read state
        variables of neighbours, these arrays contain the values from before the step."""
        copies, count = self.copied_values if self.shares else (), len(self.levels[-1].seen.own)
        return tuple(f"was{m}" if m in copies else f"own{m}" for m in range(count))

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the arrays from which state variables of neighbours are read."""
        return self.read if self.shares else ()

    @property
    def limits(self) -> int:
        """Number of limits of bonds that vary in space."""
        return len(self.scene.constants.by_bond)

    @property
    def mixed(self) -> int:
        """Number of stiffnesses of cells that differ from the stiffness of the rule."""
        return len(self.scene.cells.mixed) if self.scene.cells else 0

    @property
    def tears(self) -> bool:
        """True if the rule computes the forces of torn cells."""
        return self.scene.tears

    @property
    def softens_cells(self) -> bool:
        """True if the fracture model softens bonds by the stress of the cells beside them."""
        return isinstance(self.model, SoftensCells)

    @property
    def bonds_first(self) -> bool:
        """True if bonds are updated in a separate pass. Otherwise the sweep over particles updates
        each bond at both of its ends."""
        if self.model is None:
            return False
        renews = isinstance(self.model, RenewsBonds)
        return self.apart or renews or self.long or (self.tears and self.model.can_break)

    @property
    def judged(self) -> bool:
        """True if the sweep updates the bonds."""
        return self.model is not None and not (self.bonds_first or self.tears)

    @property
    def real(self) -> str:
        """Type of the scene's numbers in kernels."""
        return "real" if self.scene.experiment.stepping.precision == "float32" else "double"

    def over(self, count: str) -> str:
        """Return an expression for the range up to a count or, on a GPU, for the part of this range
        that belongs to one thread."""
        return f"range(me, {count}, threads)" if self.gpu else f"range({count})"

    def renumbered(self, scene: Scene) -> Plan:
        """Return the plan of a scene that differs from the scene of this plan only in its
        parameters."""
        levels, below = list[Level](), scene
        for level in reversed(self.levels):
            levels.insert(0, replace(level, scene=below))
            below = below.inner or below
        return replace(self, scene=scene, levels=tuple(levels))

    def number(self, value: float) -> str:
        """Return a literal in the precision of the scene."""
        return f"real({float(value)!r})" if self.real == "real" else repr(float(value))

    def rounded(self, value: str) -> str:
        """Return an expression for a value in the precision of the scene."""
        return f"real({value})" if self.real == "real" else value

    def each(self, pattern: str, axes: str = "") -> list[str]:
        """Return the lines of a pattern for each of some axes, by default all. `@` is replaced by
        the name of the axis, and `#` by its number."""
        named = enumerate(axes or self.axes)
        return [pattern.replace("@", c).replace("#", str(a)) for a, c in named]

    def vector(self, pattern: str) -> str:
        """Return a vector expression. Its components are given by the pattern for each axis."""
        return f"Vector({', '.join(self.each(pattern))})"

    def literal(self, values: Iterable[float]) -> str:
        """Return an expression for a vector of the given numbers."""
        return f"Vector({', '.join(map(self.number, values))})"

    def row(self, array: str, first: object, step: Sequence[object] | None = None) -> str:
        """Return an expression for columns j0 to j1 of a row or, with `step`, for the cells at the
        offset `step` from them."""
        *lead, last = step or [0] * self.scene.axes
        at = [_sum(name, m) for name, m in zip(self.lead, lead, strict=True)]
        return f"{array}[{', '.join([str(first), *at])}, {_sum('j0', last)}:{_sum('j1', last)}]"

    def local_places(self, s: str) -> list[str]:
        """Return expressions for X relative to site (0, 0), in which the order of operations is the
        same as in rasters."""
        index = [f"{name} + first[{n}]" for n, name in enumerate((*self.lead, "j + j0"))]
        places = []
        for n, along in enumerate(zip(*self.scene.raster.cell.vectors, strict=True)):
            terms = [f"({at}) * {float(v)!r}" for at, v in zip(index, along, strict=True)]
            places.append(f"at[{s}, {n}] + ({' + '.join(terms)})")
        return places

    def flat(self, s: str) -> str:
        """Return an expression for the index at which a row begins in flat arrays of all
        sublattices."""
        index = s
        for axis, name in enumerate((*self.lead, "j0")):
            index = f"({index}) * kind.shape[{axis + 1}] + {name}"
        return index


def _sum(name: str, step: object) -> str:
    return name if step == 0 else f"{name} + {step}"


def listed(texts: Iterable[str]) -> str:
    """Return texts as the arguments of a named tuple."""
    return "".join(f"{text}, " for text in texts)


def values(numbers: Sequence[Number], where: dict[Owner, str]) -> str:
    """Return the arguments of a named tuple as text. `where` contains, for each kind of place in
    which numbers are stored, the pattern of the expression for the n-th number stored there."""
    counts = defaultdict[Owner, Iterator[int]](count)
    return listed(where[number.owner].format(n=next(counts[number.owner])) for number in numbers)


@dataclass(frozen=True)
class Passes:
    """Functions that a step of a kernel calls: the pass over bonds, if bonds are not updated by the
    sweep; the sweep of each level; and functions of operations, by name."""

    judge: Function | None
    sweeps: Sequence[Function]
    functions: dict[str, Function] = field(default_factory=dict)


class PlanWriter(KernelWriter):
    """Writer that adds the lines of a plan's kernel to a function."""

    def __init__(self, plan: Plan, out: Function, passes: Passes) -> None:
        self.plan, self.out, self.passes = plan, out, passes

    def rows(self, name: str, write: Callable[[Function], None]) -> Function:
        """Return the function of an operation that processes a range of rows. If it does not exist,
        it is written."""
        if name not in self.passes.functions:
            function = Function(self.plan.shared, name, "first_row", "last_row", "moment")
            write(function)
            self.passes.functions[name] = function
        return self.passes.functions[name]

    def each(self, pattern: str, axes: str = "") -> Lines:
        """Return the lines of a pattern for each of some axes, by default all."""
        return self.plan.each(pattern, axes)

    def vector(self, pattern: str) -> str:
        """Return a vector expression. Its components are given by the pattern for each axis."""
        return self.plan.vector(pattern)

    def number(self, value: float) -> str:
        """Return a literal in the precision of the scene."""
        return self.plan.number(value)

    def row(self, array: str, first: str) -> str:
        """Return an expression for columns j0 to j1 of a row."""
        return self.plan.row(array, first)

    def places(self, sublattice: str) -> Lines:
        """Return the reference position of particle j of a row."""
        return self.plan.local_places(sublattice)

    def is_given(self, array: str) -> bool:
        """Return whether the name is an argument that functions share."""
        return array in self.plan.shared


DEEP = 16
"""Number of steps of a pass: the measured optimum."""
BAND = 8
"""Number of rows of a band: the measured optimum."""
ROW = 24 * 2**10
"""Number of bytes of a row of a tile: the measured optimum."""
SHORTEST = 256
"""Minimum number of columns of a tile."""


def goes_deep(plan: Plan) -> bool:
    """Return whether several steps of a scene are made in a pass."""
    return exceeds_cache(plan.scene) and not single_steps(plan.scene)


def pass_arrays(plan: Plan, pieces: int) -> dict[str, Any]:
    """Return the constant arrays of passes. `sizes` contains the sizes of a pass and the number of
    pieces. The other arrays describe the sorted frame points: the index at which each row begins,
    the columns of the points, and for each point the first row of the particles that it follows."""
    scene = plan.scene
    between = math.prod(scene.raster.shape[2:-1])
    tile = max(SHORTEST, ROW // (cell_bytes(scene) * between))
    sizes = DEEP, BAND, tile, CACHE // cell_bytes(scene), pieces
    arrays: dict[str, Any] = {"sizes": np.array(sizes)}
    for following in FollowFrame.of(scene):
        order = frame_order(following)
        arrays |= _listed(plan, "frame", *following.last_moved[:, order])
        arrays["frame_begun"] = following.first_moved[0, order]
        if scene.frame_delay:
            real = scene.experiment.stepping.precision
            arrays |= {name: np.zeros(len(order), real) for name in plan.each("delayed_@")}
    return arrays


def frame_order(following: FollowFrame) -> Indices:
    """Return the order of frame points by the row and column after which they can be computed."""
    return np.lexsort(following.last_moved[::-1])


def banded(plan: Plan, name: str, places: NDArray[np.intp]) -> tuple[Any, dict[str, Any]]:
    """Return the order of flat places by row and column. Also return, in this order, the index at
    which each row begins and the columns of the places."""
    index = np.unravel_index(places, plan.scene.raster.shape)
    order = np.lexsort((index[-1], index[1]))
    return order, _listed(plan, name, index[1][order], index[-1][order])


def _listed(
    plan: Plan, name: str, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> dict[str, Any]:
    first = np.searchsorted(rows, np.arange(plan.scene.raster.shape[1] + 1))
    return {f"{name}_rows": first, f"{name}_columns": columns}


FUNCTIONS: dict[type[Any], tuple[str, ...]] = {
    FollowerRule: ("gather", "apply"),
    RenewsParticles: ("remember",),
    FractureModel: ("breaks", "fictitious"),
    Softens: ("seen",),
    RenewsBonds: ("update",),
    TearsCells: ("torn",),
    UsesAngles: ("gather_pair",),
}
"""Elementwise functions of rules and fracture models, by capability."""


def levels_of(scene: Scene) -> tuple[Level, ...]:
    """Return the levels of a scene, the innermost rule first."""
    scenes = [scene]
    while inner := scenes[0].inner:
        scenes.insert(0, inner)
    return tuple(Level(n, of, *_parts(of)) for n, of in enumerate(scenes))


def functions_of(levels: Sequence[Level]) -> dict[str, Callable[..., Any]]:
    """Return the elementwise functions by their names in the kernel. The names of the functions of
    a rule end with the number of its level."""
    parts: dict[str, Any] = {str(level.number): level.scene.experiment.rule for level in levels}
    if levels[-1].scene.has_fracture:
        parts[""] = levels[-1].scene.experiment.fracture
    functions: dict[str, Callable[..., Any]] = {}
    for number, part in parts.items():
        for kind, names in FUNCTIONS.items():
            if isinstance(part, kind):
                functions |= {f"{name}{number}": getattr(part, name) for name in names}
        if isinstance(part, Loadable) and levels[-1].scene.loads:
            functions[f"loaded{number}"] = part.loaded
    if isinstance(parts.get(""), SoftensCells):
        functions["stress"] = CellStresses(levels[-1].scene).stress
    for operation in program_of(levels[-1].scene):
        functions |= operation.functions()
    return functions


def load_plugin_kernel(
    levels: Sequence[Level],
    source: str,
    arguments: tuple[Any, ...],
    more: Mapping[str, Callable[..., Any]] | None = None,
) -> Any:
    """Return the kernel. `more` are further functions, which do not belong to components. The
    message of a compiler error contains the name of the component that causes it."""
    with attributing_errors(levels):
        return load_kernel(source, functions_of(levels) | dict(more or {}), arguments)


@contextmanager
def attributing_errors(levels: Sequence[Level]) -> Iterator[None]:
    """Add the name of the component to the messages of compiler errors that are raised in this
    context."""
    try:
        yield
    except Exception as error:
        with errors_attributed_to(_culprit(levels, error), "to compile"):
            raise


def _culprit(levels: Sequence[Level], error: BaseException) -> Component:
    """Return the component to which the function in the message of a compiler error belongs. Return
    the rule if there is none."""
    functions, text = functions_of(levels).items(), str(error)
    named = [name for name, of in functions if f"function {of.__qualname__} " in text]
    for operation in program_of(levels[-1].scene):
        component = operation.component()
        if component and operation.functions().keys() & set(named):
            return component
    if any(not name[-1].isdigit() for name in named):
        return levels[-1].scene.experiment.fracture
    culprit = next((level for level in levels if f"apply{level.number}" in named), levels[-1])
    return culprit.scene.experiment.rule


def _parts(scene: Scene) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the number of components of each contribution of a neighbour, and of each of a pair.
    Raises an error for results that numpy rejects, since a kernel would accept some of them as
    numbers."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    ones = np.ones(1, experiment.stepping.precision)
    ones_vector: Vector = vector([ones] * scene.axes)
    numbers = started(scene, particle_numbers(experiment), (1,))
    slot = scene.neighbourhood.slots[0][0]
    with np.errstate(all="ignore"):
        if scene.has_fracture:
            with errors_attributed_to(experiment.fracture, "to compile"):
                limits = scene.constants.limits[slot]
                bond = started(scene, bond_numbers(experiment), (1,))
                cells = tried(experiment.fracture, ones)
                evaluator.renew_bonds(ones_vector, slot.rest, limits, bond, np.ones(1, bool), cells)
                evaluator.breaks(ones_vector, slot.rest, limits, bond)
        with errors_attributed_to(experiment.rule, "to compile"):
            slots = scene.neighbourhood.slots[0]
            d, neighbours = [ones_vector] * len(slots), evaluator.everywhere(slots)
            part = evaluator.contribution(ones_vector, ones_vector, neighbours[0])
            total = evaluator.total(d, ones_vector, neighbours)
            values = Here(
                ones_vector, ones_vector, ones_vector, scene.constants.of_particle(*numbers)
            )
            for component in evaluator.move(total, values, ones_vector if scene.loads else None):
                target(ones, component, ones, experiment.stepping)
            evaluator.renew_particles(total, values, numbers, None)
    sizes = tuple(len(value) if isinstance(value, Vector) else 1 for value in total)
    return sizes[: len(part)], sizes[len(part) :]
