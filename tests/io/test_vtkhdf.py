"""The content of an exported result in ParaView is the dataset, step by step."""

import h5py
import numpy as np
import pytest
from property_cases import LATTICES, experiment, pull_right

import pbdkit
from pbdkit.io.vtkhdf import BOND, CELL, PARTICLE, export
from pbdkit.scene.scene import build_scene

HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
TORN = {
    "leaders": [HELD, pull_right(0.3, 0.0, 8)],
    "fracture": {"type": "threshold", "thresholds": [1.9], "cracks": [[[2.5, -2.0], [2.5, 0.2]]]},
    "diagnostics": [{"type": t} for t in ("pe1", "displacement", "broken", "crack-path")],
    "record": {"every": 2},
    "steps": 20,
}


def grids(path):
    """Yield what vtk reads from a file: the grid of each step, with its time."""
    vtk = pytest.importorskip("vtk")  # It takes long to import, and not every worker needs it.
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    for step in range(reader.GetNumberOfSteps()):
        reader.SetStep(step)
        reader.Update()
        grid = vtk.vtkUnstructuredGrid()
        grid.DeepCopy(reader.GetOutputDataObject(0))
        yield grid


def array(values):
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(values)


def field(data, name):
    assert data.GetArray(name), name
    return array(data.GetArray(name))


@pytest.fixture(scope="module")
def torn(tmp_path_factory):
    made = pbdkit.Experiment(**experiment(**TORN))
    dataset = pbdkit.run(made, progress=False)
    path = tmp_path_factory.mktemp("export") / "torn.vtkhdf"
    export(dataset, path, build_scene(made), replace=False)
    return dataset, list(grids(path)), path


def test_every_recorded_step_has_its_points(torn):
    ds, read, _ = torn
    assert [field(g.GetFieldData(), "Time").item() for g in read] == ds.time.values.tolist()
    for k, grid in enumerate(read):
        points = array(grid.GetPoints().GetData())
        np.testing.assert_array_equal(points[:, :2], ds.position.isel(time=k))
        assert not points[:, 2].any()


def test_point_data_are_the_particle_variables(torn):
    ds, read, _ = torn
    for k, grid in enumerate(read):
        now, data = ds.isel(time=k), grid.GetPointData()
        for name in ("number", "i", "j", "role", "kind", "pe1"):
            np.testing.assert_array_equal(field(data, name), now[name])
        for name in ("u", "reference"):
            vectors = field(data, name)
            np.testing.assert_array_equal(vectors[:, :2], now[name])
            assert vectors.shape[1] == 3
            assert not vectors[:, 2].any()


def corners(grid, n):
    ids = grid.GetCell(n).GetPointIds()
    return [ids.GetId(k) for k in range(ids.GetNumberOfIds())]


def test_cells_are_particles_bonds_and_squares(torn):
    ds, read, _ = torn
    data = read[-1].GetCellData()
    part = field(data, "part")
    found = [corners(read[-1], int(n)) for n in np.flatnonzero(part == BOND)]
    np.testing.assert_array_equal(np.array(found) + 1, ds.bond_ends)
    assert [corners(read[-1], int(n)) for n in np.flatnonzero(part == PARTICLE)] == [
        [n] for n in range(ds.sizes["particle"])
    ]
    for n in np.flatnonzero(part == CELL):
        x, y = ds.reference.values[corners(read[-1], int(n))].T
        assert np.isclose((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2, 1.0)
    assert (part == CELL).sum() == 5 * 4


def test_broken_bonds_are_marked_at_each_step(torn):
    ds, read, _ = torn
    assert (ds.broken_step == 0).any()
    assert (ds.broken_step > 1).any()
    for grid, time in zip(read, ds.time.values, strict=True):
        data, part = grid.GetCellData(), field(grid.GetCellData(), "part")
        here = field(data, "broken")
        steps = ds.broken_step.values
        np.testing.assert_array_equal(here[part == BOND], (steps >= 0) & (steps <= time))
        np.testing.assert_array_equal(field(data, "broken_step")[part == BOND], steps)
        broken = ds.bond_ends.values[(steps >= 0) & (steps <= time)] - 1
        gone = set(map(tuple, broken.tolist()))
        for n in np.flatnonzero(part == CELL):
            own = corners(grid, int(n))
            torn_here = any((min(a, b), max(a, b)) in gone for a in own for b in own)
            assert here[n] == torn_here


def test_global_numbers_are_field_data(torn):
    ds, read, _ = torn
    for k, grid in enumerate(read):
        data = grid.GetFieldData()
        assert field(data, "broken_bonds").item() == ds.broken_bonds[k]
        np.testing.assert_array_equal(field(data, "crack_step"), ds.crack_step)
        np.testing.assert_array_equal(field(data, "crack_midpoint")[:, :2], ds.crack_midpoint)


def test_forces_have_one_tuple_per_group(tmp_path):
    calibrated = {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [HELD, pull_right(0.01, 0.0, 4)],
        "diagnostics": [{"type": "reaction", "youngs_modulus": 2.0}],
        "steps": 4,
    }
    ds = pbdkit.run(experiment(**calibrated), progress=False)
    export(ds, tmp_path / "out.vtkhdf", None, replace=False)
    for k, grid in enumerate(grids(tmp_path / "out.vtkhdf")):
        forces = field(grid.GetFieldData(), "reaction")
        np.testing.assert_array_equal(forces[:, :2], ds.reaction.isel(time=k))


def test_damage_is_per_bond_and_changes(tmp_path):
    made = pbdkit.load("modelling/double-cantilever", settings=["solver.increments=1"])
    ds = pbdkit.run(made, progress=False)
    export(ds, tmp_path / "out.vtkhdf", build_scene(made), replace=False)
    for k, grid in enumerate(grids(tmp_path / "out.vtkhdf")):
        data = grid.GetCellData()
        part, damage = field(data, "part"), field(data, "damage_left")
        np.testing.assert_array_equal(damage[part == BOND], ds.damage_left.isel(time=k))
        assert np.isnan(damage[part != BOND]).all()


@pytest.mark.parametrize("lattice", LATTICES)
def test_cells_of_every_lattice_cover_the_body_once(lattice, tmp_path):
    made = pbdkit.Experiment(**experiment(lattice=lattice, steps=1))
    export(pbdkit.run(made, progress=False), tmp_path / "out.vtkhdf", build_scene(made),
           replace=False)  # fmt: skip
    scene = build_scene(made)
    *_, grid = grids(tmp_path / "out.vtkhdf")
    part = field(grid.GetCellData(), "part")
    X = scene.raster.reference()
    areas = []
    for n in np.flatnonzero(part == CELL):
        x, y = X[corners(grid, int(n))].T
        areas.append((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
    cells = sum(int(patch.whole.sum()) for patch in scene.patches)
    assert len(areas) == cells > 0
    assert min(areas) > 0


def test_constant_data_are_stored_once(torn):
    ds, _, path = torn
    count, steps = ds.sizes["particle"], ds.sizes["time"]
    with h5py.File(path) as file:
        root = file["VTKHDF"]
        assert len(root["PointData/reference"]) == count
        assert len(root["PointData/pe1"]) == len(root["Points"]) == steps * count
        assert len(root["Types"]) == root["NumberOfCells"][0]
        changes = len(np.unique(np.searchsorted(np.unique(ds.broken_step), ds.time, "right")))
        assert len(root["CellData/broken"]) == changes * len(root["Types"])
        assert file.attrs["experiment"] == ds.attrs["experiment"]


def test_the_command_writes_beside_the_result(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("run", "paper/a", "--set", "steps=3", "-o", "a.nc", "--quiet").code == 0
    assert call("export", "a.nc").out == "a.vtkhdf written\n"
    assert "a.vtkhdf: exists" in call("export", "a.nc").err
    assert call("export", "a.nc", "--force").code == 0
    refused = call("export", "a.nc", "-o", "a.vtk")
    assert (refused.code, "must end in .vtkhdf" in refused.err) == (2, True)
    nowhere = call("export", "a.nc", "-o", "none/a.vtkhdf")
    assert (nowhere.code, "there is no folder none" in nowhere.err) == (6, True)
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["a.nc", "a.vtkhdf"]
    assert len(list(grids("a.vtkhdf"))) == 4


def test_without_the_components_of_the_experiment_there_are_no_cells(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call("run", "paper/a", "--set", "steps=1", "-o", "a.nc", "--quiet")
    ds = pbdkit.open("a.nc").load()
    ds.attrs["experiment"] = ds.attrs["experiment"].replace('"barycentre"', '"gone:barycentre"')
    ds.to_netcdf("b.nc")
    told = call("export", "b.nc")
    assert told.code == 0
    assert "without cells" in told.err
    *_, grid = grids("b.vtkhdf")
    assert CELL not in field(grid.GetCellData(), "part")
