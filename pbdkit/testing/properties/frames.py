"""What is asked of frame policies, besides what building a scene with them asks."""

from __future__ import annotations

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import FrameMap, FramePolicy
from pbdkit.scene.framing import sites_of_frame
from pbdkit.testing.properties.answers import REPEATABLE
from pbdkit.testing.property import NotAskedError, PropertyError, asked_of
from pbdkit.testing.scenes import place_of
from pbdkit.testing.sight import SeenFrame
from pbdkit.testing.subject import Subject


@asked_of(FramePolicy, needs=REPEATABLE)
def takes_every_point_alone(subject: Subject) -> None:
    """Whom a frame point follows does not depend on which other points there are."""
    policy, reason = subject.component, "it has no points"
    assert isinstance(policy, FramePolicy)
    for scene in subject.scenes:
        frame = sites_of_frame(scene.raster, scene.experiment.rule)
        if frame is None:
            continue
        point, body = frame.nearest()
        seen = SeenFrame.showing(frame, frame.site, point, body)
        whole = policy.follow(seen)
        for some in (np.arange(0, len(frame.site), 2), np.array([len(frame.site) - 1])):
            try:
                part = policy.follow(seen.only(some))
            except ExperimentError as refusal:
                reason = reason and f"it takes whole frames only: {refusal}"
                continue
            reason = ""
            for n, one in enumerate(some):
                if not _alike(part, n, whole, int(one)):
                    raise PropertyError(
                        f"frame point {one} follows somebody else where fewer points are asked "
                        f"about ({place_of(scene.experiment)})"
                    )
    if reason:
        raise NotAskedError(reason)


def _alike(one: FrameMap, n: int, other: FrameMap, m: int) -> bool:
    """Whether point n of a map follows as point m of another does."""
    here, there = one.point == n, other.point == m
    return np.array_equal(one.body[here], other.body[there]) and np.array_equal(
        one.weight[here], other.weight[there]
    )
