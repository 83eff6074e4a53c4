"""Cases 5 to 9, 11, 20, 21 and 24 of the table in validation/stability.md: bodies that do not hang
together, and what is refused, on input or with step and particle."""

import json
from typing import Literal

import numpy as np
import pytest
from property_cases import (
    HOLD_LEFT,
    LATTICES,
    advanced,
    displace,
    displacements,
    experiment,
    pull_right,
    scene_of,
)

import pbdkit


def test_case_5_collinear_neighbours_give_a_warning():
    oblique = {"type": "oblique", "a": 1.0, "b": 1.0, "angle": 5.0}
    (warning,) = scene_of(lattice=oblique, neighbours="coordination-1").warnings
    assert "all lie along one line" in warning
    assert "chebyshev" in warning
    assert not scene_of(lattice=oblique, neighbours="chebyshev-1").warnings


@pytest.mark.filterwarnings("ignore:neighbours. all lie along one line")
@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_case_6_components_without_leader_are_named_and_stay():
    flat = {"type": "rectangular", "a": 1.0, "b": 2.5}
    scene = scene_of(lattice=flat)
    assert "rows are not coupled" in scene.warnings[0]
    one = int(scene.raster.body_rows[0]) + 1
    parts = {"lattice": flat, "leaders": [displace([one], 1.0, 0.5)]}
    u = displacements(**parts, steps=50)[-1]
    row = scene.raster.site_table()[:, 1]
    assert not u[row >= 1].any()
    assert u[row == 0].any(axis=1).all()
    (warning,) = pbdkit.analyse(experiment(**parts)).warnings()
    assert "4 parts of the body are not constrained by any" in warning
    two_rows = experiment(6, 2, lattice=flat, leaders=[displace([10], 1.0, 0.5)])
    (warning,) = pbdkit.analyse(two_rows).warnings()
    assert "a part of 6 particles (with number 7) is not constrained by any" in warning


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.filterwarnings("ignore:neighbours. all lie along one line")
@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_case_7_a_single_follower_in_its_frame_stays(lattice):
    start = np.array([[0.3, -0.2]])
    u = advanced(scene_of(1, 1, lattice=lattice), start, 50)
    # Its frame stands as it does: only rounding of the mean of equal numbers can move it.
    np.testing.assert_allclose(u[-1], start, rtol=0, atol=1e-14)
    assert not displacements(1, 1, lattice=lattice, steps=50).any()


def test_case_8_contradictory_leaders_are_refused_with_particle_and_groups():
    up = {"type": "velocity", "velocity": [0.0, 0.1], "steps": 3}
    leaders = [HOLD_LEFT, {"select": {"edge": "bottom"}, "motion": up}]
    message = r"leaders.1: moves particle 9 in step 1 differently from leaders.0"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(experiment(leaders=leaders), progress=False)


@pytest.mark.parametrize("frame", ["mean", {"type": "none"}], ids=["mean", "none"])
def test_case_9_coincident_particles_stay_under_distance_weights(frame):
    scene = scene_of(5, 4, rule="distance-weighted", frame=frame)
    at_origin = -scene.raster.reference(scene.raster.body_rows)
    if frame == "mean":
        # The frame copies displacements and is not at the origin: consider
        # particles without it as a neighbour.
        inside = ((scene.raster.site_of(scene.raster.body_rows) % (4, 3)) != 0).all(axis=1)
    else:
        inside = np.ones(20, bool)
    u = advanced(scene, at_origin, 20)
    assert np.isfinite(u).all()
    assert np.array_equal(u[1][inside], at_origin[inside])
    if frame != "mean":
        assert np.array_equal(u[-1], at_origin)


def test_case_9_distance_mean_of_coincident_particles_spreads_by_layers():
    """Σ|d| x / Σ|d| is 0 / 0 where all neighbours coincide: 1, 5, 13, 25 particles."""
    x = np.indices((15, 15)).astype(float)
    x[:, 6:9, 6:9] = 7.0
    for k in range(1, 5):
        near = [np.roll(x, step, axis) for step in (1, -1) for axis in (1, 2)]
        weights = [np.hypot(*(other - x)) for other in near]
        with np.errstate(invalid="ignore"):
            x = sum(w * other for w, other in zip(weights, near, strict=True)) / sum(weights)
        assert np.isnan(x[0]).sum() == 2 * k * (k - 1) + 1


def test_case_11_a_threshold_below_the_rest_distance_is_refused():
    given = experiment(fracture={"type": "threshold", "thresholds": [0.9]})
    message = "thresholds.0: 0.9 is below the rest length 1 of shell 1: every bond would break"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(given, progress=False)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("motion", "field"),
    [
        ({"type": "velocity", "velocity": ["bad", 0.0], "steps": 3}, "velocity.0"),
        ({"type": "displace", "displacement": [0.0, "bad"]}, "displacement.1"),
        ({"type": "path", "steps": [2], "displacements": [["bad", 0.0]]}, "displacements.0.0"),
        ({"type": "rotation", "centre": [0.0, 0.0], "angle": "bad", "steps": 3}, "angle"),
        ({"type": "oscillation", "amplitude": ["bad", 0.0], "period": 9.0}, "amplitude.0"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_case_20_a_motion_that_is_not_finite_is_refused_on_input(motion, field, bad):
    text = json.dumps(motion).replace('"bad"', json.dumps(float(bad)))
    leaders = [{"select": {"edge": "right"}, "motion": json.loads(text)}]
    message = rf"leaders.0.motion.{field}: should be a finite number, got {bad}"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(experiment(leaders=leaders), progress=False)


def test_case_20_a_motion_that_becomes_infinite_is_refused_on_input(recwarn):
    leaders = [pull_right(1e308, 0.0, steps=9)]
    with pytest.raises(
        pbdkit.ExperimentError, match="the displacement at step 9 of the motion is not finite"
    ):
        pbdkit.run(experiment(leaders=leaders), progress=False)
    assert not recwarn.list


class Loose(pbdkit.FramePolicy):
    """Leaves the last frame point to itself."""

    type: Literal["loose"] = "loose"

    def depth(self, reach):
        return reach

    def follow(self, frame):
        point, body = frame.nearest()
        kept = point < point[-1]
        return pbdkit.plugin.FrameMap(point[kept], body[kept], np.ones(kept.sum()))


def test_case_21_a_frame_point_without_a_particle_is_refused():
    given = experiment(frame={"type": "loose"})
    message = "'loose' maps frame point 56 to no particle of the body, so that the point would be"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(given, components=[Loose], progress=False)


def test_case_21_a_fixed_frame_point_anchors_the_body():
    """A 6 x 5 sheet pulled by 1 naively, one frame point above its middle left at rest."""
    u, affine = np.zeros((6, 7)), np.arange(6)[:, None] / 5
    u[-1] = 1.0
    for _ in range(1000):
        u[:, 0], u[:, -1] = u[:, 1], u[:, -2]
        u[3, -1] = 0.0
        u[1:-1, 1:-1] = (u[2:, 1:-1] + u[:-2, 1:-1] + u[1:-1, 2:] + u[1:-1, :-2]) / 4
    assert np.abs(u[:, 1:-1] - affine).max() == pytest.approx(0.2306, abs=1e-4)


def test_case_24_a_diagnostic_overflow_is_an_error_with_step_and_particle():
    leaders = [displace([9], 1e200, 0.0)]
    given = experiment(leaders=leaders, diagnostics=[{"type": "pe1"}], steps=3)
    with pytest.raises(pbdkit.DivergedError, match=r"particle \d+ at step 1") as caught:
        pbdkit.run(given, progress=False)
    kept = caught.value.dataset
    assert np.array_equal(np.isfinite(kept.pe1), kept.kind != 2)
    assert kept.status == "diverged"
    # The displacements themselves are numbers: without the square the run goes through.
    with pytest.warns(pbdkit.PbdkitWarning, match=r"particle 9, has -4.22e\+199 times its area"):
        ds = pbdkit.run(experiment(leaders=leaders, steps=3), progress=False)
    assert float(np.abs(ds.u).max()) == 1e200
