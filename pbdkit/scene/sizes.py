"""How large a scene is, before anything of it is allocated."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import AppliesTwice, Diagnostic, RenewsBonds, RenewsParticles
from pbdkit.interfaces.lattice import Index
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.declarations import Declared, bond_numbers, particle_numbers
from pbdkit.scene.neighbourhood import Neighbourhood

MIB = 2**20
LEAST = 6 * MIB
"""What any scene takes, however small: tables are made in chunks."""

WORKSPACE, BONDS, CELLS, FREE_EDGES, INNER = 20, 80, 110, 60, 130
"""Bytes a particle, measured as the peak of the process over sheets of 90 000 to 500 000: making
the tables besides what stays; each bond plane, in the table of bonds and the making of it; shares
of cells; a calibrated rule under a frame with points; a rule on the moves of another."""

GRADIENT, FORCES, TABLES = 250, 160, 40
"""The same for diagnostics, the first that applies: the displacement gradient, forces, tables."""

ANEW, ANEW_EACH = 150, 118
"""The same where neighbours are found anew, and a neighbour."""

FACTORS, COUPLED_FACTORS = 200, 800
"""The same a neighbour for the matrices of an equilibrium: of rules that leave x and y apart, and
of calibrated ones. Rough: it depends on the method and on the shape of the body."""


@dataclass(frozen=True)
class Sizes:
    """Estimates: particles (frame included), bytes of the scene while it runs, bytes of its
    output. The output is in memory too where a run returns a dataset instead of writing a file."""

    particles: int
    memory: int
    output: int


def estimate(
    experiment: Experiment, neighbourhood: Neighbourhood, window: Index, layers: int
) -> Sizes:
    """From the window of site indices that the body fills at most, with Python's integers."""
    cell = experiment.lattice.cell()
    share = len(cell.sites) / math.prod(cell.period)
    particles = math.ceil(math.prod(n + 2 * layers for n in window) * share)
    return sizes_of(experiment, neighbourhood, particles)


def sizes_of(experiment: Experiment, neighbourhood: Neighbourhood, particles: int) -> Sizes:
    """The same for a known number of particles."""
    planes = len(neighbourhood.planes) / len(neighbourhood.slots)
    value = 8 if experiment.stepping.precision == "float64" else 4
    bonds, own = bond_numbers(experiment), particle_numbers(experiment)
    state = 2 * 2 * value + experiment.fracture.can_break * planes * (4 + 1 + value)
    state += planes * _bytes_of(bonds, value) + _bytes_of(own, value)
    table = 1 + 8 + 2 * 4 + experiment.rule.uses_reference * 16
    made = _workspace(experiment, len(neighbourhood.slots[0]), planes)
    memory = LEAST + math.ceil(particles * (state + table + made))
    return Sizes(particles, memory, _output(experiment, particles, planes))


def _workspace(experiment: Experiment, each: int, planes: float) -> float:
    """Bytes a particle besides state and table, with `each` neighbours."""
    rule, frame, diagnostics = experiment.rule, experiment.frame, experiment.diagnostics
    made = WORKSPACE + experiment.shows_bonds * planes * BONDS
    made += INNER * isinstance(rule, AppliesTwice)
    made += CELLS if frame.weighs_cells else rule.uses_cells * FREE_EDGES
    tables = [d for d in diagnostics if any("particle" in v.dims for v in d.variables())]
    if any("cells" in d.needs for d in tables):
        made += GRADIENT
    elif any("forces" in d.needs for d in diagnostics):
        made += FORCES
    elif tables:
        made += TABLES
    if experiment.neighbours.nearness():
        made += ANEW + each * ANEW_EACH
    if not experiment.solver.makes_steps:
        made += each * (FACTORS if material_of(rule) is None else COUPLED_FACTORS)
    return made


def _output(experiment: Experiment, particles: int, planes: float) -> int:
    """Bytes of the dataset, with `planes` bonds a particle, all of which may break."""
    bonds, own = bond_numbers(experiment), particle_numbers(experiment)
    records = experiment.recording.count(experiment.steps)
    recorded = np.dtype(experiment.record.dtype).itemsize
    per_record, every_step = particles * (2 * recorded + 1), 0
    for diagnostic in experiment.diagnostics:
        entry = 0 if diagnostic.at_end else _bytes_an_entry(diagnostic, particles, recorded)
        if diagnostic.every_step:
            every_step += entry
        else:
            per_record += entry
    once = particles * (2 * 8 + 2 * 4 + 2 * 8)
    if experiment.shows_bonds:
        once += math.ceil(particles * planes * (2 * 8 + 1 + 12 * experiment.fracture.can_break))
    of_bonds = _recorded_bytes(bonds, isinstance(experiment.fracture, RenewsBonds), recorded)
    of_particles = _recorded_bytes(own, isinstance(experiment.rule, RenewsParticles), recorded)
    once += math.ceil(particles * (planes * of_bonds[0] + of_particles[0]))
    per_record += math.ceil(particles * (planes * of_bonds[1] + of_particles[1]))
    return once + records * per_record + (experiment.steps + 1) * every_step


def refuse_too_large(
    experiment: Experiment, neighbourhood: Neighbourhood, window: Index, layers: int
) -> None:
    """Raises ExperimentError where the scene cannot fit into the memory of this machine."""
    sizes = estimate(experiment, neighbourhood, window, layers)
    available = machine_memory()
    if sizes.memory > available:
        raise ExperimentError(
            f"{sizes.particles:.3g} particles need about {sizes.memory / 2**30:.3g} GiB and this "
            f"machine has {available / 2**30:.3g}; make it smaller",
            ("body",),
        )


def machine_memory() -> int:
    """The physical memory in bytes; what cannot be asked is taken as 16 GiB."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 16 * 2**30


def _bytes_of(numbers: Declared, value: int) -> int:
    return sum(value if n.dtype == "f8" else np.dtype(n.dtype).itemsize for n in numbers)


def _recorded_bytes(numbers: Declared, part_renews: bool, recorded: int) -> tuple[int, int]:
    """What is written of each bond or particle once, and at every record."""
    shown = tuple(n for n in numbers if n.recorded)
    growing = tuple(n for n in shown if n.changes and part_renews)
    fixed = tuple(n for n in shown if n not in growing)
    return _bytes_of(fixed, 8), _bytes_of(growing, recorded)


def _bytes_an_entry(diagnostic: Diagnostic, particles: int, recorded: int) -> int:
    sizes = {"particle": particles, "axis": 2}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    return sum(
        math.prod(sizes.get(dim, 1) for dim in v.dims)
        * (recorded if v.dtype == "f8" else np.dtype(v.dtype).itemsize)
        for v in diagnostic.variables()
    )
