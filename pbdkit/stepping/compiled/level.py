"""A rule of a scene, as its kernel sees it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from pbdkit.scene.homes import Seen, numbers_of
from pbdkit.scene.scene import Scene


@dataclass(frozen=True)
class Level:
    """A rule whose moves one sweep makes; `scene` has it as its rule. The first works on
    displacements, each other on the moves of the one before."""

    number: int
    scene: Scene
    parts: tuple[int, ...]
    """Of each contribution, the number of its components."""

    @cached_property
    def seen(self) -> Seen:
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
