"""The operation of a step by which frame points follow the body."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import chain

import numpy as np

from pbdkit.array_types import Indices
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import KernelWriter, Lines
from pbdkit.stepping.step import Hindrance, Mode, Operation, Reach, Step


class FollowFrame(Operation):
    """Move frame points by the displacements of the body after the step or, if the frame has a
    delay, by those before the step."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether the body has a frame."""
        return scene.frame is not None

    def apply(self, step: Step) -> None:
        """Move the frame points after all particles have been placed."""
        frame = self.scene.frame
        assert frame
        body, axes = step.u if frame.map.delay else step.new, len(step.u)
        frame.follow(body.reshape(axes, -1), step.new.reshape(axes, -1))

    def emit(self, kernel: KernelWriter) -> None:
        """Write the lines that move the frame points."""
        kernel.follow(self.mapped(kernel), "flat_v", self.scene.frame_delay)

    def reach(self, axis: int) -> Reach:
        """Return the distance of the frame points from the particles that they follow."""
        axis = 0 if axis == 0 else 1
        return Reach(apart=int(self._spans[axis].max()))

    def carries(self) -> Indices:
        """Return the differences of repeat cells between a neighbour of a frame point and a
        particle that the point follows. A motion propagates by these differences."""
        frame, kinds = self.scene.frame, self.scene.raster.kind
        assert frame
        places = frame.place[frame.map.point], frame.body_place
        at, body = (np.stack(np.unravel_index(p, kinds.shape)[1:], axis=1) for p in places)
        steps = [np.zeros((0, self.scene.axes), np.intp)]
        for slot in chain(*self.scene.neighbourhood.slots):
            # These slots lead from the particle at `neighbour` to the frame point.
            neighbour = at - slot.cell
            inside = ((neighbour >= 0) & (neighbour < kinds.shape[1:])).all(axis=1)
            follows = kinds[(slot.source, *neighbour[inside].T)] == FOLLOWER
            steps.append((neighbour - body)[inside][follows])
        return np.concatenate(steps)

    @cached_property
    def last_moved(self) -> Indices:
        """Row and column of the last particle that each point follows, (2, point)."""
        return np.maximum.reduceat(self._body, self._first, axis=1)

    @cached_property
    def first_moved(self) -> Indices:
        """Row and column of the first particle that each point follows, (2, point)."""
        return np.minimum.reduceat(self._body, self._first, axis=1)

    @cached_property
    def _spans(self) -> Indices:
        """Rows and columns over which each point and its particles extend, (2, point)."""
        assert self.scene.frame
        point = self._cells(self.scene.frame.place)
        return np.maximum(self.last_moved, point) - np.minimum(self.first_moved, point)

    @cached_property
    def _body(self) -> Indices:
        assert self.scene.frame
        return self._cells(self.scene.frame.body_place)

    @property
    def _first(self) -> Indices:
        """Index in the map of the first entry of each point."""
        assert self.scene.frame
        return np.searchsorted(self.scene.frame.map.point, np.arange(len(self.scene.frame.place)))

    def _cells(self, place: Indices) -> Indices:
        """Rows and columns of flat places, (2, place)."""
        index = np.unravel_index(place, self.scene.raster.shape)
        return np.stack([index[1], index[-1]])

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return the reason why a frame with weights that change in time does not support a mode.
        The weights are then stored on the host and for the whole lattice."""
        reasons = {
            Mode.TIME_DEPENDENT: "the weights of the frame are time-dependent",
            Mode.RANKS: "a frame that depends on time-dependent parameters of the rule",
        }
        changes = mode in reasons and self.scene.frame_changes
        return Hindrance(reasons[mode], "frame") if changes else None

    def emit_for(self, kernel: KernelWriter, planes: str) -> None:
        """Write the lines that move frame points, for arrays that contain the moves of an inner
        rule instead of displacements."""
        kernel.follow(self.mapped(kernel), planes)

    def mapped(self, kernel: KernelWriter) -> Callable[[str], Lines]:
        """Return a function that maps the name of the arrays of displacements to the lines that
        compute t_@, the displacement of frame point f."""

        def lines(planes: str) -> Lines:
            start = kernel.each(f"t_@ = {kernel.number(0.0)}")
            terms = (f"    t_{c} = t_{c} + {term}" for c, term in self._terms(kernel, planes))
            return [*start, "for e in range(entries[f], entries[f + 1]):", *terms]

        return lines

    def _terms(self, kernel: KernelWriter, planes: str) -> Iterator[tuple[str, str]]:
        """Generate for each axis its name and the expression for the term that an entry of the map
        contributes."""
        frame = self.scene.frame
        assert frame
        for a, c in enumerate(kernel.each("@")):
            term = f"frame_weights[e] * {planes}_{c}[bodies[e]]"
            if frame.map.weight.ndim == 3:
                terms = kernel.each(f"frame_weights[e, {a}, #] * {planes}_@[bodies[e]]")
                term = f"({' + '.join(terms)})"
            yield c, term
