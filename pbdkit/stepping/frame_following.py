"""The frame in a step: its points follow the body."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import KernelWriter, Lines
from pbdkit.stepping.step import Hindrance, Mode, Operation, Step


class FollowFrame(Operation):
    """Let the points of the frame follow the body: as it is after the step, or lagging, as it was
    before."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where the body has a frame."""
        return scene.frame is not None

    def apply(self, step: Step) -> None:
        """After all particles stand where they go."""
        frame = self.scene.frame
        assert frame
        body, axes = step.u if frame.map.lag else step.new, len(step.u)
        frame.follow(body.reshape(axes, -1), step.new.reshape(axes, -1))

    def emit(self, kernel: KernelWriter) -> None:
        """After all particles stand where they go."""
        kernel.follow(self.mapped(kernel), "flat_v", self.scene.lag)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """A map that is made anew is an array of the host, and of a whole lattice."""
        reasons = {
            Mode.COURSES: "numbers change in time by which the frame follows",
            Mode.RANKS: "a frame whose map follows numbers of the rule that change in time",
        }
        changes = mode in reasons and self.scene.frame_changes
        return Hindrance(reasons[mode], "frame") if changes else None

    def emit_for(self, kernel: KernelWriter, planes: str) -> None:
        """Write the same for planes that are no displacements: the moves of an inner rule."""
        kernel.follow(self.mapped(kernel), planes)

    def mapped(self, kernel: KernelWriter) -> Callable[[str], Lines]:
        """Return what gives the lines that compute t_@ of the frame point f from some planes."""

        def lines(planes: str) -> Lines:
            start = kernel.each(f"t_@ = {kernel.number(0.0)}")
            terms = (f"    t_{c} = t_{c} + {term}" for c, term in self._terms(kernel, planes))
            return [*start, "for e in range(entries[f], entries[f + 1]):", *terms]

        return lines

    def _terms(self, kernel: KernelWriter, planes: str) -> Iterator[tuple[str, str]]:
        """By axis what an entry of the map adds."""
        frame = self.scene.frame
        assert frame
        for a, c in enumerate(kernel.each("@")):
            term = f"mapped[e] * {planes}_{c}[bodies[e]]"
            if frame.map.weight.ndim == 3:
                terms = kernel.each(f"mapped[e, {a}, #] * {planes}_@[bodies[e]]")
                term = f"({' + '.join(terms)})"
            yield c, term
