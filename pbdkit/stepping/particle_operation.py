"""Operations of components on selected particles in a step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.plugin import Component
from pbdkit.plugin.component import as_vector
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.state import shown
from pbdkit.stepping.step import Call, Cells, Operation, Step


class OperateOnParticles(Operation):
    """Apply the operation of a component to selected particles after their rule has moved them."""

    def __init__(self, scene: Scene, number: int) -> None:
        super().__init__(scene)
        self._number = number
        self._operated = scene.operations[number]

    @classmethod
    def of(cls, scene: Scene) -> Sequence[Self]:
        """Return an operation of a step for each particle operation of the scene, in the order of
        the experiment."""
        return [cls(scene, number) for number in range(len(scene.operations))]

    def apply(self, step: Step) -> None:
        """Displace the particles after the rule has moved them."""
        place = self._operated.place
        u, new = (planes.reshape(len(planes), -1) for planes in (step.u, step.new))
        with np.errstate(all="ignore", invalid=step.invalid):
            displacements = self._displaced(u[:, place], new[:, place], f"at step {step.number}")
        for plane, values in zip(new, displacements, strict=True):
            plane[place] = values

    def emit(self, kernel: KernelWriter) -> None:
        """Write a loop over the selected particles."""
        n = self._number
        parameters = "".join(f"operation{n}[{m}], " for m in range(len(self._operated.parameters)))
        kernel.listed(
            f"operands{n}",
            f"p = operands{n}[e]",
            f"u, new = {kernel.vector('flat_u_@[p]')}, {kernel.vector('flat_v_@[p]')}",
            f"new = displacement{n}(u, new, Operation{n}({parameters}))",
            *kernel.each("flat_v_@[p] = new.@"),
        )

    def functions(self) -> dict[str, Callable[..., Any]]:
        """Return the `displacement` of the component."""
        return {f"displacement{self._number}": self._operated.operation.displacement}

    def component(self) -> Component:
        """Return the particle operation of the plugin."""
        return self._operated.operation

    def numbers(self) -> dict[str, tuple[str, ...]]:
        """Return the names of its parameters."""
        return {f"Operation{self._number}": self._operated.parameters._fields}

    def constants(self) -> dict[str, Sequence[float]]:
        """Return the values of its parameters."""
        return {f"operation{self._number}": tuple(self._operated.parameters)}

    def lists(self) -> dict[str, Indices]:
        """Return the flat places of its particles."""
        return {f"operands{self._number}": self._operated.place}

    def disturbances(self, call: Call) -> Iterator[Cells]:
        """Generate the cells of particles that the operation moves out of the reference
        configuration."""
        yield self._moved_at_rest

    @cached_property
    def _moved_at_rest(self) -> Cells:
        zero: Floats = np.zeros((self.scene.axes, len(self._operated.place)))
        moved = np.any(self._displaced(zero, zero, "at rest") != 0.0, axis=0)
        return np.unravel_index(self._operated.place[moved], self.scene.raster.shape)[1:]

    def _displaced(self, u: Floats, new: Floats, when: str) -> Floats:
        """Return the displacements after the operation, (axis, particle)."""
        operation, current = self._operated.operation, vector(shown(new))
        with errors_attributed_to(operation, when):
            displacement = operation.displacement(
                vector(shown(u)), current, self._operated.parameters
            )
            components = as_vector(displacement, "displacement", current)
            return np.array([np.broadcast_to(c, new.shape[1:]) for c in components])
