"""The datasets of the paper's cases: their shape, their files, and that they can be made again."""

import json
import subprocess
import sys

import numpy as np
import pytest
import xarray
from paper_cases import FOLLOWER, FRAME, LEADER, TORN, every_case, moved, run

import pbdkit
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

BASE = {
    "time": (("time",), "int64"),
    "axis": (("axis",), None),
    "particle": (("particle",), "int64"),
    "number": (("particle",), "int64"),
    "i": (("particle",), "int32"),
    "j": (("particle",), "int32"),
    "role": (("particle",), "int8"),
    "inside": (("particle",), "bool"),
    "site": (("particle", "index"), None),
    "reference": (("particle", "axis"), "float64"),
    "X": (("particle",), "float64"),
    "Y": (("particle",), "float64"),
    "position": (("time", "particle", "axis"), "float64"),
    "kind": (("time", "particle"), "int8"),
    "bond": (("bond",), "int32"),
    "bond_ends": (("bond", "end"), "int32"),
    "shell": (("bond",), None),
    "pe1": (("time", "particle"), "float64"),
    "pe2": (("time", "particle"), "float64"),
    "track": (("step", "tracked", "axis"), "float64"),
    "step": (("step",), "int64"),
    "tracked": (("tracked",), "int64"),
}
FRACTURE = {
    "broken_step": (("bond",), None),
    "broken_strain": (("bond",), "float64"),
    "pe1_intact": (("time", "particle"), "float64"),
    "broken_bonds": (("time",), "int64"),
}
ATTRIBUTES = [
    "Conventions", "schema_version", "pbdkit_version", "experiment", "plugins", "status",
    "stop_reason", "created",
]  # fmt: skip


@every_case
def test_datasets_have_the_specified_names_dims_and_dtypes(case):
    ds = run(case)
    expected = BASE | (FRACTURE if case in TORN else {})
    assert set(ds.variables) == set(expected)
    for name, (dims, dtype) in expected.items():
        assert ds[name].dims == dims, name
        assert dtype is None or ds[name].dtype == dtype, name
        assert (
            np.issubdtype(ds[name].dtype, np.integer)
            or dtype in ("float64", "bool")
            or name == "axis"
        )
    labels = {"time", "axis", "number", "particle", "i", "j", "reference", "role", "inside", "bond"}
    assert labels <= set(ds.coords)
    assert ds.axis.values.tolist() == ["x", "y"]
    assert np.array_equal(ds.particle, ds.number)
    assert np.array_equal(ds.particle, np.arange(1, ds.sizes["particle"] + 1))
    assert np.array_equal(ds.time, np.arange(ds.sizes["time"]))


@every_case
def test_datasets_have_the_specified_attributes(case):
    ds = run(case)
    assert set(ATTRIBUTES) <= set(ds.attrs)
    assert ds.attrs["status"] == "complete"
    assert "pbdkit" in json.loads(ds.attrs["plugins"])
    experiment = json.loads(ds.attrs["experiment"])
    assert experiment["frame"]["type"] in ("mean", "first")
    assert experiment["solver"]["type"] == "stepping"
    assert ds.kind.attrs["flag_values"].tolist() == [0, 1, 2]
    assert ds.kind.attrs["flag_meanings"] == "leader follower frame"
    for name in ("pe1", "pe2", "track", "position", "reference"):
        assert ds[name].attrs["units"]
        assert ds[name].attrs["long_name"]


@every_case
def test_bonds_are_sorted_unique_and_have_a_body_end(case):
    ds = run(case)
    ends, body = ds.bond_ends.values, (ds.kind[0] != FRAME).values
    assert (ends[:, 0] < ends[:, 1]).all()
    assert np.array_equal(np.unique(ends, axis=0), ends)
    assert body[ends - 1].any(axis=1).all()
    assert np.array_equal(ds.bond, np.arange(1, len(ends) + 1))


@every_case
def test_leaders_follow_their_schedule_and_path(case):
    ds = run(case)
    kind, u = ds.kind.values, moved(case).values
    assert np.array_equal(kind[0], kind[1])
    if case == "e":
        return
    right = (ds.site[:, 0].values == 9) & (kind[0] == LEADER)
    assert right.sum() == 10
    released = case in ("a", "a-text")
    assert (kind[11:, right] == (FOLLOWER if released else LEADER)).all()
    speed = 0.35 if case in "abc" else 1.2
    expected = speed * np.minimum(np.arange(11), 10)[:, None]
    np.testing.assert_allclose(u[:11, right, 0] - expected, 0.0, atol=1e-14)
    assert not u[:, right, 1][kind[:, right] == LEADER].any()


@pytest.mark.parametrize("case", ["a", "f2"])
def test_rerun_from_the_dataset_is_bitwise_identical(case):
    again = pbdkit.rerun(run(case), progress=False)
    assert again.drop_attrs().identical(run(case).drop_attrs())
    assert again.attrs["experiment"] == run(case).attrs["experiment"]


@every_case
def test_the_file_is_identical_to_the_dataset_in_memory(case, tmp_path):
    shorter = [] if case == "a" else ["steps=30"]
    path, experiment = tmp_path / "out.nc", pbdkit.load(f"paper/{case}", settings=shorter)
    record(Simulation.of_scene(build_scene(experiment)), NetcdfSink(path))
    assert [p.name for p in tmp_path.iterdir()] == ["out.nc"]
    with xarray.open_dataset(path) as opened:
        in_memory = run(case, *shorter)
        created = {"created": opened.attrs["created"]}
        assert opened.load().identical(in_memory.assign_attrs(created))
        for name, variable in in_memory.variables.items():
            assert name == "axis" or opened[name].dtype == variable.dtype


def test_the_file_opens_with_xarray_alone(tmp_path):
    path = tmp_path / "out.nc"
    pbdkit.run("paper/b", output=path, progress=False)
    program = (
        "import sys; sys.modules['pbdkit'] = None\n"
        "import xarray; ds = xarray.open_dataset(sys.argv[1]).load()\n"
        "print(repr(float(ds.position.sel(time=100, particle=67, axis='y'))))\n"
        "assert not [m for m in sys.modules if m.startswith('pbdkit.')]"
    )
    command = [sys.executable, "-c", program, path]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert float(printed) == float(run("b").position.sel(time=100, particle=67, axis="y"))
