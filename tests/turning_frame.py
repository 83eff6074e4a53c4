"""A frame with a map of full matrices, that differ from point to point, and far entries."""

from typing import Literal

import numpy as np

import pbdkit


class Turning(pbdkit.FramePolicy):
    """Each point follows the nearest particle, turned a little, and the one in the middle."""

    type: Literal["turning"] = "turning"

    def depth(self, reach):
        return reach

    def follow(self, frame):
        point, body = frame.nearest()
        points, first = np.unique(point, return_index=True)
        middle = (np.array([frame.low]) + np.array([frame.high])) // 2
        centre = frame.body_at(middle.astype(np.int32))[0]
        angle = 0.1 * np.cos(np.arange(len(points)))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        near = turn.transpose(2, 0, 1)
        weight = np.stack([near, np.eye(2) - near], axis=1).reshape(-1, 2, 2)
        bodies = np.stack([body[first], np.full(len(points), centre)], axis=1).ravel()
        return pbdkit.plugin.FrameMap(np.repeat(points, 2), bodies, weight)
