"""The fitted body is an experiment and a dataset like any other."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fitting.test_fit import NOISE, measured, plate

import pbdkit
from pbdkit.fitting.observations import Interpolation
from pbdkit.scene.scene import build_scene

UNITS = {"units": {"length": "0.5 mm"}}


@pytest.mark.parametrize("more", [{}, UNITS, {"solver": {"type": "stepping"}}])
def test_fitted_experiment_has_the_equilibrium_of_the_fit(more, tmp_path):
    path = tmp_path / "field.csv"
    generator = np.random.default_rng(2)
    made = plate(noise=NOISE, generator=generator, lattice={"type": "square", "a": 2.0}) | more
    measured(made | {"solver": {"type": "equilibrium"}}, path, noise=NOISE, generator=generator)
    found = pbdkit.fit(
        {
            "experiment": made,
            "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
            "measured": {"file": str(path), "noise": NOISE, "distortion": {"ux": [[2, 0]]}},
        }
    )
    again = pbdkit.Experiment(**json.loads(json.dumps(found.experiment.model_dump(mode="json"))))
    assert again == found.experiment
    assert again.rule.poisson_ratio == found.values["rule.poisson_ratio"].value
    state = found.solution.at.predictions[0].resting_scene.state.u
    scene, ds = build_scene(again), found.dataset
    rows, u = scene.raster.body_rows, (ds.position - ds.reference).isel(time=-1).values
    expected = state.reshape(2, -1)[:, scene.raster.place_of(rows)].T
    np.testing.assert_allclose(u, expected, atol=1e-12)
    field, planes = found.field(), np.zeros_like(state)
    planes.reshape(2, -1)[:, scene.raster.place_of(rows)] = u.T
    at_points = Interpolation.at(scene, field.points).of(planes, scene)
    np.testing.assert_allclose(at_points, field.measured - field.residual, atol=1e-12)
    assert ds.attrs["status"] == "complete"
    rerun = pbdkit.rerun(ds, progress=False)
    assert rerun.position.identical(ds.position)
