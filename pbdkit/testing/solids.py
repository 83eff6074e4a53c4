"""The small solids on which laws of mechanics are asked of a component."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Component, FollowerRule, FramePolicy
from pbdkit.interfaces.component import as_vector
from pbdkit.interfaces.rule import material_of
from pbdkit.interfaces.vector import vector
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import State
from pbdkit.testing.laws import (
    Floats,
    pulls_at_rest,
    softened_state,
    stiffness,
    torn_state,
    whole_state,
)

BODY = {"type": "grid", "columns": 4, "rows": 4}
TEARS = {"type": "strain", "failure": 0.1}
SPRINGS = {"type": "springs"}
MOST = 2
"""So many lattices are tried."""


class NoSolidError(Exception):
    """A component takes part in no scene of known forces and free edges; the text is the reason."""


@dataclass(frozen=True)
class Solid:
    """A scene whose rule knows forces and whose edges are free, and its stiffness: with all bonds,
    softened by displacements at random with some broken besides, and with more of them broken."""

    scene: Scene

    @cached_property
    def whole(self) -> Floats:
        """With all bonds."""
        return stiffness(self.scene, whole_state(self.scene))

    @cached_property
    def softened(self) -> Floats:
        """With some softened, some broken."""
        return stiffness(self.scene, self._softened)

    @cached_property
    def torn(self) -> Floats:
        """With more broken."""
        return stiffness(self.scene, torn_state(self.scene, 4, self._softened))

    @property
    def stages(self) -> list[tuple[str, Floats]]:
        """Each stiffness by what the body is then; one after the other bonds are lost."""
        if not self.scene.has_fracture:
            return [("whole", self.whole)]
        return [("whole", self.whole), ("softened", self.softened), ("torn", self.torn)]

    @cached_property
    def _softened(self) -> State:
        return softened_state(self.scene, 3)


def solids_of(component: Component, around: Mapping[str, Any]) -> list[Solid]:
    """Those that a component takes part in, one a lattice, with the `lattice` and `neighbours` that
    are tried. Raises NoSolidError without any."""
    found: dict[str, Solid] = {}
    for experiment in _experiments(component, around):
        name = experiment.lattice.type
        if name not in found and len(found) < MOST:
            with suppress(ExperimentError):
                solid = Solid(build_scene(experiment))
                if not (_is_tied(solid.scene) or pulls_at_rest(solid.scene, solid._softened)):
                    found[name] = solid
    if not found:
        raise NoSolidError("no scene has known forces, free edges, and no forces at rest")
    return list(found.values())


def _experiments(component: Component, around: Mapping[str, Any]) -> Iterator[Experiment]:
    given: dict[str, Any] = {"name": "conformance", "body": BODY, "steps": 4}
    lattices, neighbours = (
        list(part) if isinstance(part := around[name], (list, tuple)) else [part]
        for name in ("lattice", "neighbours")
    )
    for parts, lattice, near in product(_parts(component), lattices, neighbours):
        with suppress(ExperimentError):
            yield Experiment(**given, **parts, lattice=lattice, neighbours=near)


def _parts(component: Component) -> list[dict[str, Any]]:
    """Rule, frame and fracture with which it is tried, those first in which bonds break."""
    if isinstance(component, FollowerRule):
        if material_of(component) is None:
            raise NoSolidError("it knows no forces")
        frame = {"type": "natural" if component.uses_cells else "none"}
        plain = {"rule": component, "frame": frame}
        return [plain | {"fracture": TEARS}, plain]
    if isinstance(component, FramePolicy):
        if not component.edges_are_free:
            raise NoSolidError("its points pull at the edges, which are not free")
        return [{"rule": SPRINGS, "frame": component, "fracture": TEARS}]
    return [{"rule": SPRINGS, "frame": {"type": "natural"}, "fracture": component}]


def _is_tied(scene: Scene) -> bool:
    """Whether what takes the place of a lost neighbour stands somewhere in space, which a body that
    moves as a whole feels."""
    model, slot = scene.experiment.fracture, scene.neighbourhood.slots[0][0]
    u, p = vector([0.1] * scene.axes), scene.constants.fracture
    there = (model.fictitious(u * share, slot.rest, p) for share in (0.0, 1.0))
    one, other = (as_vector(each, "fictitious", u) for each in there)
    return any(float(a) != float(b) for a, b in zip(one, other, strict=True))
