"""What the linear systems of an equilibrium take, before anything of them is allocated.

All measured as the peak of a fresh process above that of its imports, over sheets of 2500 to a
million particles: within 15 % of these, for compact bodies that leaders hold.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import AppliesTwice
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.neighbourhood import Neighbourhood

LARGEST_DIRECT, LARGEST_ANEW = 3_000, 20_000
"""Particles up to which `auto` takes a direct solver, and where systems are set up again and again:
by differences of moves, which are compiled beyond, or at each change of a bond. What works on
stencils is compiled once a machine."""

KERNELS = 48 * 2**20
"""Bytes of the compiled functions of grids."""
GRIDS, OWN_STENCILS = 160, 2300
"""Bytes a particle of grids where most particles share a stencil, and where each has its own, as
with a rule that is not linear."""
UNCOUPLED, UNCOUPLED_EACH, COUPLED_EACH = 900, 112, 800
"""Bytes a particle of a matrix and what solves it: of rules that leave x and y apart, and more of
them a neighbour; of calibrated rules a neighbour."""
TWO = 2
"""Matrices at a time where the rule is not linear."""


def equilibrium_size(
    experiment: Experiment, neighbourhood: Neighbourhood, particles: int, grids: bool
) -> int:
    """Bytes of the systems of an equilibrium, on grids where these serve."""
    linear = experiment.rule.linear and not experiment.obstacles
    if grids and _on_grids(experiment, neighbourhood, particles):
        return KERNELS + particles * (GRIDS if linear else OWN_STENCILS)
    each = len(neighbourhood.slots[0])
    if material_of(experiment.rule) is None:
        bytes_each = UNCOUPLED + each * UNCOUPLED_EACH
    else:
        bytes_each = each * COUPLED_EACH
    return particles * bytes_each * (1 if linear else TWO)


def asks_for_grids(experiment: Experiment, method: str, particles: int) -> bool:
    """Whether stencils serve best, where they serve."""
    once = experiment.rule.linear and not experiment.fracture.can_break
    largest = LARGEST_DIRECT if once else LARGEST_ANEW
    return method == "multigrid" or (method == "auto" and particles > largest)


def _on_grids(experiment: Experiment, neighbourhood: Neighbourhood, particles: int) -> bool:
    """Whether the lattice's stencils serve."""
    method, cell = experiment.solver.sought.method, neighbourhood.cell
    if not (asks_for_grids(experiment, method, particles) and find_spec("numba")) or isinstance(
        experiment.rule, AppliesTwice
    ):
        return False
    if experiment.obstacles:
        return False
    if experiment.neighbours.nearness() or len(cell.primitive) != 2:
        return False
    slots = neighbourhood.every
    steps = [cell.offset(slot.source, slot.target, slot.cell).primitive for slot in slots]
    alike = abs(np.linalg.det(cell.primitive)) == len(cell.sites)
    return bool(alike and np.abs(steps).max() <= 1)
