"""Linear systems of bodies in contact with obstacles."""

from dataclasses import replace

import numpy as np
import pytest

import pbdkit
from pbdkit.equilibrium.contact_system import ContactSystem
from pbdkit.equilibrium.system import Moves, NoEquilibriumError, random_displacements
from pbdkit.linear.block_matrix import DENSE
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state
from tests.equilibrium.test_multigrid import sheet

FAR = {"shape": {"half_plane": {"point": [0.0, -5.0], "normal": [0.0, 1.0]}}}


def system_at_rest(given):
    """Return the linear system of a body that does not reach the obstacle, its state and its
    moves."""
    scene = build_scene(pbdkit.Experiment(**given, obstacles=[FAR]))
    state, moves = initial_state(scene), Moves(scene)
    return ContactSystem(scene, state, 1, "auto", Watch(), moves), state, moves, scene


def test_a_loose_body_moves_in_the_direction_of_its_load_as_a_whole():
    """The largest component of the displacement is the longest move. Strains are smaller by the
    stiffness of the weak springs."""
    load = {"select": {"box": [-1.0, -1.0, 40.0, 40.0]}, "force": [0.003, -0.004]}
    system, state, moves, scene = system_at_rest(sheet(20, 14, leaders=[], loads=[load]))
    residual = moves.at(state, 1)
    assert np.count_nonzero(residual) > DENSE
    rounding = moves.rounding(state.u)
    assert system.is_loose(residual, rounding)
    with pytest.raises(NoEquilibriumError, match="there is no unique equilibrium"):
        system.refuse_moving_floats(residual, rounding)
    system.refuse_moving_floats(0.0 * residual, rounding)
    u = scene.raster.table(system.solve_loose(residual, 0.8))
    np.testing.assert_allclose(u, np.broadcast_to([0.6, -0.8], u.shape), atol=1e-3)


def test_solutions_without_contact_have_the_moves_of_the_scene():
    """The body has too many unknowns for an inverse matrix."""
    system, state, moves, scene = system_at_rest(sheet(20, 14))
    exact = random_displacements(scene, 1.0)
    assert np.count_nonzero(exact) > DENSE
    still, moved = (moves.at(replace(state, u=u), 1) for u in (0.0 * exact, exact))
    np.testing.assert_allclose(system.solve(still - moved, 1e-9), exact, atol=1e-9)
