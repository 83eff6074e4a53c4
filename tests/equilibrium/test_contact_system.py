"""Linear systems of bodies in contact with obstacles."""

import numpy as np

import pbdkit
from pbdkit.equilibrium.contact_system import ContactSystem
from pbdkit.equilibrium.system import Moves
from pbdkit.linear.block_matrix import DENSE
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state
from tests.equilibrium.test_multigrid import sheet


def test_a_loose_body_moves_in_the_direction_of_its_load_as_a_whole():
    """The largest component of the displacement is the longest move. Strains are smaller by the
    stiffness of the weak springs."""
    load = {"select": {"box": [-1.0, -1.0, 40.0, 40.0]}, "force": [0.003, -0.004]}
    floor = {"shape": {"half_plane": {"point": [0.0, -5.0], "normal": [0.0, 1.0]}}}
    given = sheet(20, 14, leaders=[], loads=[load], obstacles=[floor])
    scene = build_scene(pbdkit.Experiment(**given))
    state, moves = initial_state(scene), Moves(scene)
    system = ContactSystem(scene, state, 1, "auto", Watch(), moves)
    residual = moves.at(state, 1)
    assert np.count_nonzero(residual) > DENSE
    assert system.is_loose(residual, moves.rounding(state.u))
    u = scene.raster.table(system.solve_loose(residual, 0.8))
    np.testing.assert_allclose(u, np.broadcast_to([0.6, -0.8], u.shape), atol=1e-3)
