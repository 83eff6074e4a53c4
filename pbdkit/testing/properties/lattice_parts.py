"""What is asked of lattices, neighbour metrics and frame policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import (
    BasisSite,
    Cell,
    FrameMap,
    FramePolicy,
    Lattice,
    NeighbourMetric,
    Offset,
)
from pbdkit.registry.registry import Registry
from pbdkit.scene.frame_points import sites_of_frame
from pbdkit.scene.neighbourhood import build_neighbourhood, checked_cell
from pbdkit.testing.fault import NotAskedError, PropertyError
from pbdkit.testing.property import asked_of
from pbdkit.testing.states import frame_showing
from pbdkit.testing.subject import LATTICES, Subject, alternatives, place_of


@asked_of(Lattice, is_needed=True)
def has_a_sound_cell(subject: Subject) -> None:
    """The cell vectors span an area, no two basis sites share an index, a place or a primitive
    index, all lie within the period and near where their index says, and `primitive` counts equal
    steps alike and leaves none out."""
    lattice = subject.component
    try:
        cell = checked_cell(lattice)
    except ExperimentError as error:
        raise PropertyError(str(error)) from None
    _refuse_equal(cell, "place", np.array(cell.vectors), lambda site: site.at)
    if np.linalg.det(cell.primitive) == 0.0:
        raise PropertyError(f"`primitive` gives the cell vectors {cell.primitive}: in line")
    _refuse_equal(cell, "primitive index", np.array(cell.primitive), lambda site: site.primitive)
    for n, site in enumerate(cell.sites):
        cells = np.array(site.at) @ np.linalg.inv(np.array(cell.vectors))
        if (np.abs(cells - np.divide(site.index, cell.period)) > 1.0 - 1e-9).any():
            raise PropertyError(
                f"basis site {n} lies a cell or more from where its index {site.index} says: take "
                "whole cell vectors from its `at`"
            )
    _refuse_miscounted(cell)


def _refuse_miscounted(cell: Cell) -> None:
    """Raises where `primitive` tells one step from another that leads the same way, or counts in
    steps that no site takes."""
    length = float(np.linalg.norm(tuple(cell.vectors[0])))
    counted: dict[tuple[float, ...], tuple[int, ...]] = {}
    reach = 1.5 * sum(float(np.linalg.norm(tuple(v))) for v in cell.vectors)
    for s in range(len(cell.sites)):
        for offset in cell.offsets(s, reach):
            step = tuple((np.round(np.divide(tuple(offset.rest), length), 6) + 0.0).tolist())
            if (known := counted.setdefault(step, offset.primitive)) != offset.primitive:
                raise PropertyError(
                    f"`primitive` counts the step {tuple(offset.rest)} from one site as {known} "
                    f"and from another as {offset.primitive}"
                )
    first, *others = cell.sites
    steps = [*cell.primitive, *(np.subtract(s.primitive, first.primitive) for s in others)]
    spanned = [np.linalg.det(np.array(some)) for some in combinations(steps, len(cell.vectors))]
    if np.gcd.reduce(np.rint(spanned).astype(int)) != 1:
        raise PropertyError("`primitive` counts steps that no site takes: count whole ones only")


def _refuse_equal(
    cell: Cell, what: str, steps: np.ndarray, of: Callable[[BasisSite], tuple[float, ...]]
) -> None:
    """Raises where two sites have the same value up to whole steps of the cell."""
    for (m, one), (n, other) in combinations(enumerate(cell.sites), 2):
        apart = np.linalg.solve(
            steps.T, np.subtract(tuple(of(other)), tuple(of(one))).astype(float)
        )
        if np.abs(apart - np.round(apart)).max() < 1e-9:
            raise PropertyError(
                f"basis sites {m} and {n} have the same {what} {tuple(of(one))}, up to whole "
                "cells: they must differ"
            )


@asked_of(Lattice)
def keeps_its_cell_wherever_it_lies(subject: Subject) -> None:
    """The origin moves the lattice and does not enter its cell: no digit of a run depends on where
    the body lies."""
    lattice = subject.component
    moved = lattice.model_copy(update={"origin": (1000.3, -77.1)})
    if moved.cell() != lattice.cell():
        raise PropertyError("another origin gives another cell: leave `self.origin` out of `cell`")


Chosen = set[tuple[int, tuple[int, ...]]]


@asked_of(NeighbourMetric, is_needed=True)
def is_mutual(subject: Subject) -> None:
    """Whoever is a neighbour has this particle as its own neighbour, in the same shell, once: bonds
    have two ends, and a body at rest stays at rest."""
    metric = subject.component
    for lattice, cell in _cells(subject):
        try:
            build_neighbourhood(cell, metric)
        except ExperimentError as error:
            raise PropertyError(f"on the {lattice} lattice: {error}") from None


@asked_of(NeighbourMetric)
def takes_offsets_of_the_cell(subject: Subject) -> None:
    """Every offset is one that the cell itself gives, so that its site index and its opposite
    agree with the lattice's."""
    for lattice, cell in _cells(subject):
        for s in range(len(cell.sites)):
            for offset in _flat(subject.component, cell, s):
                if offset != cell.offset(s, offset.target, offset.cell):
                    raise PropertyError(
                        f"on the {lattice} lattice the offset {offset.rest} is none of the cell's: "
                        "take those of `cell.offsets(sublattice, radius)` as they are"
                    )


@asked_of(NeighbourMetric)
def takes_sublattices_in_any_order(subject: Subject) -> None:
    """The basis sites in another order have the same neighbours: how a cell is written down means
    nothing."""
    metric = subject.component
    for lattice, cell in _cells(subject):
        backwards, last = replace(cell, sites=cell.sites[::-1]), len(cell.sites) - 1
        for s in range(len(cell.sites)):
            if _chosen(metric, cell, s) != _chosen(metric, backwards, last - s):
                raise PropertyError(
                    f"on the {lattice} lattice basis site {s} has other neighbours where the sites "
                    "are listed backwards"
                )


@asked_of(NeighbourMetric, is_needed=True)
def finds_the_same_anew(subject: Subject) -> None:
    """Neighbours that are found anew at every step are, in the reference configuration, those that
    it chooses on the lattice."""
    metric = subject.component
    near = metric.nearness()
    if near is None:
        raise NotAskedError("its neighbours stay as they are")
    for lattice, cell in _cells(subject):
        scale = np.sqrt(near.weights)
        far = near.radius / scale.min() * (1 + 1e-6)
        for s in range(len(cell.sites)):
            met = {
                o.site
                for o in cell.offsets(s, far)
                if np.hypot(*(scale * np.array(o.rest))) <= near.radius * (1 + 1e-9)
            }
            if met != {o.site for o in _flat(metric, cell, s)}:
                raise PropertyError(
                    f"on the {lattice} lattice `nearness` finds other neighbours in the reference "
                    "configuration than `shells_around` chooses"
                )


def _cells(subject: Subject) -> Iterator[tuple[str, Cell]]:
    """The lattices to try, by name, but for those that the metric refuses."""
    registry, given = Registry(), subject.parts.get("lattice")
    for part in alternatives(given) if given else LATTICES.values():
        lattice: Any = part
        if not isinstance(part, Lattice):
            lattice = registry.find(Lattice, part["type"]).model_validate(part)
        name, cell = lattice.type, lattice.cell()
        try:
            for s in range(len(cell.sites)):
                subject.component.shells_around(cell, s)
        except ExperimentError:
            continue
        yield name, cell


def _flat(metric: NeighbourMetric, cell: Cell, sublattice: int) -> list[Offset]:
    return [o for shell in metric.shells_around(cell, sublattice) for o in shell]


def _chosen(metric: NeighbourMetric, cell: Cell, sublattice: int) -> Chosen:
    """(shell, step between sites) of every neighbour."""
    shells = metric.shells_around(cell, sublattice)
    return {(n, o.site) for n, shell in enumerate(shells, 1) for o in shell}


@asked_of(FramePolicy)
def takes_every_point_alone(subject: Subject) -> None:
    """Whom a frame point follows does not depend on which other points there are."""
    policy, reason = subject.component, "it has no points"
    for scene in subject.scenes:
        frame = sites_of_frame(scene.raster, scene.experiment.rule)
        if frame is None:
            continue
        point, body = frame.nearest()
        whole = policy.follow(frame_showing(frame, frame.site, point, body))
        for some in (np.arange(0, len(frame.site), 2), np.array([len(frame.site) - 1])):
            kept = np.isin(point, some)
            anew = np.searchsorted(some, point[kept])
            try:
                part = policy.follow(frame_showing(frame, frame.site[some], anew, body[kept]))
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
