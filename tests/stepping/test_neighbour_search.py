"""The neighbours that are searched in every step, in a body at rest."""

import numpy as np
import pytest

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.neighbour_search import NeighbourSearch


def near(kind, radius):
    return build_scene(
        pbdkit.Experiment(
            name="near",
            lattice={"type": kind, "a": 1.0},
            body={"type": "disc", "radius": 3.3, "centre": [0.1, 0.2]},
            rule={"type": "barycentre"},
            neighbours={"type": "euclidean", "radius": radius, "reevaluate": True},
            frame={"type": "none"},
            steps=1,
        )
    )


@pytest.mark.parametrize(("kind", "radius"), [("square", 1.5), ("hexagonal", 1.8)])
def test_at_rest_the_neighbours_are_those_of_the_slots_in_their_order(kind, radius):
    scene = near(kind, radius)
    raster = scene.raster
    search = NeighbourSearch(scene)
    j, k, rest = search.pairs(np.zeros((2, *raster.kind.shape)))
    X = raster.reference(np.arange(raster.count))
    number = {tuple(np.round(x, 6)): n for n, x in enumerate(X.tolist())}
    sublattice = raster.cells_of(np.arange(raster.count))[0]
    expected = [
        (n, other, *slot.rest)
        for n in search.body.tolist()
        for slot in scene.neighbourhood.slots[sublattice[n]]
        if (other := number.get(tuple(np.round(X[n] + np.array(slot.rest), 6)))) is not None
    ]
    assert list(zip(j.tolist(), k.tolist(), *rest.tolist(), strict=True)) == expected
    assert len(expected) > 8 * 10


@pytest.mark.parametrize(("kind", "radius"), [("square", 1.5), ("hexagonal", 1.8)])
def test_in_a_deformed_body_the_neighbours_are_all_particles_within_the_radius(kind, radius):
    scene = near(kind, radius)
    raster = scene.raster
    u = np.random.default_rng(0).uniform(-0.6, 0.6, (2, *raster.kind.shape))
    rows = np.arange(raster.count)
    x = raster.reference(rows) + raster.table(u)
    distance = np.linalg.norm(x[:, None] - x[None], axis=2)
    is_near = (distance <= radius) & ~np.eye(len(x), dtype=bool)
    j, k, _ = NeighbourSearch(scene).pairs(u)
    assert {*zip(j.tolist(), k.tolist(), strict=True)} == {
        *map(tuple, np.argwhere(is_near).tolist())
    }
    assert len(j) == is_near.sum()
