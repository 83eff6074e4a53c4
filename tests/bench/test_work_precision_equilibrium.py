"""`pbdkit bench` of an equilibrium: what it is measured against, its table, figures and picture."""

import json
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.bench import work_precision as measurement
from pbdkit.bench.work_precision import (
    Decay,
    Row,
    decay_of,
    followers_of,
    lines,
    measure,
    table,
    work_precision_figure,
)
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.scene.scene import build_scene
from tests.bench.test_work_precision import work_here

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
    """No processes, and fewer tolerances."""
    monkeypatch.setattr(measurement, "_run_in_process", work_here)
    monkeypatch.setattr(measurement, "METHODS", ("lu", "conjugate-gradients"))
    monkeypatch.setattr(measurement, "processors", lambda: 1)
    monkeypatch.setattr(measurement, "TOLERANCES", TOLERANCES)


def test_slowest_mode_decays_at_the_closed_form_rate():
    """λ = (1 + cos(π/N))/2, and u = x/N has the share (2/π) (π/2N)/tan(π/2N) of its sine."""
    solver = {"type": "equilibrium", "tolerance": 1e-11}
    scene = scene_of([HOLD, pulled(edge="right")], columns=21, solver=solver)
    state, _ = equilibrium_state(scene)
    decay = decay_of(scene, state.u.reshape(2, -1)[:, followers_of(scene)])
    assert decay.rate == pytest.approx((1 + np.cos(np.pi / 20)) / 2, rel=1e-8)
    share = 1 / (20 * np.tan(np.pi / 40))
    assert decay.share == pytest.approx(share, rel=1e-3)


def test_steps_to_a_tolerance_are_counted_or_absent():
    assert Decay(0.5, 0.1).steps_to(1e-3) == 3
    assert Decay(0.5, 0.1).steps_to(0.7) == 1
    assert Decay(0.5, 1.0).steps_to(1e-3) is None
    assert Decay(0.5, -0.1).steps_to(1e-3) is None


@pytest.mark.parametrize(
    ("leaders", "tolerances"),
    [(AFFINE, TOLERANCES), (BENT, TOLERANCES[1:])],
    ids=["affine", "bent"],
)
def test_table_figures_and_plot_are_written(call, quick, monkeypatch, leaders, tolerances):
    monkeypatch.setattr(measurement, "TOLERANCES", tolerances)
    Path("s.json").write_text(json.dumps(sheet(leaders)))
    result = call("bench", "s.json", "--json", "b.json", "--plot", "b.png")
    assert result.code == 0, result.err
    found = json.loads(Path("b.json").read_text())
    assert set(found) == {"experiment", "settings", "steps", "machine", "rows"}
    exact, *rows = found["rows"]
    assert (exact["method"], exact["certified"] < 1e-12) == ("exact, by lu", True)
    assert [(r["method"], r["tolerance"]) for r in rows] == [
        ("lu", 1e-6),
        *((m, t) for m in ("conjugate-gradients", "stepping") for t in tolerances),
    ]
    for row in rows:
        assert row["seconds"] > 0
        assert not row["is_predicted"]
        if row["method"] != "stepping":
            assert row["error"] <= row["certified"] + 2 * exact["certified"]
            assert row["certified"] <= row["tolerance"]
        else:
            # The steps that the slowest mode needs leave what they are to leave.
            assert row["error"] == pytest.approx(row["tolerance"], rel=0.25)
    assert Path("b.png").read_bytes().startswith(b"\x89PNG")
    for row in rows:
        assert any(row["method"] in line and f"{row['tolerance']:.0e}" in line
                   for line in result.out.splitlines())  # fmt: skip


def test_number_of_slow_steps_is_estimated_beforehand(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(measurement, "METHODS", ("lu",))
    monkeypatch.setattr(measurement, "MAX_PARTICLES_LU", 10)
    monkeypatch.setattr(measurement, "MAX_STEPPING_S", 0.0)
    file = tmp_path / "s.json"
    file.write_text(json.dumps(sheet(AFFINE)))
    _, none, *steps = measure(str(file), (), 12, lambda _: None)
    assert "omitted above 10 particles" in none.reason
    assert [row.is_predicted for row in steps] == [True, True]
    loose, tight = steps
    assert (loose.error, tight.error) == TOLERANCES
    assert loose.cpu_s > 0
    assert loose.seconds / loose.steps == pytest.approx(tight.seconds / tight.steps)
    # Four decades more, each ln 10 / -ln ρ steps, with 11 bonds between the leaders.
    more = 4 * np.log(10) / -np.log((1 + np.cos(np.pi / 11)) / 2)
    assert tight.steps - loose.steps == pytest.approx(more, abs=1)


def test_slow_method_is_skipped_at_tighter_tolerances():
    row = {"steps": 9, "seconds": 99.0, "cpu_s": 99.0, "certified": 1e-3, "distance": 1e-4}

    def work(*asked, **job):
        return {"rows": [row], "peak_memory_mib": 1.0}

    base, exact = Row(None, "conjugate-gradients"), {"scale": 1.0, "within": 0.0}
    tolerances = list(measurement.TOLERANCES)
    found = list(measurement._rows_of_method(work, base, tolerances, exact))
    assert [bool(row.reason) for row in found] == [False] + 4 * [True]
    assert (
        "omitted: conjugate-gradients at size unchanged, 1e-04: 99 s for the previous tolerance"
    ) in lines(found)


def test_breakable_bonds_are_refused(call, quick):
    fracture = {"type": "threshold", "thresholds": [9.0]}
    Path("s.json").write_text(json.dumps(sheet(AFFINE, fracture=fracture)))
    result = call("bench", "s.json")
    assert result.code == 2
    assert "without fracture; set fracture={type: none}" in result.err
    assert len(result.err.strip().splitlines()) == 1


def row(method, tolerance, seconds, certified, error, **more):
    made = {"particles": 54, "steps": 7, "seconds": 9.0, "cpu_s": seconds}
    return Row(9, method, tolerance=tolerance, certified=certified, error=error, **made, **more)


ROWS = [
    row("lu", 1e-8, 0.5, 1e-9, 1e-12),
    row("multigrid", 1e-4, 0.1, 1e-5, 1e-9),
    row("multigrid", 1e-8, 0.2, 2e-8, 1e-12),
    row("stepping", 1e-4, 50.0, None, 1e-4),
    row("stepping", 1e-8, 1000.0, None, 1e-8, is_predicted=True),
    Row(9, "conjugate-gradients", reason="it cannot"),
]


def test_all_rows_are_in_the_table_and_all_measurements_in_the_plot():
    assert table(ROWS).row_count == len(ROWS)
    measured = [r for r in ROWS if not r.reason]
    (ax,) = (a for a in work_precision_figure(ROWS, "a title").axes if a.get_visible())
    points = [one for one in ax.collections if len(one.get_offsets())]
    drawn = np.concatenate([one.get_offsets() for one in points])
    assert sorted(map(tuple, drawn)) == sorted((r.cpu_s, r.error) for r in measured)
    hollow = [face for one in points for face in one.get_facecolor() if (face == 1.0).all()]
    assert len(hollow) == 1
