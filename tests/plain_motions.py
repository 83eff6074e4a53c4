"""The motions in plain loops (see plain_loops.py); model.md section 5.1."""

import math
from itertools import pairwise

from plain_lattice import Part, Point, minus, plus, point, times


def along_path(motion: Part, count: int) -> Point:
    """Displacements at the steps given, linear between, from zero at step 0, the last kept."""
    knots = list(zip(motion["steps"], map(point, motion["displacements"]), strict=True))
    knots = [(0, (0.0, 0.0)), *knots]
    if any(later <= sooner for (sooner, _), (later, _) in pairwise(knots)):
        raise ValueError("the steps of a path do not rise from above 0")
    for (sooner, start), (later, end) in pairwise(knots):
        if count <= later:
            passed = (count - sooner) / (later - sooner)
            return plus(start, times(passed, minus(end, start)))
    return knots[-1][1]


def turned(p: Point, centre: Point, degrees: float) -> Point:
    """Counterclockwise about the centre."""
    angle, (x, y) = math.radians(degrees), minus(p, centre)
    cos, sin = math.cos(angle), math.sin(angle)
    return plus(centre, (cos * x - sin * y, sin * x + cos * y))


def displaced(start: Point, motion: Part, count: int) -> Point:
    """Return the displacement that a motion has given a particle in its step number count, from
    1."""
    if motion["type"] == "hold":
        return start
    if motion["type"] == "velocity":
        return plus(start, times(min(count, motion["steps"]), motion["velocity"]))
    if motion["type"] == "displace":
        return plus(start, motion["displacement"])
    if motion["type"] == "path":
        return plus(start, along_path(motion, count))
    if motion["type"] == "rotation":
        degrees = min(count, motion["steps"]) * float(motion["angle"])
        return turned(start, point(motion["centre"]), degrees)
    if motion["type"] == "oscillation":
        wave = math.sin(2 * math.pi * count / motion["period"])
        return plus(start, times(wave, motion["amplitude"]))
    raise ValueError(f"motion type {motion['type']!r}")
