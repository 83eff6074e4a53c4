"""Ends of cuts and initial cracks inside the body, and the diagnostics that depend on them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pbdkit.lattice.fill import tolerance_of
from pbdkit.model.bodies import Sites
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import CrackEnd, Diagnostic, Pair, StartsCracked
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.fracture_model import Segment


class TimedSegment(NamedTuple):
    """A cut or an initial crack, with the step at the beginning of which it is made."""

    segment: Segment
    step: int


def segments_of(experiment: Experiment) -> dict[str, TimedSegment]:
    """Return the cuts and the initial cracks, by their fields in the experiment."""
    segments = {
        f"cuts.{n}": TimedSegment(cut.segment, cut.at) for n, cut in enumerate(experiment.cuts)
    }
    if isinstance(model := experiment.fracture, StartsCracked):
        with errors_attributed_to(model, "to return its cracks", "fracture"):
            cracks = enumerate(model.segments())
            segments |= {f"fracture.cracks.{n}": TimedSegment(s, 0) for n, s in cracks}
    return segments


def diagnostics_at_cracks(experiment: Experiment) -> tuple[Diagnostic, ...]:
    """Return the diagnostics of an experiment as they are measured."""
    diagnostics = list(experiment.diagnostics)
    for n, diagnostic in enumerate(diagnostics):
        if "cracks" in diagnostic.needs:
            with errors_attributed_to(diagnostic, "to use the cracks", "diagnostics", n):
                diagnostics[n] = diagnostic.at_cracks(tuple(crack_ends(experiment)))
    return tuple(diagnostics)


def crack_ends(experiment: Experiment) -> Iterator[CrackEnd]:
    """Generate the ends of cuts and initial cracks inside the body.

    An end at another segment that exists at that time is no end of the crack. A later segment that
    begins at the end of an earlier one extends its crack, which has the end of the earlier one.
    """
    segments = list(segments_of(experiment).values())
    near = max(math.hypot(*vector) for vector in experiment.lattice.cell().vectors)
    for n, (segment, step) in enumerate(segments):
        others = [other for k, other in enumerate(segments) if k != n and other.step <= step]
        earlier_ends = [end for s, at in others if at < step for end in s]
        for end, start in (segment[::-1], segment):
            joins = any(_distance(end, other) <= near for other, _ in others)
            extends = any(math.dist(start, place) <= near for place in earlier_ends)
            if not (joins or extends) and _is_inside(experiment, end, near):
                away = math.dist(start, end)
                unit = (end[0] - start[0]) / away, (end[1] - start[1]) / away
                yield CrackEnd((float(end[0]), float(end[1])), unit)


def _is_inside(experiment: Experiment, point: Pair, near: float) -> bool:
    """Return whether all sites that are near to a point belong to the body."""
    lattice, body = experiment.lattice, experiment.body
    cell, tolerance = lattice.cell(), tolerance_of(body, lattice)
    around = np.stack(np.meshgrid([-2, -1, 0, 1, 2, 3], [-2, -1, 0, 1, 2, 3]), axis=-1)
    for site in cell.sites:
        corner = np.add(lattice.origin, [*site.at])
        nearest = np.linalg.solve(
            np.array([[*v] for v in cell.vectors]).T, np.array(point) - corner
        )
        cells = np.floor(nearest).astype(np.int64) + around.reshape(-1, 2)
        at = cells @ np.array([[*v] for v in cell.vectors]) + corner
        close = np.hypot(*(at - point).T) <= near
        index = cells * cell.period + site.index
        sites = Sites(tuple(index[close].T), tuple(at[close].T))
        if (body.distance(sites) > tolerance).any():
            return False
    return True


def _distance(point: Pair, segment: Segment) -> float:
    """Return the distance of a point from a segment."""
    p, (a, b) = np.array(point), np.array(segment)
    share = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return math.dist(p, a + share * (b - a))
