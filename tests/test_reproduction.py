"""docs/reproduction.md: whole, and its most important numbers of variants, measured anew."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.experiment.shipped import shipped_names

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "reproduction.md").read_text("utf-8")
OTHER = (DOCS / "anisotropy-and-plasticity.md").read_text("utf-8")
FRAME = 2
CASES = {"a": 15, "b": 5, "c": 5, "d": 9, "e": 3, "f": 11, "g": 4}
"""At least so many claims a case."""
VERDICT = re.compile(r"^(comes out|comes out only with \S.*|does not come out)$")
NAMED = sorted(set(re.findall(r"paper/[a-z0-9-]+", PAGE + OTHER)))


def rows(text):
    """The claims of a section: quote, measured, verdict."""
    lines = [line for line in text.splitlines() if line.startswith("| “")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def section(case):
    return re.search(rf"^## Case {case}: .*?(?=^## )", PAGE, re.M | re.S).group()


@pytest.mark.parametrize("case", CASES)
def test_every_claim_has_numbers_and_one_of_three_verdicts(case):
    claims = rows(section(case))
    assert len(claims) >= CASES[case]
    for quote, measured, verdict in claims:
        assert quote.startswith("“")
        assert measured
        assert VERDICT.match(verdict.strip("*")), verdict


def test_the_page_counts_its_claims():
    verdicts = [row[2].strip("*") for row in rows(PAGE)]
    out, fails = verdicts.count("comes out"), verdicts.count("does not come out")
    total, *counts = map(
        int, re.search(r"Of (\d+) claims (\d+) .* (\d+) .* (\d+) do", PAGE).groups()
    )
    assert (total, counts) == (len(verdicts), [out, total - out - fails, fails])


def test_pictures_exist_are_small_and_all_are_shown():
    shown = re.findall(r"\((pictures/reproduction/[^)]+)\)", PAGE + OTHER)
    assert {DOCS / name for name in shown} == set((DOCS / "pictures/reproduction").iterdir())
    assert all((DOCS / name).stat().st_size <= 150_000 for name in shown)


@pytest.mark.parametrize("name", NAMED)
def test_experiments_named_on_the_page_are_shipped_and_run(name):
    assert name in shipped_names()
    experiment = pbdkit.load(name, settings=["steps=12", "record={every: 12}"])
    assert pbdkit.run(experiment, progress=False).attrs["status"] == "complete"


@cache
def run(name, *settings):
    return pbdkit.run(pbdkit.load(name, settings=list(settings)), progress=False)


def body_u(name, *settings):
    """Displacements of a 10 by 10 body, (time, column, row, axis)."""
    ds = run(name, *settings)
    u = (ds.position - ds.reference).transpose("time", "particle", "axis").values
    return u[:, (ds.kind[0] != FRAME).values].reshape(len(u), 10, 10, 2)


def low_after_top(x):
    """The first step at which a series turns from falling to rising, or None."""
    change = np.diff(x)
    lows = np.flatnonzero((change[:-1] < -1e-9) & (change[1:] > 1e-9)) + 1
    return int(lows[0]) if len(lows) else None


@pytest.mark.parametrize(("name", "spread"), [("paper/a-lag", 0.134), ("paper/a-chebyshev", 0.061)])
def test_convexity_comes_with_a_late_frame_or_eight_neighbours(name, spread):
    x = body_u(name)[..., 0]
    assert np.ptp(x, axis=2).max() == pytest.approx(spread, abs=1e-3)
    assert x[9, 8, 0] < x[9, 8, 5]


def test_without_a_frame_the_sheet_collapses():
    ds = run("paper/a-no-frame", "leaders=[]")
    assert np.ptp(ds.position.values[-1], axis=0).max() < 1e-3


def test_frame_rows_part_first_with_lag_in_windows_of_the_threshold():
    def steps(*settings):
        ds = run("paper/d1-lag", "steps=12", *settings)
        return ds.broken_step.values[ds.broken_step.values > 0]

    assert sorted(steps()) == [6, 6] + [7] * 8
    assert set(steps("fracture.thresholds=[6.0]")) == {7}


def test_103_rebounds_for_good_only_where_frame_bonds_hold():
    x = body_u("paper/d2-frame-bonds")[:, 7, 5, 0]
    low = low_after_top(x)
    assert (low, x[low]) == (30, pytest.approx(1.965, abs=1e-3))
    assert x[400] == pytest.approx(2.564, abs=1e-3)
    dip = body_u("paper/d2-chebyshev")[:, 7, 5, 0]
    assert low_after_top(dip) == 5
    assert dip[[4, 5, 8]] == pytest.approx([1.278, 1.147, 1.901], abs=1e-3)
    assert abs(dip[400]) < 1e-4


def test_second_fractures_of_f2_come_at_certain_thresholds():
    assert run("paper/f2-second-fracture").broken_step.max() == 116
    assert run("paper/f2-cusp").broken_step.max() == 108
    assert np.linalg.norm(body_u("paper/f2-early")[-1, :9], axis=-1).max() < 0.01


def test_a_right_angle_is_not_followed():
    x = run("paper/a-rotation").pe1.values[-1]
    assert x.max() > 1


@pytest.mark.parametrize("placement", [0.8, 1.2])
def test_a_strain_of_lambda_less_one_stays(placement):
    x = body_u("paper/d1", f"fracture.placement={placement}", "steps=1500")[-1, :9, 5, 0]
    np.testing.assert_allclose(np.diff(x), placement - 1, atol=1e-5)


def test_the_far_rim_of_e_falls_as_one_over_the_distance():
    def share(name):
        ds = run(name)
        size = np.linalg.norm((ds.position - ds.reference).transpose("time", ..., "axis"), axis=2)
        body, last = (ds.kind[0] != FRAME).values, int(ds.site.values[:, 0].max()) - 1
        rim = body & np.isin(ds.site.values, (0, last)).any(axis=1)
        return size[-1, rim].max() / size[-1, body].max()

    assert share("paper/e") / share("paper/e-40") == pytest.approx(4.0, abs=0.1)
