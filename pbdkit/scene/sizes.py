"""How large a scene is, before anything of it is allocated."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Diagnostic, RenewsBonds, RenewsParticles
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.remembering import Declared, bond_numbers, particle_numbers

MIB = 2**20
WORKSPACE_BYTES = 100
"""Per particle, what making the tables takes at its peak besides what stays (measured)."""
BOND_BYTES = 74
"""Per bond, the table of bonds and the making of it (measured)."""

CELL_BYTES = 60
"""Per particle, the shares of the cells and the making of them (measured)."""


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
    value = 8 if experiment.solver.precision == "float64" else 4
    bonds, own = bond_numbers(experiment), particle_numbers(experiment)
    state = 2 * 2 * value + experiment.fracture.can_break * planes * (4 + 1 + value)
    state += planes * _bytes_of(bonds, value) + _bytes_of(own, value)
    table = (
        1
        + 8
        + 2 * 4
        + experiment.rule.uses_reference * 16
        + experiment.shows_bonds * planes * BOND_BYTES
        + experiment.frame.weighs_cells * CELL_BYTES
    )
    memory = math.ceil(particles * (state + table + WORKSPACE_BYTES))
    return Sizes(particles, memory, _output(experiment, particles, planes))


def _output(experiment: Experiment, particles: int, planes: float) -> int:
    """Bytes of the dataset, with `planes` bonds a particle, all of which may break."""
    bonds, own = bond_numbers(experiment), particle_numbers(experiment)
    records = experiment.recording.count(experiment.steps)
    recorded = np.dtype(experiment.record.dtype).itemsize
    entries = {
        stepped: sum(
            _bytes_an_entry(d, particles, recorded)
            for d in experiment.diagnostics
            if d.every_step == stepped and not d.at_end
        )
        for stepped in (False, True)
    }
    per_record, every_step = particles * (2 * recorded + 1) + entries[False], entries[True]
    once = particles * (2 * 8 + 2 * 4 + 2 * 8)
    if experiment.shows_bonds:
        once += math.ceil(particles * planes * (2 * 8 + 1 + 12 * experiment.fracture.can_break))
    of_bonds, of_particles = (
        _recorded_bytes(numbers, renews, recorded)
        for numbers, renews in (
            (bonds, isinstance(experiment.fracture, RenewsBonds)),
            (own, isinstance(experiment.rule, RenewsParticles)),
        )
    )
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
