"""Whether the stencils of its lattice serve a scene, and the system that they make."""

from __future__ import annotations

from dataclasses import replace

from pbdkit.equilibrium.grids.held_components import constrained, held_components
from pbdkit.equilibrium.grids.lattice_system import LatticeSystem
from pbdkit.equilibrium.grids.multigrid import FloatingError
from pbdkit.equilibrium.grids.stencil_matrix import NUDGE, differenced_matrix, stencil_matrix
from pbdkit.equilibrium.grids.stencil_properties import (
    DIFFERENCED,
    EXACT,
    balanced,
    is_held,
    leads_one_way,
)
from pbdkit.equilibrium.moves import Moves, random_displacements
from pbdkit.equilibrium.rows import ALL, Rows
from pbdkit.equilibrium.system import IndefiniteError
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

FAITHFUL = 1e-3
"""The share of what all moves at once are by which stencils from differences may be off."""


def lattice_system(
    scene: Scene,
    state: State,
    step: int,
    watch: Watch,
    moves: Moves | None = None,
    rows: Rows = ALL,
) -> LatticeSystem | None:
    """The system of a scene, by the moves of its followers where these are compiled and the state
    is not at rest; None where it has no such form, or leaders do not hold the body. A scene of
    which each process has some `rows` has it at rest, without such moves."""
    if moves and moves.is_compiled and state.u.any():
        matrix = differenced_matrix(scene, state, step, moves)
        alike = DIFFERENCED
    else:
        matrix, alike, moves = stencil_matrix(scene, state, step, rows), EXACT, None
    if matrix is None:
        return None
    matrix = matrix.within(rows.known)
    held = held_components(scene, step, rows)
    if leads_one_way(matrix, rows) or not is_held(matrix, held, rows):
        return None
    known = balanced(constrained(matrix, held), alike, rows)
    try:
        # What frame points show of leaders is not among the stencils.
        system = LatticeSystem(*known, state.u.shape, watch, not (moves or scene.frame), rows)
    except FloatingError:
        return None
    if not system.may_be_stable:
        if state.u.any():
            raise IndefiniteError
        return None
    if moves:
        put = random_displacements(scene, NUDGE * scene.neighbourhood.nudge_unit)
        there = replace(state, u=state.u + put)
        if not system.mismatch(put, moves.at(state, step), moves.at(there, step)) <= FAITHFUL:
            return None
    return system
