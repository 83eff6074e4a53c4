"""Frame points and the body particles that are nearest to them."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import pbdkit
from pbdkit.scene.frame import sites_of_frame
from pbdkit.scene.scene import build_scene


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_each_frame_point_is_paired_once_with_every_nearest_particle(lattice):
    scene = build_scene(
        pbdkit.Experiment(
            name="frame",
            lattice={"type": lattice, "a": 1.0},
            body={"type": "grid", "columns": 5, "rows": 4},
            frame={"type": "mean", "layers": 3},
            rule={"type": "barycentre"},
            leaders=[],
            steps=1,
        )
    )
    raster = scene.raster
    frame = sites_of_frame(raster, scene.experiment.rule)
    points, body = raster.reference(frame.frame_rows), raster.reference(raster.body_rows)
    distance = cdist(points, body)
    point, particle = np.nonzero(distance < distance.min(axis=1, keepdims=True) + 1e-6)
    np.testing.assert_array_equal(frame.nearest(), (point, raster.body_rows[particle]))
