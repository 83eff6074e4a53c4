"""Checks of the functions of a rule at the beginning of a run.

The functions of a plugin may write into their arguments, keep values from call to call, or depend
on other particles. A run would then give wrong results without an error. They may also return
values of the wrong shape or type, which fail far from their cause. At the beginning of a run they
are called a few times for a sample of particles, with small displacements, which takes a few
milliseconds (measured: 3 ms for 100 particles, 6 ms for 160 000). The conformance suite is more
thorough.
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
from pbdkit.lattice.raster import Places
from pbdkit.plugin import Calibrated, FollowerRule, RenewsParticles, Vector
from pbdkit.plugin.discovery import errors_attributed_to, full_description
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.vector import length
from pbdkit.scene.scene import Scene
from pbdkit.stepping.rule_evaluation import Evaluator, Surroundings, summed
from pbdkit.stepping.state import State

SAMPLE = 64
"""Maximum number of particles for which functions are called."""
SHARE = 1e-3
"""Largest displacement of a particle, in bond lengths."""
PERIOD = 1009
"""Number of different displacements; it is prime, so that neighbours have different ones."""
ROUNDING = 1e-12
"""Relative tolerance, because the last digit of a numpy function may depend on the position in an
array."""
START = "at the beginning of the run"
"""Place of errors in messages."""
NUMBERS = "fiub"
"""Kinds of numpy data types for real numbers."""
MAKE_NEW = "make new arrays, `x = x + 1` instead of `x += 1`"
"""Remedy for a function that writes into its arguments."""


class Answer(NamedTuple):
    """Results of a function, component by component."""

    function: str
    values: list[NDArray[Any]]


def check_functions(scene: Scene, state: State) -> None:
    """Check the functions of the rule, and of its inner rules, unless the rule is built in.

    Raises
    ------
    PluginError
        If a function raises an error, returns values that are not one number for each particle,
        writes into its arguments, returns another value in a second call, or depends on other
        particles.
    """
    level: Scene | None = scene
    while level is not None:
        if not type(level.experiment.rule).__module__.startswith("pbdkit.components."):
            _check(level, state)
        level = level.inner


def _check(scene: Scene, state: State) -> None:
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
            scene, place, answer, other,
            "in the second of two equal calls: it keeps values from call to call, or draws random "
            "numbers; store values as state variables (`RenewsParticles`), and draw numbers in "
            "`draw` (`Draws`)",
        )  # fmt: skip
    for answer, other in zip(first, alone, strict=True):
        values = [np.broadcast_to(v, place.shape)[middle : middle + 1] for v in answer.values]
        _refuse_difference(
            scene, place[middle : middle + 1], Answer(answer.function, values), other,
            "if it is called for this particle alone: it is not elementwise; compute each value "
            "from those of one particle and its neighbour",
        )  # fmt: skip


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


def _called(rule: FollowerRule, name: str, call: Callable[[], Any]) -> Any:
    """Return the result of a call. Errors of the function become PluginErrors."""
    with errors_attributed_to(rule, f"{START} in {name}"), np.errstate(all="ignore"):
        try:
            return call()
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise _fault(rule, f"{name} writes into its arguments; {MAKE_NEW}") from None


def _refuse_other_values(
    rule: FollowerRule, function: str, name: str, values: tuple[Any, ...], count: int
) -> None:
    """Raise PluginError unless each value is a vector or a number, with one number for each
    particle or one number for all."""
    kinds = NUMBERS if function in ("apply", "remember", "force") else NUMBERS + "c"
    for n, value in enumerate(values):
        for component in value if isinstance(value, Vector) else (value,):
            where = f"value {n + 1} of {len(values)}" if len(values) > 1 else "its value"
            if isinstance(component, (list, tuple)):
                fault = f"returned {type(component).__name__} as {where}"
            elif np.shape(component) not in ((), (count,)):
                shape = np.shape(component)
                fault = f"returned the shape {shape} for {count} particles, in {where}"
            elif (dtype := np.asarray(component).dtype).kind not in kinds:
                kind = "None" if component is None else f"values of {dtype}"
                fault = f"returned {kind} as {where}"
            else:
                continue
            remedy = "return numbers and vectors, computed element by element from the arguments"
            raise _fault(rule, f"{name} {fault}; {remedy}{_place_of(rule, function)}")


def _place_of(rule: FollowerRule, function: str) -> str:
    """Return the file of a function and the line at which it begins, in parentheses."""
    code = getattr(inspect.unwrap(getattr(rule, function)), "__code__", None)
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
    scene: Scene, place: Indices, first: Answer, second: Answer, text: str
) -> None:
    for a, b in zip(first.values, second.values, strict=True):
        a, b = np.broadcast_to(a, place.shape), np.broadcast_to(b, place.shape)
        with np.errstate(invalid="ignore"):
            differs = np.abs(a - b) > ROUNDING * np.maximum(np.abs(a), np.abs(b))
        if differs.any():
            n = int(np.argmax(differs))
            number = _number(scene, int(place[n]))
            values = f"returned {a[n]:g} for particle {number}, and {b[n]:g}"
            raise _fault(scene.experiment.rule, f"{first.function} {values} {text}")


def _number(scene: Scene, place: int) -> int:
    raster = scene.raster
    rows = np.asarray(raster.body_rows)
    row = rows[np.flatnonzero(raster.place_of(rows) == place)[0]]
    return int(raster.particle_offset + row + 1)


def _fault(rule: FollowerRule, text: str) -> PluginError:
    return PluginError(f"{full_description(type(rule))} failed {START}: {text}")


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
