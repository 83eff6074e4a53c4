"""How large a scene is, before anything of it is allocated."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Diagnostic
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.neighbourhood import Neighbourhood

MIB = 2**20
WORKSPACE_BYTES = 100
"""Per particle, what making the tables takes at its peak besides what stays (measured)."""
BOND_BYTES = 74
"""Per bond, the table of bonds and the making of it (measured)."""


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
    share = len(cell.sites) / (cell.period[0] * cell.period[1])
    particles = math.ceil((window[0] + 2 * layers) * (window[1] + 2 * layers) * share)
    return sizes_of(experiment, neighbourhood, particles)


def sizes_of(experiment: Experiment, neighbourhood: Neighbourhood, particles: int) -> Sizes:
    """The same for a known number of particles."""
    planes = len(neighbourhood.planes) / len(neighbourhood.slots)
    value = 8 if experiment.solver.precision == "float64" else 4
    state = 2 * 2 * value + experiment.fracture.can_break * planes * (4 + 1)
    table = (
        1
        + 8
        + 2 * 4
        + experiment.rule.uses_reference * 16
        + experiment.shows_bonds * planes * BOND_BYTES
    )
    memory = math.ceil(particles * (state + table + WORKSPACE_BYTES))
    records = experiment.recording.count(experiment.steps)
    recorded = np.dtype(experiment.record.dtype).itemsize
    entries = {
        stepped: sum(
            _bytes_an_entry(d, particles, recorded)
            for d in experiment.diagnostics
            if d.every_step == stepped
        )
        for stepped in (False, True)
    }
    per_record, every_step = particles * (2 * recorded + 1) + entries[False], entries[True]
    once = particles * (2 * 8 + 2 * 4 + 2 * 8)
    if experiment.shows_bonds:
        once += math.ceil(particles * planes * (2 * 8 + 1 + 4 * experiment.fracture.can_break))
    output = once + records * per_record + (experiment.steps + 1) * every_step
    return Sizes(particles, memory, output)


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


def _bytes_an_entry(diagnostic: Diagnostic, particles: int, recorded: int) -> int:
    sizes = {"particle": particles, "axis": 2}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    return sum(
        math.prod(sizes.get(dim, 1) for dim in v.dims)
        * (recorded if v.dtype == "f8" else np.dtype(v.dtype).itemsize)
        for v in diagnostic.variables()
    )
