"""What is asked of lattices and neighbour metrics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, combinations

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Cell, Lattice, NeighbourMetric, Offset
from pbdkit.scene.neighbourhood import build_neighbourhood, checked_cell
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of, experiments_with


@asked_of(Lattice, is_needed=True)
def has_a_sound_cell(subject: Subject) -> None:
    """The cell vectors span an area, no two basis sites share an index, a place or a primitive
    index, all lie within the period and near where their index says, and `primitive` counts equal
    steps alike and leaves none out."""
    try:
        cell = checked_cell(subject.component)
    except ExperimentError as error:
        raise PropertyError(str(error)) from None
    for n, site in enumerate(cell.sites):
        cells = np.array(site.at) @ np.linalg.inv(np.array(cell.vectors))
        if (np.abs(cells - np.divide(site.index, cell.period)) > 1.0 - 1e-9).any():
            fault = f"basis site {n} lies a cell or more from where its index {site.index} says"
            raise PropertyError(f"{fault}: take whole cell vectors from its `at`")
    _refuse_miscounted(cell)


def _refuse_miscounted(cell: Cell) -> None:
    """Raises where `primitive` tells one step from another that leads the same way, or two sites
    alike, or counts in steps that no site takes."""
    if np.linalg.det(cell.primitive) == 0.0:
        raise PropertyError(f"`primitive` gives the cell vectors {cell.primitive}: in line")
    for (m, one), (n, other) in combinations(enumerate(cell.sites), 2):
        between = np.subtract(other.primitive, one.primitive).astype(float)
        apart = np.linalg.solve(np.transpose(cell.primitive), between)
        if np.abs(apart - np.round(apart)).max() < 1e-9:
            fault = f"basis sites {m} and {n} have the same primitive index {one.primitive}"
            raise PropertyError(f"{fault}, up to whole cells: they must differ")
    counted: dict[tuple[float, ...], tuple[int, ...]] = {}
    lengths = [math.hypot(*vector) for vector in cell.vectors]
    for offset in chain(*(cell.offsets(s, 1.5 * sum(lengths)) for s in range(len(cell.sites)))):
        step = tuple((np.round(np.divide(tuple(offset.rest), lengths[0]), 6) + 0.0).tolist())
        if (known := counted.setdefault(step, offset.primitive)) != offset.primitive:
            twice = f"as {known} and from another as {offset.primitive}"
            counts = f"`primitive` counts the step {tuple(offset.rest)}"
            raise PropertyError(f"{counts} from one site {twice}")
    first, *others = cell.sites
    steps = [*cell.primitive, *(np.subtract(s.primitive, first.primitive) for s in others)]
    spanned = [np.linalg.det(np.array(some)) for some in combinations(steps, len(cell.vectors))]
    if np.gcd.reduce(np.rint(spanned).astype(int)) != 1:
        raise PropertyError("`primitive` counts steps that no site takes: count whole ones only")


@asked_of(Lattice)
def keeps_its_cell_wherever_it_lies(subject: Subject) -> None:
    """The origin moves the lattice and does not enter its cell: no digit of a run depends on where
    the body lies."""
    moved = subject.component.model_copy(update={"origin": (1000.3, -77.1)})
    if moved.cell() != subject.component.cell():
        raise PropertyError("another origin gives another cell: leave `self.origin` out of `cell`")


@asked_of(NeighbourMetric, is_needed=True)
def is_mutual(subject: Subject) -> None:
    """Whoever is a neighbour has this particle as its own neighbour, in the same shell, once: bonds
    have two ends, and a body at rest stays at rest."""
    for where, cell, _, _ in _tried(subject):
        try:
            build_neighbourhood(cell, subject.component)
        except ExperimentError as error:
            raise PropertyError(f"{where}: {error}") from None


@asked_of(NeighbourMetric)
def takes_offsets_of_the_cell(subject: Subject) -> None:
    """Every offset is one that the cell itself gives, so that its site index and its opposite
    agree with the lattice's."""
    for where, cell, s, shells in _tried(subject):
        for offset in chain(*shells):
            if offset != cell.offset(s, offset.target, offset.cell):
                remedy = "take those of `cell.offsets(sublattice, radius)` as they are"
                fault = f"the offset {offset.rest} is none of the cell's"
                raise PropertyError(f"{where} {fault}: {remedy}")


@asked_of(NeighbourMetric)
def takes_sublattices_in_any_order(subject: Subject) -> None:
    """The basis sites in another order have the same neighbours: how a cell is written down means
    nothing."""
    for where, cell, s, shells in _tried(subject):
        backwards = replace(cell, sites=cell.sites[::-1])
        others = subject.component.shells_around(backwards, len(cell.sites) - 1 - s)
        if [_sites(shell) for shell in shells] != [_sites(shell) for shell in others]:
            fault = f"basis site {s} has other neighbours where the sites are listed backwards"
            raise PropertyError(f"{where} {fault}")


@asked_of(NeighbourMetric, is_needed=True)
def finds_the_same_anew(subject: Subject) -> None:
    """Neighbours that are found anew at every step are, in the reference configuration, those that
    it chooses on the lattice."""
    near = subject.component.nearness()
    if near is None:
        raise NotAskedError("its neighbours stay as they are")
    scale = np.sqrt(near.weights)
    far, limit = near.radius / scale.min() * (1 + 1e-6), near.radius * (1 + 1e-9)
    for where, cell, s, shells in _tried(subject):
        met = (o for o in cell.offsets(s, far) if np.hypot(*(scale * tuple(o.rest))) <= limit)
        if _sites(met) != _sites(chain(*shells)):
            fault = "`nearness` finds other neighbours in the reference configuration"
            raise PropertyError(f"{where} {fault} than `shells_around` chooses")


def _tried(subject: Subject) -> Iterator[tuple[str, Cell, int, Sequence[Sequence[Offset]]]]:
    """Each basis site of the lattices to try, but for those that the metric refuses: where it is,
    in which cell, and the shells around it."""
    metric = subject.component
    experiments = experiments_with(metric, subject.parts)
    for lattice in dict.fromkeys(experiment.lattice for experiment in experiments):
        cell = lattice.cell()
        with suppress(ExperimentError):
            around = [metric.shells_around(cell, s) for s in range(len(cell.sites))]
            for s, shells in enumerate(around):
                yield f"on the {lattice.type} lattice", cell, s, shells


def _sites(offsets: Iterable[Offset]) -> set[tuple[int, ...]]:
    """The steps between sites."""
    return {offset.site for offset in offsets}
