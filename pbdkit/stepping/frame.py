"""The frame in a step: its points follow the body."""

from __future__ import annotations

from pbdkit.scene.scene import Scene
from pbdkit.stepping.operation import Operation, Step


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
