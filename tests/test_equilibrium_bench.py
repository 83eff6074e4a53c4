"""`pbdkit bench` of an equilibrium: what it is measured against, its table, figures and picture."""

import json
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.benching import equilibria
from pbdkit.benching.equilibria import EquilibriumBench, Solved, Unsolved
from pbdkit.benching.equilibria_picture import equilibria_picture
from pbdkit.benching.equilibria_report import equilibria_reasons, equilibria_table, gains
from pbdkit.benching.exact import Decay, decay_of, exact_answer
from pbdkit.scene.scene import build_scene

HOLD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
TOLERANCES = (1e-2, 1e-6)


def pulled(**select):
    return {"select": select, "motion": {"type": "displace", "displacement": [1.0, 0.0]}}


def sheet(leaders, columns=9, rows=6, **parts):
    return {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "rule": {"type": "barycentre"},
        "leaders": leaders,
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-13},
    } | parts


AFFINE = [HOLD, pulled(edge="right")]
BENT = [HOLD, pulled(nearest=[[8.0, 5.0]])]


def scene_of(leaders, **parts):
    return build_scene(pbdkit.Experiment(**sheet(leaders, **parts)))


@pytest.fixture
def quick(monkeypatch):
    """Fewer processes and tolerances."""
    monkeypatch.setattr(equilibria, "METHODS", ("lu", "conjugate-gradients"))
    monkeypatch.setattr(equilibria, "processors", lambda: 1)
    monkeypatch.setattr(EquilibriumBench, "__init__", _with_few_tolerances)


def _with_few_tolerances(self, experiment, settings, steps):
    for name, value in (("experiment", experiment), ("settings", settings), ("steps", steps),
                        ("tolerances", TOLERANCES)):  # fmt: skip
        object.__setattr__(self, name, value)


def test_the_exact_answer_is_affine_where_nobody_moves_there():
    scene = scene_of(AFFINE)
    exact = exact_answer(scene)
    assert exact.how == "affine"
    np.testing.assert_allclose(np.unique(exact.u[0].round(12)), np.arange(1, 8) / 8, atol=1e-12)
    assert abs(exact.u[1]).max() < 1e-15
    assert exact_answer(scene_of(BENT)).how == "lu"
    assert exact_answer(scene_of(BENT)).within < 1e-13


def test_the_slowest_mode_decays_as_the_closed_form_says():
    """λ = (1 + cos(π/N))/2, and u = x/N has the share (2/π) (π/2N)/tan(π/2N) of its sine."""
    scene = scene_of([HOLD, pulled(edge="right")], columns=21)
    decay = decay_of(scene, exact_answer(scene))
    assert decay.rate == pytest.approx((1 + np.cos(np.pi / 20)) / 2, rel=1e-8)
    share = 1 / (20 * np.tan(np.pi / 40))
    assert decay.share == pytest.approx(share, rel=1e-3)


def test_steps_to_a_tolerance_are_counted_or_there_are_none():
    assert Decay(0.5, 0.1).steps_to(1e-3) == 3
    assert Decay(0.5, 0.1).steps_to(0.7) == 1
    assert Decay(0.5, 1.0).steps_to(1e-3) is None
    assert Decay(0.5, -0.1).steps_to(1e-3) is None


@pytest.mark.parametrize("leaders", [AFFINE, BENT], ids=["affine", "bent"])
def test_the_table_the_figures_and_the_picture(call, quick, leaders):
    Path("s.json").write_text(json.dumps(sheet(leaders)))
    result = call("bench", "s.json", "--json", "b.json", "--plot", "b.png")
    assert result.code == 0, result.err
    found = json.loads(Path("b.json").read_text())
    assert set(found) == {
        "experiment", "settings", "steps", "machine", "exact", "measurements", "not_measured"
    }  # fmt: skip
    rows = found["measurements"]
    assert [(r["method"], r["tolerance"]) for r in rows] == [
        ("lu", 1e-6),
        *((m, t) for m in ("conjugate-gradients", "stepping") for t in TOLERANCES),
    ]
    for row in rows:
        assert row["seconds"] > 0
        assert not row["is_predicted"]
        if row["method"] != "stepping":
            within = found["exact"][0]["within"]
            assert row["error"] <= row["certified"] + within
            assert row["certified"] <= row["tolerance"]
        else:
            # The steps that the slowest mode needs leave what they are to leave.
            assert row["error"] == pytest.approx(row["tolerance"], rel=0.25)
    assert found["exact"][0]["how"] == ("affine" if leaders is AFFINE else "lu")
    assert "as it is, to 1e-06: " in result.out
    assert Path("b.png").read_bytes().startswith(b"\x89PNG")
    for row in rows:
        assert any(row["method"] in line and f"{row['tolerance']:.0e}" in line
                   for line in result.out.splitlines())  # fmt: skip


def test_steps_that_take_too_long_are_counted_ahead(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(equilibria, "METHODS", ("lu",))
    monkeypatch.setattr(equilibria, "LARGEST_DIRECT", 10)
    monkeypatch.setattr(equilibria, "PATIENCE_S", 0.0)
    file = tmp_path / "s.json"
    file.write_text(json.dumps(sheet(AFFINE)))
    truth, rows = EquilibriumBench(str(file), (), 1).measure(12, lambda _: None)
    none, *steps = rows
    assert isinstance(none, Unsolved)
    assert "left out above 10 particles" in none.reason
    assert [row.is_predicted for row in steps] == [True, True]
    loose, tight = steps
    assert (loose.error, tight.error) == TOLERANCES
    assert loose.cpu_s > 0
    assert loose.seconds / loose.iterations == pytest.approx(tight.seconds / tight.iterations)
    # Four decades more, each ln 10 / -ln ρ steps.
    more = 4 * np.log(10) / -np.log(truth.rate)
    assert tight.iterations - loose.iterations == pytest.approx(more, abs=1)


def test_a_method_that_took_too_long_is_left_out_where_it_would_take_longer(tmp_path, monkeypatch):
    monkeypatch.setattr(equilibria, "METHODS", ("conjugate-gradients",))
    rows = {"rows": [{"iterations": 9, "seconds": 99.0, "cpu_s": 99.0, "certified": 1e-3,
                      "error": 1e-4}], "peak_memory_mib": 1.0}  # fmt: skip
    monkeypatch.setattr(EquilibriumBench, "_work", lambda *a, **k: rows)
    truth = equilibria.Truth(None, 54, "affine", 0.0, 0.9)
    found = list(EquilibriumBench("s", (), 1)._settled("conjugate-gradients", truth, (), tmp_path))
    assert [type(row) for row in found] == [Solved] + 4 * [Unsolved]
    assert equilibria_reasons(found)[0] == (
        "conjugate-gradients at size as it is, 1e-04: 99 s for the tolerance before"
    )


def test_bonds_that_can_break_are_refused(call):
    fracture = {"type": "threshold", "thresholds": [9.0]}
    Path("s.json").write_text(json.dumps(sheet(AFFINE, fracture=fracture)))
    result = call("bench", "s.json")
    assert result.code == 2
    assert "where no bond can break; set fracture={type: none}" in result.err
    assert len(result.err.strip().splitlines()) == 1


def row(method, tolerance, seconds, certified, error, **more):
    return Solved(method, 9, 54, tolerance, 7, 9.0, seconds, certified, error, None, **more)


ROWS = [
    row("lu", 1e-8, 0.5, 1e-9, 1e-12),
    row("multigrid", 1e-4, 0.1, 1e-5, 1e-9),
    row("multigrid", 1e-8, 0.2, 2e-8, 1e-12),
    row("stepping", 1e-4, 50.0, None, 1e-4),
    row("stepping", 1e-8, 1000.0, None, 1e-8, is_predicted=True),
    Unsolved("conjugate-gradients", 9, None, "it cannot"),
]


def test_the_gain_is_over_the_fastest_that_reaches_the_same():
    assert gains(ROWS) == [
        "size 9, to 1e-08: 7 steps would take 1e+03 s of processor time, lu 0.5 s, 2e+03 times less"
    ]
    assert gains([r for r in ROWS if r.method != "lu"]) == [
        "size 9, to 1e-04: 7 steps take 50 s of processor time, multigrid 0.1 s, 500 times less"
    ]


def test_every_row_is_in_the_table_and_every_measurement_in_the_picture():
    assert equilibria_table(ROWS).row_count == len(ROWS)
    measured = [r for r in ROWS if isinstance(r, Solved)]
    (ax,) = (a for a in equilibria_picture(measured, "a title").axes if a.get_visible())
    drawn = np.concatenate([points.get_offsets() for points in ax.collections])
    assert sorted(map(tuple, drawn)) == sorted((r.cpu_s, r.error) for r in measured)
    hollow = [points for points in ax.collections if (points.get_facecolor() == 1.0).all()]
    assert len(hollow) == 1
