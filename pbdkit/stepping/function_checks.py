"""Checks of the functions of a rule and of a fracture model at the beginning of a run.

The functions of a plugin may write into their arguments, keep values from call to call, or depend
on other particles or bonds. A run would then give wrong results without an error. They may also
return values of the wrong shape or type, which fail far from their cause. At the beginning of a run
they are called a few times: those of a rule for a sample of particles with small displacements,
those of a fracture model for a sample of bonds with different strains. This takes a few
milliseconds (measured for a rule: 3 ms for 100 particles, 6 ms for 160 000; for a fracture model:
6 and 7 ms). The conformance suite is more thorough.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import PureWindowsPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.errors import PluginError
from pbdkit.lattice.raster import FOLLOWER, Places
from pbdkit.plugin import (
    BreaksAtStrain,
    Calibrated,
    Component,
    FollowerRule,
    FractureModel,
    RenewsBonds,
    RenewsParticles,
    Slot,
    Softens,
    Vector,
)
from pbdkit.plugin.component import as_vector
from pbdkit.plugin.discovery import errors_attributed_to, full_description
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.vector import length
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import tried
from pbdkit.stepping.rule_evaluation import Evaluator, Surroundings, summed
from pbdkit.stepping.state import State, shown

SAMPLE = 64
"""Maximum number of particles for which functions are called."""
SHARE = 1e-3
"""Largest displacement of a particle, in bond lengths."""
PERIOD = 1009
"""Number of different displacements; it is prime, so that neighbours have different ones."""
ROUNDING = 5000.0
"""Relative tolerance in units of the last digit, because the last digit of a numpy function may
depend on the position in an array."""
EPS = float(np.finfo(float).eps)
START = "at the beginning of the run"
"""Place of errors in messages."""
NUMBERS = "fiub"
"""Kinds of numpy data types for real numbers."""
STRAINS = 1e-4, 10.0
"""Smallest and largest strain of a bond in the sample, besides 0."""
REFINEMENTS = 4
"""Number of times that the strains are concentrated around the first one at which a bond breaks."""
FINITE_STRAIN = 0.1
"""Strain up to which the values of a fracture model must be numbers."""
BUILTIN = "pbdkit.components."
"""Module of the built-in components, which the tests of pbdkit check."""
MAKE_NEW = "make new arrays, `x = x + 1` instead of `x += 1`"
"""Remedy for a function that writes into its arguments."""


KEEPS = (
    "in the second of two equal calls: it keeps values from call to call, or draws random numbers; "
    "store values as state variables (`{renews}`), and draw numbers in `draw` (`Draws`)"
)
NOT_ELEMENTWISE = (
    "if it is called for this {owner} alone: it is not elementwise; compute each value from those "
    "of one {owner}{neighbour}"
)


class Answer(NamedTuple):
    """Results of a function, component by component."""

    function: str
    values: list[NDArray[Any]]


def check_functions(scene: Scene, state: State) -> None:
    """Check the functions of the rule, of its inner rules, and of the fracture model, unless they
    are built in.

    Raises
    ------
    PluginError
        If a function raises an error, returns values that are not one number for each particle or
        bond, writes into its arguments, returns another value in a second call, or depends on other
        particles or bonds; if the constants of a bond differ at its ends.
    """
    level: Scene | None = scene
    while level is not None:
        if not type(level.experiment.rule).__module__.startswith(BUILTIN):
            _check_rule(level, state)
        level = level.inner
    fracture = scene.experiment.fracture
    if fracture.can_break and not type(fracture).__module__.startswith(BUILTIN):
        _check_fracture(fracture, scene, state)


def _check_rule(scene: Scene, state: State) -> None:
    place, sublattice = _sample(scene)
    if not len(place):
        return
    size = SHARE * length(scene.neighbourhood.slots[sublattice][0].rest)
    numbers = np.random.default_rng(0).uniform(-size, size, PERIOD).astype(state.u.dtype)
    noise = np.resize(numbers, state.u.shape)
    u = state.u + noise
    middle = len(place) // 2
    sample, one = (
        Surroundings(scene, Places(scene.raster.shape, places), sublattice)
        for places in (place, place[middle : middle + 1])
    )
    first, _, second, alone = (
        list(_answers(around, scene, where, state))
        for around, where in ((sample, u), (sample, u + noise), (sample, u), (one, u))
    )
    for answer, other in zip(first, second, strict=True):
        _refuse_difference(
            scene.experiment.rule, answer, other, place.shape,
            KEEPS.format(renews="RenewsParticles"),
            lambda n: f"particle {_number(scene, int(place[n]))}",
        )  # fmt: skip
    for answer, other in zip(first, alone, strict=True):
        values = [np.broadcast_to(v, place.shape)[middle : middle + 1] for v in answer.values]
        _refuse_difference(
            scene.experiment.rule, Answer(answer.function, values), other, (1,),
            NOT_ELEMENTWISE.format(owner="particle", neighbour=" and its neighbour"),
            lambda _: f"particle {_number(scene, int(place[middle]))}",
        )  # fmt: skip


def _check_fracture(model: FractureModel, scene: Scene, state: State) -> None:
    """Check the functions of a fracture model for bonds along each pair of opposite slots."""
    for n, plane in enumerate(scene.neighbourhood.planes):
        _refuse_unequal_ends(model, plane.slot, plane.opposite)
        bonds = _sample_of_bonds(scene, plane.slot)
        if not len(bonds):
            continue
        bonds = np.resize(bonds, SAMPLE)
        strains = np.concatenate([[0.0], np.geomspace(*STRAINS, SAMPLE - 1)])
        for _ in range(REFINEMENTS):
            first = _bond_answers(scene, n, plane.slot, bonds, strains, state)
            second = _bond_answers(scene, n, plane.slot, bonds, strains, state)
            for answer, other in zip(first, second, strict=True):
                _refuse_difference(
                    model, answer, other, strains.shape, KEEPS.format(renews="RenewsBonds"),
                    partial(_bond_with, strains),
                )  # fmt: skip
            for k in (0, SAMPLE - 1):
                one = slice(k, k + 1)
                alone = _bond_answers(scene, n, plane.slot, bonds[one], strains[one], state)
                for answer, other in zip(first, alone, strict=True):
                    values = [np.broadcast_to(v, strains.shape)[one] for v in answer.values]
                    _refuse_difference(
                        model, Answer(answer.function, values), other, (1,),
                        NOT_ELEMENTWISE.format(owner="bond", neighbour=""),
                        partial(_bond_with, strains[one]),
                    )  # fmt: skip
            broken = np.broadcast_to(first[-1].values[0], strains.shape)
            changes = np.flatnonzero(broken[1:] != broken[:-1])
            if not len(changes):
                break
            low, high = strains[changes[0] : changes[0] + 2]
            strains = np.linspace(low, high, SAMPLE)


def _bond_with(strains: Floats, n: int) -> str:
    return f"a bond with the strain {strains[n]:.3g}"


def _sample_of_bonds(scene: Scene, slot: Slot) -> Indices:
    """Return the flat places at which some bonds along a slot start. Both ends are in the body."""
    raster, rows = scene.raster, scene.raster.body_rows
    size = math.prod(raster.shape[1:])
    place = raster.place_of(rows[:: max(1, len(rows) // (SAMPLE * raster.shape[0]))])
    place = place[place // size == slot.source]
    ends = Places(raster.shape, place).seen_through(slot)
    bonds: Indices = place[ends.of(raster.kind) == FOLLOWER]
    return bonds


def _refuse_unequal_ends(model: FractureModel, slot: Slot, opposite: Slot) -> None:
    """Raise PluginError if the constants of a bond differ at its two ends."""
    here, there = model.constants(slot), model.constants(opposite)
    for name, value in here.items():
        if not math.isclose(value, there[name], rel_tol=ROUNDING * EPS):
            raise _fault(
                model,
                f"`constants` returned {value:g} as '{name}' for the rest offset "
                f"{_offset(slot.rest)}, and {there[name]:g} for the opposite one, but "
                "both belong to one bond; use quantities that do not depend on its direction, as "
                f"`length(slot.rest)`{_place_of(model, 'constants')}",
            )


def _bond_answers(
    scene: Scene, plane: int, slot: Slot, bonds: Indices, strains: Floats, state: State
) -> list[Answer]:
    """Return the results of the functions of a fracture model for bonds with given strains; the
    last one is that of `breaks`."""
    model: Any = scene.experiment.fracture
    evaluator, owner = Evaluator(scene), Places(scene.raster.shape, bonds)
    numbers = [owner.within(value[plane]) for value in state.bond_values]
    limits, r = scene.constants.limits_at(slot, plane, owner), slot.rest
    d = Vector(*(strains * component for component in r))
    u = Vector(*(0.1 * strains + component for component in r))
    cells = tuple(c._replace(share=np.ones_like(strains)) for c in tried(model, strains))
    lost = Vector(*(np.zeros_like(strains) for _ in r))
    _frozen((d, u, lost, tuple(limits), *map(tuple, cells)))
    everywhere, p = np.ones(strains.shape, bool), scene.constants.fracture
    answers = []

    def call(function: str, work: Callable[[], Any]) -> None:
        name = f"`{function}` for bonds along the rest offset {_offset(r)}"
        answer = _called(model, name, work)
        values = answer if isinstance(answer, tuple) else (answer,)
        _refuse_other_values(model, function, name, values, len(strains))
        small = strains < FINITE_STRAIN
        for value in _flat(values):
            if np.isnan(np.broadcast_to(value, strains.shape)[small]).any():
                raise _fault(
                    model,
                    f"{name} returned NaN; guard divisions and roots with `pbdkit.plugin.where`"
                    f"{_place_of(model, function)}",
                )
        answers.append(Answer(f"`{function}`", _flat(values)))

    if isinstance(model, RenewsBonds):
        call("update", lambda: evaluator.update(d, r, limits, numbers, cells))
        name, renewing = "`update`", (d, r, limits, numbers, everywhere, cells)
        _called(scene.experiment.fracture, name, partial(evaluator.renew_bonds, *renewing))
    call("fictitious", lambda: as_vector(model.fictitious(u, r, p), "fictitious", u))
    c = scene.constants.of_bond(*limits, *shown(numbers))
    if isinstance(model, Softens):
        call("seen", lambda: as_vector(model.seen(d, lost, r, c, p), "seen", u))
    if isinstance(model, BreaksAtStrain):
        call("breaking_strain", lambda: model.breaking_strain(r, c, p))
    call("breaks", lambda: evaluator.breaks(d, r, limits, numbers))
    return answers


def _sample(scene: Scene) -> tuple[Indices, int]:
    """Return flat places of some particles of a sublattice that have neighbours."""
    raster, rows = scene.raster, scene.raster.body_rows
    place = raster.place_of(rows[:: max(1, len(rows) // SAMPLE)])
    if not len(place):
        return place, 0
    sublattice = place // math.prod(raster.shape[1:])
    return place[sublattice == sublattice[0]], int(sublattice[0])


def _answers(around: Surroundings, scene: Scene, u: Floats, state: State) -> Iterator[Answer]:
    """Call the functions of the rule and generate their results."""
    evaluator = Evaluator(scene).given(around.parameters)
    rule = evaluator.rule
    particle, neighbours = around.here(u, state), around.neighbours(state)
    differences, count = around.differences(u), int(np.size(particle.u.x))
    parts: list[tuple[Any, Any]] = []
    for slot, d, to in zip(around.slots, differences, neighbours, strict=True):
        name = f"`gather` at the neighbour with the site offset {slot.site}"
        before = _copied(d)
        _frozen((to.w, to.more, to.shared, particle.u))
        part = _called(rule, name, partial(evaluator.contribution, d, particle.u, to))
        gathers = "gather" if to.torn is None else "torn"
        _refuse_other_values(rule, gathers, name, part, count)
        _refuse_writing(rule, name, "d", before, d)
        parts.append((part, to.present))
        yield Answer(name, _flat(part))
    _frozen(differences)
    evaluate = partial(evaluator.pair_contributions, differences, particle.u, neighbours)
    pairs = _called(rule, "`gather_pair`", lambda: list(evaluate()))
    for part, _ in pairs:
        _refuse_other_values(rule, "gather_pair", "`gather_pair`", part, count)
        yield Answer("`gather_pair`", _flat(part))
    total = _called(rule, "`gather`", lambda: summed(parts) + summed(pairs))
    functions: dict[str, Callable[..., Any]] = {"`apply`": evaluator.move}
    if isinstance(rule, RenewsParticles):
        functions["`remember`"] = evaluator.remember
    if isinstance(rule, Calibrated) and material_of(rule) is not None:
        functions["`force`"] = evaluator.force
    _frozen(particle)
    for name, function in functions.items():
        before = _copied(total)
        answer = _called(rule, name, partial(function, total, particle))
        values = (answer,) if isinstance(answer, Vector) else answer
        _refuse_other_values(rule, name.strip("`"), name, values, count)
        _refuse_writing(rule, name, "total", before, total)
        yield Answer(name, _flat(answer))


def _offset(rest: Vector) -> str:
    """Return a rest offset as text, without negative zeros."""
    return f"({', '.join(f'{float(component) + 0.0:g}' for component in rest)})"


def _called(component: Component, name: str, call: Callable[[], Any]) -> Any:
    """Return the result of a call. Errors of the function become PluginErrors."""
    with errors_attributed_to(component, f"{START} in {name}"), np.errstate(all="ignore"):
        try:
            return call()
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise _fault(component, f"{name} writes into its arguments; {MAKE_NEW}") from None


def _refuse_other_values(
    component: Component, function: str, name: str, values: tuple[Any, ...], count: int
) -> None:
    """Raise PluginError unless each value is a vector or a number, with one number for each
    particle or bond, or one number for all."""
    kinds = NUMBERS + "c" * isinstance(component, FollowerRule)
    if function in ("apply", "remember", "force"):
        kinds = NUMBERS
    owners = "particles" if isinstance(component, FollowerRule) else "bonds"
    for n, value in enumerate(values):
        for part in value if isinstance(value, Vector) else (value,):
            where = f"value {n + 1} of {len(values)}" if len(values) > 1 else "its value"
            if isinstance(part, (list, tuple)):
                fault = f"returned {type(part).__name__} as {where}"
            elif np.shape(part) not in ((), (count,)):
                fault = f"returned the shape {np.shape(part)} for {count} {owners}, in {where}"
            elif (dtype := np.asarray(part).dtype).kind not in kinds:
                kind = "None" if part is None else f"values of {dtype}"
                fault = f"returned {kind} as {where}"
            else:
                continue
            remedy = "return numbers and vectors, computed element by element from the arguments"
            raise _fault(component, f"{name} {fault}; {remedy}{_place_of(component, function)}")


def _place_of(component: Component, function: str) -> str:
    """Return the file of a function and the line at which it begins, in parentheses."""
    code = getattr(inspect.unwrap(getattr(component, function)), "__code__", None)
    if code is None:  # a function that is not written in Python
        return ""
    return f" ({PureWindowsPath(code.co_filename).name}, line {code.co_firstlineno})"


def _refuse_writing(
    rule: FollowerRule, function: str, name: str, before: list[NDArray[Any]], now: Any
) -> None:
    for n, (old, new) in enumerate(zip(before, _flat(now), strict=True)):
        if not np.array_equal(old, new, equal_nan=True):
            component = f"`d.{'xyz'[n]}`" if name == "d" else f"`{name}`"
            raise _fault(rule, f"{function} writes into {component}; {MAKE_NEW}")


def _refuse_difference(
    component: Component,
    first: Answer,
    second: Answer,
    shape: tuple[int, ...],
    text: str,
    owner: Callable[[int], str],
) -> None:
    """Raise PluginError if two results for the same particles or bonds differ."""
    for one, other in zip(first.values, second.values, strict=True):
        a, b = (np.broadcast_to(v, shape).astype(np.result_type(v, 1.0)) for v in (one, other))
        with np.errstate(invalid="ignore"):
            differs = np.abs(a - b) > ROUNDING * np.finfo(a.dtype).eps * np.maximum(abs(a), abs(b))
        if differs.any():
            n = int(np.argmax(differs))
            values = f"returned {_shown(one, a[n])} for {owner(n)}, and {_shown(other, b[n])}"
            raise _fault(component, f"{first.function} {values} {text}")


def _shown(result: Any, value: Any) -> str:
    """Return a number as text, and a truth value as `True` or `False`."""
    return str(bool(value)) if np.asarray(result).dtype == bool else f"{value:g}"


def _number(scene: Scene, place: int) -> int:
    raster = scene.raster
    rows = np.asarray(raster.body_rows)
    row = rows[np.flatnonzero(raster.place_of(rows) == place)[0]]
    return int(raster.particle_offset + row + 1)


def _fault(component: Component, text: str) -> PluginError:
    return PluginError(f"{full_description(type(component))} failed {START}: {text}")


def _flat(tree: Any) -> list[Any]:
    """Return the arrays and numbers of a tree of vectors and tuples."""
    if isinstance(tree, (Vector, tuple, list)):
        return [value for part in tree for value in _flat(part)]
    return [tree]


def _copied(tree: Any) -> list[NDArray[Any]]:
    return [np.array(value) for value in _flat(tree)]


def _frozen(tree: Any) -> None:
    """Forbid writing into the arrays of a tree."""
    for value in _flat(tree):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
