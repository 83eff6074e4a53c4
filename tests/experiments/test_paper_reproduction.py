"""The page docs/validation/reproduction.md, and its main numbers measured again."""

import re
import runpy

import numpy as np
import pytest
from paper_cases import FRAME, LAST, QUIET, body_u, low_after_top, parted, run
from paper_page import DOCS, PAGE, rows
from scene_strategies import in_turn

import pbdkit
from pbdkit.model.shipped import shipped_names

OTHER = (DOCS / "validation/anisotropy-and-plasticity.md").read_text("utf-8")
CASES = {"a": 15, "b": 5, "c": 5, "d": 11, "e": 3, "f": 14, "g": 4}
"""Smallest number of claims for each case."""
VERDICT = re.compile(r"^(reproduced|reproduced only with \S.*|not reproduced)$")
NAMED = sorted(set(re.findall(r"paper/[a-z0-9-]+", PAGE + OTHER)))


def section(case):
    return re.search(rf"^## Case {case}: .*?(?=^## )", PAGE, re.M | re.S).group()


@pytest.mark.parametrize("case", CASES)
def test_every_claim_has_figures_and_one_of_three_verdicts(case):
    claims = rows(section(case))
    assert len(claims) >= CASES[case]
    for quote, measured, verdict in claims:
        assert quote.startswith("“")
        assert measured
        assert VERDICT.match(verdict), verdict


def test_the_page_counts_its_claims():
    verdicts = [row[2] for row in rows(PAGE)]
    out, fails = verdicts.count("reproduced"), verdicts.count("not reproduced")
    total, *counts = map(
        int, re.search(r"counts (\d+) claims\. (\d+) .* (\d+) .* (\d+) are not", PAGE).groups()
    )
    assert (total, counts) == (len(verdicts), [out, total - out - fails, fails])


def test_every_measurement_ends_as_a_sentence():
    assert [quote for quote, measured, _ in rows(PAGE) if not measured.endswith(".")] == []


def test_figures_exist_are_small_and_are_all_used():
    shown = re.findall(r"\(\.\./(pictures/reproduction/[^)]+)\)", PAGE + OTHER)
    assert {DOCS / name for name in shown} == set((DOCS / "pictures/reproduction").iterdir())
    assert all((DOCS / name).stat().st_size <= 150_000 for name in shown)


def test_times_quoted_from_the_performance_page_are_there(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "reproduction")
    assert runpy.run_path(str(DOCS / "reproduction" / "cost.py"))["MEASURED"].is_file()


@pytest.mark.parametrize("name", NAMED)
def test_experiments_named_on_the_page_are_shipped_and_run(name):
    assert name in shipped_names()
    experiment = pbdkit.load(name, settings=["steps=12", "record={every: 12}"])
    assert pbdkit.run(experiment, progress=False).attrs["status"] == "complete"


@pytest.mark.parametrize(("name", "spread"), [("a-lag", 0.134), ("a-chebyshev", 0.061)])
def test_convexity_requires_a_delayed_frame_or_eight_neighbours(name, spread):
    x = body_u(name, QUIET)[..., 0]
    assert np.ptp(x, axis=2).max() == pytest.approx(spread, abs=1e-3)
    assert x[9, 8, 0] < x[9, 8, 5]


def test_without_a_frame_the_sheet_collapses():
    ds = run("a-no-frame", "leaders=[]", *LAST)
    assert np.ptp(ds.position.values[-1], axis=0).max() < 1e-3


def test_frame_rows_break_first_with_delay_in_threshold_windows():
    assert parted("d1-lag") == [5, *[6] * 8, 5]
    assert parted("d1") == [6] * 10
    assert parted("d1-lag", 6.0) == [7] * 10


def test_103_rebounds_permanently_only_if_frame_bonds_hold():
    x = body_u("d2-frame-bonds", QUIET)[:, 7, 5, 0]
    low = low_after_top(x)
    assert (low, x[low]) == (21, pytest.approx(1.358, abs=1e-3))
    assert x[400] == pytest.approx(2.563, abs=1e-3)
    dip = body_u("d2-chebyshev", QUIET)[:, 7, 5, 0]
    assert low_after_top(dip) == 4
    assert dip[[3, 4, 7]] == pytest.approx([0.804, 0.716, 1.199], abs=1e-3)
    assert abs(dip[400]) < 1e-4


def test_second_fractures_of_f2_occur_at_certain_thresholds():
    assert run("f2-second-fracture", *LAST).broken_step.max() == 116
    assert run("f2-cusp", *LAST).broken_step.max() == 108
    assert np.linalg.norm(body_u("f2-early", *LAST)[-1, :9], axis=-1).max() < 0.01


def test_a_right_angle_is_not_followed():
    pe1 = run("a-rotation", "record.every=1500", "diagnostics=[{type: pe1}]").pe1.values[-1]
    assert np.nanmax(pe1) == pytest.approx(3.3, abs=0.05)


@pytest.mark.parametrize(
    ("placement", "threshold"), in_turn([(0.8, 5.2), (1.2, 3.0), (1.2, 7.0)], 2)
)
def test_strain_of_lambda_minus_one_remains_at_any_stretch(placement, threshold):
    """So that it is no plastic strain."""
    torn = [f"fracture.placement={placement}", f"fracture.thresholds=[{threshold}]"]
    x = body_u("d1", *torn, "steps=1500", *LAST)[-1, :9, 5, 0]
    np.testing.assert_allclose(np.diff(x), placement - 1, atol=1e-5)


def test_far_edge_of_e_decays_as_inverse_distance():
    def share(name):
        ds = run(name, QUIET)
        size = np.linalg.norm((ds.position - ds.reference).transpose("time", ..., "axis"), axis=2)
        body, last = (ds.kind[0] != FRAME).values, int(ds.site.values[:, 0].max()) - 1
        rim = body & np.isin(ds.site.values, (0, last)).any(axis=1)
        return size[-1, rim].max() / size[-1, body].max()

    assert share("e") / share("e-40") == pytest.approx(4.0, abs=0.1)
