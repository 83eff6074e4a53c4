"""The paper's cases as shipped, with the statements of model.md, section 10, and their datasets."""

import numpy as np
import pytest
from paper_cases import FOLLOWER, FRAME, LEADER, moved, run, track_x


@pytest.mark.parametrize(
    ("case", "number", "column", "row"),
    [("a", 67, 5, 6), ("d1", 103, 8, 6), ("f1", 133, 8, 5), ("g", 133, 8, 5)],
)
def test_particle_numbers_of_the_paper_select_its_particles(case, number, column, row):
    # Section 1: column and row of the body, from 1.
    assert run(case).site.sel(particle=number).values.tolist() == [column - 1, row - 1]


def test_a_pe1_of_67_rises_to_step_24_and_then_falls():
    pe1 = run("a").pe1.sel(particle=67).values
    assert int(pe1.argmax()) == 24
    assert (np.diff(pe1[4:25]) > 0).all()
    assert (np.diff(pe1[24:]) < 0).all()


def test_a_rows_move_identically():
    u = moved("a").values.reshape(401, 12, 12, 2)
    assert not u[..., 1].any()
    assert np.array_equal(u[..., 0], np.broadcast_to(u[:, :, :1, 0], (401, 12, 12)))


def test_a_67_pulled_after_a_delay_recovers_partly_without_oscillation():
    x = track_x("a", 67)
    # Column 5 is 5 layers from the leaders in column 10.
    assert not x[:5].any()
    assert x[5] > 0
    top = int(x.argmax())
    assert (np.diff(x[4 : top + 1]) > 0).all()
    assert (np.diff(x[top:]) < 0).all()
    assert x[400] > 0.01


def test_a_maximum_pe1_during_the_pull_is_near_the_leaders():
    ds = run("a")
    at_10 = ds.pe1.sel(time=10).where(ds.kind.sel(time=10) == FOLLOWER)
    assert ds.site[int(at_10.argmax("particle")), 0] == 8


def test_a_text_is_a_at_its_speed():
    # The rule is linear: every displacement scales by 1.2/.35, up to rounding of sums of ~10.
    scaled = moved("a").values * (1.2 / 0.35)
    np.testing.assert_allclose(moved("a-text").values, scaled, rtol=0, atol=1e-13)


def test_b_contracts_transversely_with_a_relaxation_time():
    y = moved("b").sel(particle=67, axis="y").values
    assert y[100] == pytest.approx(-0.075, abs=5e-4)
    assert not y[:5].any()
    assert (np.diff(y[6:]) < 0).all()


def test_c_contracts_more_than_b_until_about_step_50_and_less_after():
    b, c = (contraction_at(case, 4, 5) for case in ("b", "c"))
    more = np.flatnonzero(c > b)
    assert more.max() == pytest.approx(50, abs=2)
    assert (c[10:48] > b[10:48]).all()
    assert (c[52:] < b[52:]).all()


def contraction_at(case, i, j):
    """-u_y of the particle at a site, (time,)."""
    here = (run(case).site.values == (i, j)).all(axis=1)
    return -moved(case).values[:, here, 1].squeeze()


@pytest.mark.parametrize("case", ["d1", "d2"])
def test_d_detaches_a_column_and_103_returns_without_rebound(case):
    x = track_x(case, 103)
    assert (np.diff(x[x.argmax() :]) < 0).all()
    assert (run(case).broken_step > 0).any()


def test_e_far_particles_move_late():
    ds, size = run("e"), np.linalg.norm(moved("e").values, axis=2)
    rim = (np.isin(ds.site, (0, 9)).any(axis=1)) & (ds.kind[0] != FRAME).values
    lead = (ds.kind[0] == LEADER).values
    assert lead.sum() == 4
    share = size[:, rim].max(axis=1)[1:] / size[:, lead].max(axis=1)[1:]
    assert not share[:3].any()
    assert share[8 - 1] == pytest.approx(0.008, abs=5e-4)
    assert share[400 - 1] == pytest.approx(0.26, abs=5e-3)


def test_f_133_rebounds_with_one_shell_and_not_with_two():
    one, two = track_x("f1", 133), track_x("f2", 133)
    top = int(one[:20].argmax())
    bottom = top + int(one[top:50].argmin())
    assert one[bottom] < one[top] - 0.1
    assert one[400] > one[bottom] + 1.0
    assert (np.diff(one[bottom:]) > 0).all()
    assert (np.diff(two[two.argmax() :]) < 0).all()


@pytest.mark.parametrize(("case", "expected"), [("f1", 2), ("f2", 2), ("g", 0)])
def test_two_frame_points_remain_under_a_mean_frame_and_none_under_first(case, expected):
    ds = run(case)
    x = ds.position.sel(time=400, axis="x").values
    body, torn = (ds.kind[0] != FRAME).values, ds.site[:, 0].values == 9
    low, high = x[body & ~torn].max(), x[body & torn].min()
    assert high - low > 7
    # In the gap: further than 1.5 lattice units from either side of it.
    frame = x[~body]
    assert ((frame > low + 1.5) & (frame < high - 1.5)).sum() == expected


def test_f2_has_no_second_fracture_near_step_100():
    assert run("f2").broken_step.max() < 20


def test_g_returns_close_to_the_start():
    ds = run("g")
    stays = ((ds.kind[0] != FRAME) & (ds.site[:, 0] < 9)).values
    assert np.abs(moved("g").values[400][stays]).max() < 0.01
    assert np.abs(moved("f2").values[400][stays]).max() > 0.5
