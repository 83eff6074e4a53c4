"""What is asked of neighbour metrics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Cell, Lattice, NeighbourMetric, Offset
from pbdkit.registry.registry import Registry
from pbdkit.scene.neighbourhood import build_neighbourhood
from pbdkit.testing.properties.answers import REPEATABLE
from pbdkit.testing.property import NotAskedError, PropertyError, asked_of
from pbdkit.testing.scenes import LATTICES, alternatives
from pbdkit.testing.subject import Subject

Chosen = set[tuple[int, int, tuple[int, ...]]]


@asked_of(NeighbourMetric)
def is_mutual(subject: Subject) -> None:
    """Whoever is a neighbour has this particle as its own neighbour, in the same shell, once: bonds
    have two ends, and a body at rest stays at rest."""
    metric = _metric(subject)
    for lattice, cell in _cells(subject):
        try:
            build_neighbourhood(cell, metric)
        except ExperimentError as error:
            raise PropertyError(f"on the {lattice} lattice: {error}") from None


@asked_of(NeighbourMetric, needs=("is-mutual",))
def takes_offsets_of_the_cell(subject: Subject) -> None:
    """Every offset is one that the cell itself gives, so that its site index and its opposite
    agree with the lattice's."""
    for lattice, cell in _cells(subject):
        for s in range(len(cell.sites)):
            for offset in _flat(_metric(subject), cell, s):
                if offset != cell.offset(s, offset.target, offset.cell):
                    raise PropertyError(
                        f"on the {lattice} lattice the offset {offset.rest} is none of the cell's: "
                        "take those of `cell.offsets(sublattice, radius)` as they are"
                    )


@asked_of(NeighbourMetric, needs=REPEATABLE)
def takes_sublattices_in_any_order(subject: Subject) -> None:
    """The basis sites in another order have the same neighbours: how a cell is written down means
    nothing."""
    metric = _metric(subject)
    for lattice, cell in _cells(subject):
        backwards, last = replace(cell, sites=cell.sites[::-1]), len(cell.sites) - 1
        for s in range(len(cell.sites)):
            if _chosen(metric, cell, s) != _chosen(metric, backwards, last - s):
                raise PropertyError(
                    f"on the {lattice} lattice basis site {s} has other neighbours where the sites "
                    "are listed backwards"
                )


@asked_of(NeighbourMetric, needs=REPEATABLE)
def finds_the_same_anew(subject: Subject) -> None:
    """Neighbours that are found anew at every step are, in the reference configuration, those that
    it chooses on the lattice."""
    metric = _metric(subject)
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


def _metric(subject: Subject) -> NeighbourMetric:
    assert isinstance(subject.component, NeighbourMetric)
    return subject.component


def _cells(subject: Subject) -> Iterator[tuple[str, Cell]]:
    """The lattices to try, by name, but for those that the metric refuses."""
    registry, given = Registry(), subject.parts.get("lattice")
    for part in alternatives(given) if given else LATTICES.values():
        lattice = part
        if not isinstance(part, Lattice):
            lattice = registry.find(Lattice, part["type"]).model_validate(part)
        assert isinstance(lattice, Lattice)
        name, cell = lattice.type, lattice.cell()
        try:
            for s in range(len(cell.sites)):
                _metric(subject).shells_around(cell, s)
        except ExperimentError:
            continue
        yield name, cell


def _flat(metric: NeighbourMetric, cell: Cell, sublattice: int) -> list[Offset]:
    return [o for shell in metric.shells_around(cell, sublattice) for o in shell]


def _chosen(metric: NeighbourMetric, cell: Cell, sublattice: int) -> Chosen:
    """(shell, step between sites) of every neighbour."""
    shells = metric.shells_around(cell, sublattice)
    return {(n, *_index(o)) for n, shell in enumerate(shells, 1) for o in shell}


def _index(offset: Offset) -> tuple[int, tuple[int, ...]]:
    return 0, offset.site
