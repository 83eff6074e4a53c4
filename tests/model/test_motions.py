"""Motions from files: tables of steps, and displacements measured at scattered points."""

import json

import numpy as np
import pytest

import pbdkit
from pbdkit.cli import main
from pbdkit.sweeps.specification import Keep, job_of

TEXT = """
version: 1
name: from-a-file
lattice: {type: square, a: 1.0}
body: {type: grid, columns: 5, rows: 4}
rule: {type: barycentre}
leaders:
  - select: %s
    motion: %s
steps: 6
diagnostics: [{type: displacement}]
"""


def written(folder, motion, content="", select="{edge: right}"):
    (folder / "data.csv").write_text(content, encoding="utf-8")
    path = folder / "experiment.yaml"
    path.write_text(TEXT % (select, motion))
    return str(path)


def of_leaders(ds):
    return ds.u.values[:, ds.kind.values[0] == 0]


STEPS = "step, ux, uy\n0, 0, 0\n2, 0.2, 0\n4, 0.2, -0.1\n"
SPELT = "{type: path, steps: [2, 4], displacements: [[0.2, 0.0], [0.2, -0.1]]}"


def test_table_is_the_path_in_the_file(tmp_path):
    named = pbdkit.load(written(tmp_path, "{type: table, file: data.csv}", STEPS))
    ds = pbdkit.run(named, progress=False)
    other = tmp_path / "spelt"
    other.mkdir()
    spelt = pbdkit.run(written(other, SPELT), progress=False)
    assert np.array_equal(ds.u, spelt.u)
    inline = SPELT.replace("path", "table")
    assert pbdkit.load(written(other, inline)) == named
    # A dataset needs no file beside it.
    (tmp_path / "data.csv").unlink()
    assert np.array_equal(pbdkit.rerun(ds, progress=False).u, ds.u)
    motion = json.loads(ds.attrs["experiment"])["leaders"][0]["motion"]
    assert motion == {"type": "table", "steps": [2, 4], "displacements": [[0.2, 0.0], [0.2, -0.1]]}


def test_changing_the_file_changes_the_member_of_a_sweep(tmp_path):
    def key():
        experiment = pbdkit.load(str(tmp_path / "experiment.yaml"))
        return job_of(experiment, Keep(), {}).key

    written(tmp_path, "{type: table, file: data.csv}", STEPS)
    first = key()
    assert key() == first
    written(tmp_path, "{type: table, file: data.csv}", STEPS.replace("-0.1", "-0.2"))
    assert key() != first


def plane(x, y):
    """A displacement that is linear in the place."""
    return 0.01 * x - 0.02 * y + 0.1, 0.03 * x + 0.005 * y


def measured(points):
    rows = (f"{x},{y},{plane(x, y)[0]},{plane(x, y)[1]}" for x, y in points)
    return "x,y,ux,uy\n" + "\n".join(rows) + "\n"


SCATTER = [(-1.0, -1.5), (6.0, -2.0), (5.0, 7.0), (-2.0, 5.0), (1.3, 1.1), (2.9, 2.2), (4.1, 0.3)]
CORNERS = [(0, 0), (4, 0), (4, 3), (0, 3)]
LINE = [(4.0, 3.0), (4.0, 0.0), (4.0, 1.3)]


@pytest.mark.parametrize(
    ("points", "select"),
    [(SCATTER, "{box: [0, 0, 4, 3]}"), (CORNERS, "{box: [0, 0, 4, 3]}"), (LINE, "{edge: right}")],
    ids=["scattered", "corners", "a line"],
)
def test_linear_motion_is_interpolated_exactly(tmp_path, points, select):
    """Also where particles lie on the outermost points, and where all points lie on a line."""
    motion = "{type: measured, file: data.csv, ramp: 4}"
    ds = pbdkit.run(written(tmp_path, motion, measured(points), select), progress=False)
    X = ds.reference.values[ds.kind.values[0] == 0]
    exact = np.stack(plane(*X.T), axis=1)
    for step, share in ((1, 0.25), (3, 0.75), (4, 1.0), (6, 1.0)):
        assert np.abs(of_leaders(ds)[step] - share * exact).max() < 1e-15
    assert np.array_equal(pbdkit.rerun(ds, progress=False).u, ds.u)


def test_measured_motion_starts_at_the_current_position(tmp_path):
    """The motion is that of every other motion; the displacement is that of the place at rest."""
    path = written(tmp_path, "{type: measured, file: data.csv}", measured(SCATTER))
    given = pbdkit.load(path).model_dump(by_alias=True, mode="json")
    (late,) = given["leaders"]
    first = {"select": late["select"], "motion": {"type": "displace", "displacement": [0.3, 0.1]}}
    given["leaders"] = [first | {"until": 2}, late | {"from": 4}]
    ds = pbdkit.run(given, progress=False)
    led = ds.kind.values[-1] == 0
    u, exact = ds.u.values[:, led], np.stack(plane(*ds.reference.values[led].T), axis=1)
    assert not np.allclose(u[2], u[3])
    np.testing.assert_allclose(u[-1], u[3] + exact, atol=1e-15)


def test_many_points_are_stored_in_the_result(tmp_path):
    """An attribute beyond the 64 kB that HDF5 stores in a header."""
    points = np.random.default_rng(0).uniform(-1.0, 6.0, (3000, 2)).round(12)
    content = measured([*points.tolist(), (-9, -9), (9, -9), (9, 9), (-9, 9)])
    path = written(tmp_path, "{type: measured, file: data.csv}", content)
    ds = pbdkit.run(path, progress=False)
    out = tmp_path / "out.nc"
    with pytest.raises(SystemExit) as ended:
        main(["run", path, "-o", str(out), "--quiet"])
    assert ended.value.code == 0
    with pbdkit.open(str(out)) as kept:
        assert len(kept.attrs["experiment"]) > 2e5
        assert np.array_equal(pbdkit.rerun(kept, progress=False).u, ds.u)


TABLE, MEASURED = "{type: table, file: data.csv}", "{type: measured, file: data.csv}"


@pytest.mark.parametrize(
    ("motion", "content", "text"),
    [
        (TABLE, "step,ux\n1,0\n", r"yaml:9:27: leaders\.0\.motion\.file: .*data\.csv:1: "
                                  "requires the columns step, ux, uy, .* has no 'uy'"),
        (TABLE, "step;ux;uy\n1;0,1;0\n", "separated by ';'; save it with commas between columns"),
        (TABLE, "step\tux\tuy\n1\t0\t0\n", "separated by tabs; save it with commas"),
        (TABLE, "step,ux,uy\n", "has no row"),
        (TABLE, "step,ux,uy\n1,a,0\n", r"csv:2: column 'ux' requires a finite number, got 'a'"),
        (TABLE, "step,ux,uy\n1,0\n", "column 'uy' requires a finite number, got nothing"),
        (TABLE, "step,ux,uy\n1,inf,0\n", "got 'inf'"),
        (TABLE, "step,ux,uy\n1,0,0\n1,1,0\n", "steps must increase"),
        (TABLE, "step,ux,uy\n1.5,0,0\n", "expected whole numbers from 1 as steps, got 1.5"),
        (TABLE, "step,ux,uy\n0,1,0\n", "the displacement at step 0 is zero"),
        (TABLE.replace("data", "other"), "", r"other\.csv: does not exist; paths are relative to"),
        (TABLE.replace("data.csv", "."), "", "is not a regular file"),
        (TABLE.replace("}", ", steps: [1]}"), STEPS, "give either a file, or steps"),
        (MEASURED, "x,y,ux,uy\n0,0,1,1\n0,0,1,2\n", (r"\(0, 0\) occurs twice among the measured "
                                                    r"points")),
        (MEASURED, measured([(0, 0), (4, 0), (0, 3)]), "3 of 4 particles lie outside the measured "
                                                      r"points, the first is number \d+ at"),
        (MEASURED, measured([(0, 0), (1, 0)]), "4 of 4 particles lie outside"),
        (MEASURED.replace("}", ", points: [[0, 0]]}"), "", "give either a file, or points"),
        ("{type: measured, points: [[0, 0], [1, 1]], displacements: [[1, 1]]}", "", "at least 2"),
    ],
)  # fmt: skip
def test_errors_in_a_file_have_place_and_remedy(tmp_path, motion, content, text):
    with pytest.raises(pbdkit.ExperimentError, match=text):
        pbdkit.run(written(tmp_path, motion, content), progress=False)
