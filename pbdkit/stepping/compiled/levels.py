"""The rules of a scene as the levels of its kernel, tried out on single numbers first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from pbdkit.interfaces import (
    Components,
    FollowerRule,
    FractureModel,
    Here,
    Loadable,
    RenewsBonds,
    RenewsParticles,
    Softens,
    SoftensCells,
    TearsCells,
)
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene import outlines
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses, tried
from pbdkit.stepping.compiled.kernel_cache import load_kernel
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.followers import target
from pbdkit.stepping.state import started

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
    if levels[-1].scene.barriers:
        found["leave"] = outlines.leave
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


def _culprit(levels: Sequence[Level], error: BaseException) -> FollowerRule | FractureModel:
    """The part whose function an error of the compiler names, else the rule."""
    functions, text = functions_of(levels).items(), str(error)
    named = [name for name, of in functions if f"function {of.__qualname__} " in text]
    if any(not name[-1].isdigit() for name in named):
        return levels[-1].scene.experiment.fracture
    culprit = next((level for level in levels if f"apply{level.number}" in named), levels[-1])
    return culprit.scene.experiment.rule


def _parts(scene: Scene) -> tuple[int, ...]:
    """The components of each contribution. What functions return by mistake is refused as numpy
    refuses it: a kernel would take some of it for numbers."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    ones = np.ones(1, experiment.stepping.precision)
    one: Components = vector([ones] * scene.axes)
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
    return tuple(len(part) if isinstance(part, Components) else 1 for part in total)
