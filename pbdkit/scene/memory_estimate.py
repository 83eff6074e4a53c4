"""Estimates of the memory that a scene and the linear systems of an equilibrium need. They are made
before large arrays are allocated.

All coefficients are measured for sheets of 2500 to a million particles, as the peak memory of a
process minus its memory after its imports. For compact bodies that are held by leaders, the
estimates differ from the measured values by at most 15 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import ExperimentError
from pbdkit.lattice.neighbourhood import Neighbourhood
from pbdkit.memory import machine_memory
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import AppliesTwice, Diagnostic, RenewsBonds, RenewsParticles
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.units import LENGTH
from pbdkit.scene.constants import bond_numbers, particle_numbers

LARGEST_DIRECT = 3_000
"""Number of particles up to which `auto` selects a direct solver if the system is set up once."""
LARGEST_REPEATED = 20_000
"""Number of particles up to which `auto` selects a direct solver if systems are set up repeatedly,
because the rule is nonlinear or bonds break. Beyond it, the moves are compiled."""

KERNELS = 48 * 2**20
"""Number of bytes of the compiled functions of multigrid."""
SHARED_STENCILS = 160
"""Number of bytes per particle of multigrid systems in which most particles share a stencil."""
SINGLE_STENCILS = 2300
"""Number of bytes per particle of multigrid systems in which each particle has a separate stencil,
for instance because the rule is nonlinear."""
SCALAR_MATRIX = 900
"""Number of bytes per particle of a matrix and its factors if x and y are solved separately."""
SCALAR_MATRIX_EACH = 112
"""Number of bytes per particle and neighbour of such a matrix and its factors."""
VECTOR_MATRIX_EACH = 800
"""Number of bytes per particle and neighbour of a matrix and its factors if x and y are coupled."""
NONLINEAR_MATRICES = 2
"""Number of matrices that exist at the same time if the rule is nonlinear."""


def equilibrium_size(
    experiment: Experiment, neighbourhood: Neighbourhood, particles: int, grids: bool
) -> int:
    """Return the number of bytes of the linear systems of an equilibrium. With `grids`, multigrid
    is assumed if the method of the solver permits it."""
    linear = experiment.rule.linear and not experiment.obstacles
    if grids and _on_grids(experiment, neighbourhood, particles):
        return KERNELS + particles * (SHARED_STENCILS if linear else SINGLE_STENCILS)
    each = len(neighbourhood.slots[0])
    if material_of(experiment.rule) is None:
        bytes_each = SCALAR_MATRIX + each * SCALAR_MATRIX_EACH
    else:
        bytes_each = each * VECTOR_MATRIX_EACH
    return particles * bytes_each * (1 if linear else NONLINEAR_MATRICES)


def asks_for_grids(experiment: Experiment, method: str, particles: int) -> bool:
    """Return whether multigrid on stencils is requested or, if the method is selected
    automatically, is the fastest method."""
    once = experiment.rule.linear and not experiment.fracture.can_break
    largest = LARGEST_DIRECT if once else LARGEST_REPEATED
    return method == "multigrid" or (method == "auto" and particles > largest)


def _on_grids(experiment: Experiment, neighbourhood: Neighbourhood, particles: int) -> bool:
    """Return whether the experiment can use multigrid on stencils."""
    method, cell = experiment.solver.equilibrium.method, neighbourhood.cell
    if not (asks_for_grids(experiment, method, particles) and find_spec("numba")):
        return False
    if isinstance(experiment.rule, AppliesTwice) or experiment.obstacles:
        return False
    if experiment.neighbours.nearness() or len(cell.primitive) != 2:
        return False
    slots = neighbourhood.every
    steps = [cell.offset(slot.source, slot.target, slot.cell).primitive for slot in slots]
    is_primitive = abs(np.linalg.det(cell.primitive)) == len(cell.sites)
    return bool(is_primitive and np.abs(steps).max() <= 1)


MIB = 2**20
"""Number of bytes in a mebibyte."""
SMALLEST = 6 * MIB
"""Number of bytes of the smallest scene. It is not zero because tables are built in chunks of
constant size."""

# Numbers of bytes per particle, measured as the peak of the process for sheets of 90 000 to 500 000
# particles.
WORKSPACE = 20
"""Temporary arrays that exist while the tables are built."""
BONDS = 80
"""Table of bonds, and temporary arrays that exist while it is built, for each plane of bonds."""
CELLS = 110
"""Area fractions of cells."""
FREE_EDGES = 60
"""Weights of a calibrated rule if the frame has points."""
INNER = 130
"""Moves of an inner rule."""
LOADS = 60
"""Loads on all particles."""
MATERIALS = 250
"""Cells of several materials."""
GRADIENT = 250
"""Displacement gradient at all particles, for diagnostics of strain or stress."""
FORCES = 160
"""Forces at all particles, for diagnostics of forces."""
TABLES = 40
"""Tables by particle, for other diagnostics."""
NEW_NEIGHBOURS = 150
"""Search of neighbours at every step."""
NEW_NEIGHBOURS_EACH = 118
"""Additional bytes for each neighbour if neighbours are searched at every step."""

CHUNK_BYTES = 2**20
"""Approximate size of a chunk of a file in bytes. If the entries of a variable are small, a chunk
consists of several entries; if they are large, a chunk is a part of an entry. The time series of a
particle can therefore be read with one chunk for each batch of steps, and a snapshot without
reading much more than the snapshot."""

OPEN_CHUNK = 1024
"""Number of entries of a chunk along a dimension of unknown length."""

FILE_OVERHEAD = 40_000
"""Number of bytes of a file without values."""
VARIABLE_OVERHEAD = 1500
"""Number of additional bytes of each variable that grows with the steps or belongs to a
diagnostic."""


class TooLargeError(ExperimentError):
    """Error for lack of memory."""


@dataclass(frozen=True)
class Sizes:
    """Estimates of the size of a scene: the number of particles, including the frame, the bytes of
    memory that a run needs, and the bytes of its output. If a run returns a dataset instead of
    writing a file, its output is in memory, too."""

    particles: int
    memory: int
    output: int


def sizes_of(
    experiment: Experiment, neighbourhood: Neighbourhood, particles: int, *, grids: bool = True
) -> Sizes:
    """Return the estimated sizes of a scene with a given number of particles. `grids` is false if
    multigrid is known to be impossible for its lattice or leaders."""
    planes = len(neighbourhood.planes) / len(neighbourhood.slots)
    value = 8 if experiment.stepping.precision == "float64" else 4
    state: float = 2 * 2 * value + experiment.parts_bonds * planes * (4 + value)
    state += planes * sum(_bytes_of(n.dtype, value) for n in bond_numbers(experiment))
    state += sum(_bytes_of(n.dtype, value) for n in particle_numbers(experiment))
    table: float = 1 + 8 + 2 * 4 + experiment.rule.uses_reference * 16
    table += experiment.parts_bonds * planes
    workspace = _workspace(experiment, len(neighbourhood.slots[0]), planes)
    memory = math.ceil(particles * (state + table + workspace))
    if not experiment.solver.makes_steps:
        solved = equilibrium_size(experiment, neighbourhood, particles, grids)
        memory = max(memory, math.ceil(particles * (state + table)) + solved)
    memory += SMALLEST
    output = math.ceil(particles * state) + _output(experiment, particles, planes)
    return Sizes(particles, memory, output)


def _workspace(experiment: Experiment, each: int, planes: float) -> float:
    """Return the number of bytes per particle in addition to the state and the particle table.
    `each` is the number of neighbours of a particle."""
    rule, frame, diagnostics = experiment.rule, experiment.frame, experiment.diagnostics
    workspace = WORKSPACE + experiment.shows_bonds * planes * BONDS
    workspace += INNER * isinstance(rule, AppliesTwice) + LOADS * bool(experiment.loads)
    workspace += MATERIALS * bool(rule.varying and rule.uses_cells) + 8 * len(rule.varying)
    workspace += 8 * planes * len(experiment.fracture.varying)
    workspace += CELLS if frame.weighs_cells else rule.uses_cells * FREE_EDGES
    tables = [d for d in diagnostics if any("particle" in v.dims for v in d.variables())]
    if any("cells" in d.needs for d in tables):
        workspace += GRADIENT
    elif any("forces" in d.needs for d in diagnostics):
        workspace += FORCES
    elif tables:
        workspace += TABLES
    if experiment.neighbours.nearness():
        workspace += NEW_NEIGHBOURS + each * NEW_NEIGHBOURS_EACH
    return workspace


def _output(experiment: Experiment, particles: int, planes: float) -> int:
    """Return the number of bytes of the dataset without its final state. There are `planes` bonds
    per particle, and all of them are assumed to break."""
    fracture, rule = experiment.fracture, experiment.rule
    recorded = np.dtype(experiment.record.dtype).itemsize
    records = experiment.record_count
    steps = experiment.steps + 1 if experiment.solver.makes_steps else records
    each_bond = 4 + 2 * 4 + 1 + 12 * experiment.parts_bonds
    once: float = (1 + bool(experiment.units)) * 4 * 8 + 2 * 2 * 4 + 2 * 8 + 2
    once += experiment.shows_bonds * planes * each_bond
    growing = [(records, particles * size) for size in (2.0 * recorded, 1.0)] + [(records, 8.0)]
    of_bonds = (bond_numbers(experiment), planes, isinstance(fracture, RenewsBonds))
    of_particles = (particle_numbers(experiment), 1, isinstance(rule, RenewsParticles))
    for numbers, owners, renews in (of_bonds, of_particles):
        for number in (n for n in numbers if n.recorded):
            if renews and number.changes:
                entry = particles * owners * _bytes_of(number.dtype, recorded)
                growing.append((records, entry))
            else:
                once += owners * _bytes_of(number.dtype, 8)
    for diagnostic in experiment.diagnostics:
        entries = _bytes_an_entry(diagnostic, particles, recorded, in_mm=bool(experiment.units))
        count = steps if diagnostic.every_step else records
        growing += [(1 if diagnostic.at_end else count, entry) for entry in entries]
    if any(d.every_step for d in experiment.diagnostics):
        growing.append((steps, 8.0))
    values = sum(_in_whole_chunks(*column) for column in growing) + particles * once
    return math.ceil(values) + FILE_OVERHEAD + len(growing) * VARIABLE_OVERHEAD


def _in_whole_chunks(count: int, entry: float) -> float:
    """Return the number of bytes of a variable in the file, with `count` entries of `entry`
    bytes."""
    batch = max(1, min(int(CHUNK_BYTES // max(entry, 1.0)), count))
    return math.ceil(count / batch) * batch * entry


def refuse_too_large(
    experiment: Experiment,
    neighbourhood: Neighbourhood,
    window: Index,
    layers: int,
    communicator: Communicator = SERIAL,
) -> None:
    """Raise ExperimentError if the scene needs more memory than the machine has. The body is
    assumed to fill its window of site indices. With several processes, the part of each process is
    compared with its share of the memory. Python's integers are used, because the number of sites
    can exceed 64 bits."""
    cell = neighbourhood.cell
    share = len(cell.sites) / math.prod(cell.period)
    particles = math.ceil(math.prod(n + 2 * layers for n in window) * share)
    needed = sizes_of(experiment, neighbourhood, math.ceil(particles / communicator.size)).memory
    available = machine_memory(communicator.processes_on_machine())
    if needed > available:
        each, fewer = "", "reduce it"
        if communicator.size > 1:
            each, fewer = (
                " in each process",
                "reduce the body, or start more processes on other machines",
            )
        raise TooLargeError(
            f"{particles:.3g} particles need about {needed / 2**30:.3g} GiB{each}, but only "
            f"{available / 2**30:.3g} may be used on this machine; {fewer}",
            ("body",),
        )


def _bytes_of(dtype: str, value: int) -> int:
    """Return the number of bytes of a value with the given data type. Floating-point values are
    stored with `value` bytes."""
    return value if dtype == "f8" else np.dtype(dtype).itemsize


def _bytes_an_entry(
    diagnostic: Diagnostic, particles: int, recorded: int, *, in_mm: bool
) -> list[float]:
    """Return the number of bytes of one entry of each variable of a diagnostic in the file. With
    `in_mm`, lengths are stored twice, in lattice units and in mm."""
    sizes = {"particle": particles, "axis": 2, "principal": 2}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    sizes |= {diagnostic.own_dimension: OPEN_CHUNK}
    return [
        float(math.prod(sizes.get(dim, 1) for dim in v.dims) * _bytes_of(v.dtype, recorded))
        for v in diagnostic.variables()
        for _ in range(1 + (in_mm and v.units == LENGTH.lattice))
    ]
