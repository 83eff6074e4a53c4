"""Cases 4 and 13 to 17 of the stability page: what grows, what never decays and what
does not drift, known before the first step and seen in the run."""

import json
from typing import ClassVar, Literal

import numpy as np
import pytest
from property_cases import (
    BOTH_ENDS_HELD,
    HOLD_LEFT,
    advanced,
    experiment,
    pull_right,
    scene_of,
    step_map,
)

import pbdkit


class CurrentY(pbdkit.FollowerRule):
    """Mixed coordinates as one may misread them: da is taken from where the particle now stands."""

    type: Literal["current-y"] = "current-y"
    K: float
    uses_reference: ClassVar[bool] = True

    def parameters(self, setting):
        return {"K": self.K, "middle": (setting.lower.y + setting.upper.y) / 2}

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        move = total[0] / total[1]
        above = here.X.y + here.u.y - p.middle
        return pbdkit.plugin.Vector(move.x, move.y + p.K * (here.u.x + move.x) * above)


def test_case_4_divergence_of_current_y_in_mixed_coordinates_is_predicted():
    pull = {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [2.0, 0.0]}}
    stretched = {"type": "affine", "gradient": [[2 / 7, 0.0], [0.0, 0.0]]}
    parts = {"leaders": [HOLD_LEFT, pull], "initial": stretched, "steps": 1000}
    ours = experiment(8, 6, rule={"type": "mixed-coordinate", "K": -0.5}, **parts)
    naive = experiment(8, 6, rule={"type": "current-y", "K": -0.5}, **parts)
    # x moves y and y does not move x: the spectrum is that of both alone. x averages,
    radius = (1 + np.cos(np.pi / 7)) / 2
    assert pbdkit.analyse(ours).spectral_radius == pytest.approx(radius, abs=1e-12)
    # and y averages and adds K u_x, in the columns 1 to 6, of which u_x = 2i/7.
    columns = np.diag(-0.5 * 2 * np.arange(1, 7) / 7) + (np.eye(6, k=1) + np.eye(6, k=-1)) / 4
    least = np.linalg.eigvalsh(columns)[0] + np.cos(5 * np.pi / 6) / 2
    known = pbdkit.analyse(naive, components=[CurrentY])
    assert known.smallest_eigenvalue == pytest.approx(least, abs=1e-12)
    assert known.spectral_radius == pytest.approx(-least, abs=1e-12)
    (warning,) = known.warnings()
    assert f"it is stable below {2 / (1 - least):.4g}" in warning
    with pytest.warns(pbdkit.PbdkitWarning, match="inverted cells"):
        assert pbdkit.run(ours, progress=False).status == "complete"
    with pytest.raises(pbdkit.DivergedError, match="'current-y'"):
        pbdkit.run(naive, components=[CurrentY], progress=False)


class Periodic(pbdkit.FramePolicy):
    """Frame points follow the body particle one period on."""

    type: Literal["periodic"] = "periodic"

    def depth(self, reach):
        return reach

    def images(self, site, low, high):
        return low + (site - low) % (high - low + 1)

    def follow(self, frame):
        low, high = np.array(frame.low), np.array(frame.high)
        body = frame.body_at(self.images(frame.site, low, high).astype(np.int32))
        return pbdkit.plugin.FrameMap(np.arange(len(body)), body, np.ones(len(body)))


class Even(Periodic):
    """Frame points follow the body particle reflected in the outermost row, component by
    component."""

    type: Literal["even"] = "even"

    def images(self, site, low, high):
        return high - np.abs(high - (low + np.abs(site - low)))


@pytest.mark.parametrize("frame", ["periodic", "even"])
@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_case_13_the_undamped_mode_decays_at_relaxation_below_1(frame):
    parts = {"frame": {"type": frame}, "initial": {"type": "noise", "amplitude": 0.1}}
    given = experiment(6, 4, **parts, steps=600)
    known = pbdkit.analyse(given, components=[Periodic, Even])
    assert known.smallest_eigenvalue == pytest.approx(-1.0, abs=1e-12)
    assert (
        "changes its sign in every step never decays; use a relaxation below 1"
        in (known.warnings()[-1])
    )
    ds = pbdkit.run(given, components=[Periodic, Even], progress=False)
    u = ds.u.values[:, ds.kind[0] != 2]
    last = np.abs(u[-1] - u[-2]).max()
    # The remainder is the chequerboard, by its own invariant: the mean of (-1)^(i+j) u.
    sign = (-1.0) ** ds.site.values[ds.kind[0] != 2].sum(axis=1)
    weight = pbdkit.analyse(given, components=[Periodic, Even]).operator.current.toarray()[::2, ::2]
    values, vectors = np.linalg.eig(weight.T)
    left = vectors[:, np.argmin(values.real)].real
    share = left @ u[0] / (left @ sign)
    assert last == pytest.approx(2 * np.abs(share).max(), abs=1e-12)
    relaxed = given | {"solver": {"type": "stepping", "relaxation": 0.9}}
    u = pbdkit.run(relaxed, components=[Periodic, Even], progress=False).u.values
    assert np.abs(u[-1] - u[-2]).max() < 1e-12
    assert pbdkit.analyse(relaxed, components=[Periodic, Even]).stable


def test_case_13_the_mirror_frame_has_no_undamped_mode():
    known = pbdkit.analyse(experiment(6, 6, frame={"type": "mirror"}))
    assert known.smallest_eigenvalue == pytest.approx(-(1 + np.cos(np.pi / 5)) / 2, abs=1e-12)


def test_case_14_leaders_all_round_give_a_symmetric_spectrum_and_converge():
    edges = [{"select": {"edge": e}, "motion": {"type": "hold"}} for e in ("bottom", "top")]
    scene = scene_of(7, 6, leaders=[*BOTH_ENDS_HELD, *edges])
    values = np.linalg.eigvalsh(step_map(scene))
    np.testing.assert_allclose(values, -values[::-1], rtol=0, atol=1e-14)
    assert values[-1] == pytest.approx((np.cos(np.pi / 6) + np.cos(np.pi / 5)) / 2, abs=1e-14)
    start = np.zeros((42, 2))
    start[15] = 1.0
    assert np.abs(advanced(scene, start, 400)[-1]).max() < 1e-12


def test_case_15_the_distance_weighted_rule_runs_as_printed_with_the_warning():
    parts = {"rule": "distance-weighted", "leaders": [HOLD_LEFT, pull_right(0.35, 0.0, 10)]}
    quiet = experiment(10, 10, **parts, steps=200)
    noisy = quiet | {"initial": {"type": "noise", "amplitude": 1e-6}}

    def departure(relaxation):
        solver = {"solver": {"type": "stepping", "relaxation": relaxation}}
        runs = [pbdkit.run(e | solver, progress=False) for e in (quiet, noisy)]
        said = json.loads(runs[1].prediction)
        return np.abs(runs[1].u - runs[0].u).max(("particle", "axis")).values, said

    with pytest.warns(pbdkit.PbdkitWarning) as warned:
        broken_up, said = departure(1.0)
    texts = [str(warning.message) for warning in warned]
    assert sum("can diverge" in text for text in texts) == 2
    assert any("inverted cells" in text for text in texts)
    assert broken_up[1] < 2e-6
    assert broken_up[50] > 1.0
    assert said == {
        "stable": False,
        "largest_stable_relaxation": pytest.approx(2 / 3),
        "smallest_eigenvalue": pytest.approx(-2.0),
    }
    settled, said = departure(0.6)
    assert settled.max() <= 1e-6
    assert settled[-1] < 1e-8
    assert said["stable"]


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize(
    ("solver", "waves", "exact"),
    [
        ({"relaxation": 1.1}, "it is stable below 1", "it is stable below 1.062"),
        ({"memory": 1.1}, "keep |memory| below 1", "keep |memory| below 1"),
        ({"relaxation": 1.6, "memory": 0.5}, "it is stable below 1.5", "it is stable below 1.593"),
    ],
    ids=["relaxation", "memory", "both"],
)
def test_case_16_divergence_is_predicted_stopped_and_leaves_the_last_state(
    solver, waves, exact, engine, call, tmp_path, interpreted
):
    sparse = experiment(8, 6, leaders=[HOLD_LEFT, pull_right(0.1, 0.0)], steps=3000)
    sparse |= {"solver": {"type": "stepping", "engine": engine} | solver}
    sparse |= {"initial": {"type": "noise", "amplitude": 0.05}, "record": {"every": 3000}}
    (tmp_path / "sparse.json").write_text(json.dumps(sparse))
    checked = call("check", str(tmp_path / "sparse.json"))
    assert checked.code == 0
    assert "NO, some modes grow" in checked.out
    assert checked.out.endswith(f"{exact}\n")
    result = call("run", str(tmp_path / "sparse.json"), "-o", "sparse.nc")
    assert result.code == 4
    warning, end = result.err.splitlines()
    assert warning.startswith("warning: solver.relaxation: ")
    assert warning.endswith(waves)
    with pbdkit.open("sparse.nc") as ds:
        assert ds.sizes["time"] == 2
        assert ds.status == "diverged"
        assert all(np.isfinite(ds[name]).all() for name in ("position", "u"))
        # The body is 7 wide, a spacing, its leaders go .5, and the noise.
        assert 1.0 < np.abs(ds.u[-1]).max() <= 8.55
        assert f"the last recorded state is step {int(ds.time[-1])}, the last in which" in end


def test_case_16_momentum_1_oscillates_without_growth():
    """Every mode has |μ| = 1 there; what grows begins above."""
    given = experiment(8, 6, leaders=[HOLD_LEFT, pull_right(0.1, 0.0)], steps=1200)
    given |= {"solver": {"type": "stepping", "memory": 1.0}}
    known = pbdkit.analyse(given)
    assert known.stable
    assert known.spectral_radius == pytest.approx(1.0, abs=1e-12)
    u = pbdkit.run(given, progress=False).u.values
    swings = np.abs(u[1:] - u[:-1]).max(axis=(1, 2))
    assert swings[700:].max() == pytest.approx(swings[10:510].max(), rel=0.2)


@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_case_17_without_a_leader_the_frame_does_not_drift_in_1e5_steps():
    parts = {"lattice": "hexagonal", "frame": "first", "neighbours": "chebyshev-1"}
    start = {"initial": {"type": "noise", "amplitude": 0.3}, "record": {"at": [0, 1000, 100000]}}
    solver = {"type": "stepping", "engine": "compiled"}
    given = experiment(4, 3, **parts, **start, solver=solver, steps=100000)
    ds = pbdkit.run(given, progress=False)
    u = ds.u.values[:, ds.kind[0] != 2]
    step = pbdkit.analyse(given).operator.current.toarray()[::2, ::2]
    values, vectors = np.linalg.eig(step.T)
    weight = vectors[:, np.argmax(values.real)].real
    invariant = weight @ u[0] / weight.sum()
    np.testing.assert_allclose(u[1], np.tile(invariant, (12, 1)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(u[2], u[1], rtol=0, atol=1e-14)
    # The plain mean is no invariant of this frame: it drifts.
    assert np.abs(u[2].mean(axis=0) - u[0].mean(axis=0)).max() > 1e-3
