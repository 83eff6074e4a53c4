"""Operations of particles that components bring along, in a step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.plugin.component import as_vector
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.state import shown
from pbdkit.stepping.step import Operation, Step


class OperateOnParticles(Operation):
    """What a component does with selected particles after their rule has moved them."""

    def __init__(self, scene: Scene, number: int) -> None:
        super().__init__(scene)
        self._number = number
        self._operated = scene.operations[number]

    @classmethod
    def of(cls, scene: Scene) -> Sequence[Self]:
        """One for each of them, in their order."""
        return [cls(scene, number) for number in range(len(scene.operations))]

    def apply(self, step: Step) -> None:
        """After particles have moved."""
        place = self._operated.place
        u, new = (planes.reshape(len(planes), -1) for planes in (step.u, step.new))
        with np.errstate(all="ignore", invalid=step.invalid):
            found = self._displaced(u[:, place], new[:, place], f"at step {step.number}")
        for plane, values in zip(new, found, strict=True):
            plane[place] = values

    def emit(self, kernel: KernelWriter) -> None:
        """The same function."""
        n = self._number
        numbers = "".join(f"operation{n}[{m}], " for m in range(len(self._operated.parameters)))
        kernel.listed(
            f"operated{n}",
            f"p = operated{n}[e]",
            f"u, new = {kernel.vector('flat_u_@[p]')}, {kernel.vector('flat_v_@[p]')}",
            f"new = displacement{n}(u, new, Operation{n}({numbers}))",
            *kernel.each("flat_v_@[p] = new.@"),
        )

    def functions(self) -> dict[str, Callable[..., Any]]:
        """Its `displacement`."""
        return {f"displacement{self._number}": self._operated.operation.displacement}

    def numbers(self) -> dict[str, tuple[str, ...]]:
        """Its parameters."""
        return {f"Operation{self._number}": self._operated.parameters._fields}

    def constants(self) -> dict[str, Sequence[float]]:
        """The values of its parameters."""
        return {f"operation{self._number}": tuple(self._operated.parameters)}

    def lists(self) -> dict[str, Indices]:
        """Its particles."""
        return {f"operated{self._number}": self._operated.place}

    @cached_property
    def moved_at_rest(self) -> Indices:
        """The flat places of particles that it moves where all are at rest."""
        still: Floats = np.zeros((self.scene.axes, len(self._operated.place)))
        moved = np.any(self._displaced(still, still, "at rest") != 0.0, axis=0)
        return self._operated.place[moved]

    def _displaced(self, u: Floats, new: Floats, when: str) -> Floats:
        """Displacements after the operation, (axis, particle)."""
        operation, here = self._operated.operation, vector(shown(new))
        with blaming(operation, when):
            found = operation.displacement(vector(shown(u)), here, self._operated.parameters)
            components = as_vector(found, "displacement", here)
            return np.array([np.broadcast_to(c, new.shape[1:]) for c in components])
