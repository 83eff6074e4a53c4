"""Datasets as analysts hold them: labels that select, axes that read right, runs put together."""

import gzip
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
from property_cases import LATTICES, experiment, pull_right

import pbdkit
from pbdkit.io.layout import OF_BODY, OF_FRAME, site_keys
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.lattice.raster import FRAME
from pbdkit.plotting.configuration import difference_of
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

OLD = Path(__file__).parents[1] / "data" / "version-1.nc.gz"
HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}


def torn(crack=0.2, **parts):
    """The dataset of a sheet with a crack up to a height, which is then pulled apart."""
    cracks = [[[2.5, -2.0], [2.5, crack]]]
    given = {
        "leaders": [HELD, pull_right(0.3, 0.0, 8)],
        "fracture": {"type": "threshold", "thresholds": [1.4], "cracks": cracks},
        "diagnostics": [{"type": "pe1"}, {"type": "crack-path"}],
        "record": {"every": 5},
        "steps": 10,
    }
    return pbdkit.run(experiment(**given | parts), progress=False)


@pytest.fixture(scope="module")
def sheet():
    return torn()


@pytest.mark.parametrize("lattice", LATTICES)
def test_every_particle_has_unique_indices(lattice):
    ds = pbdkit.run(experiment(lattice=lattice, steps=1), progress=False)
    assert (np.stack([ds.i, ds.j], axis=1) == ds.site).all()
    assert len(set(zip(ds.i.values, ds.j.values, strict=True))) == ds.sizes["particle"]
    for n in (0, ds.sizes["particle"] // 2):
        i, j = ds.site.values[n]
        assert ds.pbd.at(i=i, j=j).identical(ds.sel(particle=n + 1))
        assert int(ds.set_xindex(["i", "j"]).sel(i=i, j=j).number) == n + 1


def test_lines_of_particles_are_selected_by_one_index(sheet):
    column = sheet.pbd.at(i=3)
    assert column.j.values.tolist() == [-1, 0, 1, 2, 3, 4, 5]
    assert column.identical(sheet.set_xindex("i").sel(i=3).drop_indexes("i"))
    for asked, said in [({"i": 3, "j": 99}, "no particle at i=3, j=99"), ({"k": 1}, "not by 'k'")]:
        with pytest.raises(pbdkit.ExperimentError, match=said):
            sheet.pbd.at(**asked)


def test_fields_unstack_to_rasters(sheet):
    raster = sheet.set_index(particle=["i", "j"]).pe1.unstack("particle")
    assert raster.dims == ("time", "i", "j")
    np.testing.assert_array_equal(raster.sel(i=3, j=2), sheet.pbd.at(i=3, j=2).pe1)


def test_roles_are_constant_and_kinds_change():
    released = pull_right(0.3, 0.0, 2) | {"until": 2}
    ds = torn(leaders=[HELD, released])
    assert ((ds.kind == FRAME) == (ds.role == OF_FRAME)).all()
    assert ds.role.dims == ("particle",)
    assert (ds.kind.where(ds.role == OF_BODY, drop=True).std("time") > 0).any()
    meanings = dict(zip(ds.role.flag_meanings.split(), ds.role.flag_values, strict=True))
    assert meanings == {"body": OF_BODY, "frame": OF_FRAME}
    assert ds.role.dtype == ds.role.flag_values.dtype == np.int8


def test_bonds_can_be_selected_sorted_and_grouped_by_number(sheet):
    third = sheet.sel(bond=3)
    assert third.bond_ends.values.tolist() == sheet.bond_ends.values[2].tolist()
    assert sheet.sortby("bond", ascending=False).bond.values[-1] == 1
    first = sheet.sortby("broken_step").sel(bond=sheet.crack_bond)
    assert (first.broken_step == sheet.crack_step).all()
    np.testing.assert_array_equal(first.broken_strain, sheet.crack_strain)
    X = sheet.reference.sel(particle=sheet.bond_ends)
    assert (np.hypot(*(X.diff("end").squeeze().T)) == 1.0).all()
    assert sheet.broken_step.groupby("shell").max().item() == sheet.broken_step.max()


def texts(figure):
    """Return the texts at the axes of a figure and above them."""
    axes = figure.axes
    found = (t for ax in axes for t in (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()))
    return [" ".join(text.split()) for text in found if text]


def test_plot_axes_are_labelled_with_their_contents(sheet):
    plt = pytest.importorskip("matplotlib.pyplot")
    parts, last = sheet.pbd.components(), {"time": -1}
    drawn = {
        "pe1": lambda: sheet.pe1.sel(particle=25).plot(),
        "broken": lambda: sheet.broken_step.plot(),
        "crack": lambda: sheet.crack_step.plot(),
        "grid": lambda: sheet.isel(last).plot.scatter(x="i", y="j", hue="pe1"),
        "places": lambda: parts.isel(last).plot.scatter(x="position_x", y="position_y"),
    }
    said = {}
    for name, draw in drawn.items():
        figure = plt.figure()
        draw()
        said[name] = texts(figure)
        plt.close(figure)
    pe1 = "pseudo-energy PE1 [lattice unit^2]"
    assert said["pe1"][:2] == ["time [step]", pe1]
    assert said["broken"] == ["number of the bond", "time of breaking [step]"]
    assert said["crack"] == ["crack", "time of breaking [step]"]
    assert said["grid"] == ["site index i", "site index j", "time = 10 [step]", pe1]
    x, y = (f"position, {axis} component [lattice unit]" for axis in "xy")
    assert said["places"][:2] == [x, y]


def test_components_splits_every_vector(sheet):
    parts = sheet.pbd.components()
    assert "axis" not in parts.dims
    np.testing.assert_array_equal(parts.position_y, sheet.position.sel(axis="y"))
    assert {"reference_x", "reference_y"} <= {*parts.coords}
    assert sheet.position.long_name == "position"
    alone = sheet.sel(axis="x")
    assert alone.pbd.components().identical(alone)


def test_stresses_have_units():
    calibrated = {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [HELD, pull_right(0.01, 0.0, 1)],
    }
    asked = [{"type": "stress", "youngs_modulus": 2.0}, {"type": "reaction", "youngs_modulus": 2.0}]
    ds = pbdkit.run(experiment(**calibrated, diagnostics=asked, steps=1), progress=False)
    assert ds.stress_xx.units == "stress unit"
    assert ds.stress_xx.comment == "stress unit: that of youngs_modulus as it is given"
    assert ds.reaction.units == "stress unit * thickness unit * lattice unit"
    assert ds.reaction.comment.endswith("thickness unit: that of thickness as it is given")
    assert "comment" not in ds.position.attrs


def test_plain_concatenation_of_runs():
    runs = [torn(0.2), torn(2.2)]
    assert runs[0].sizes["crack"] != runs[1].sizes["crack"]
    whole = xarray.concat(runs, "run", join="outer", combine_attrs="drop_conflicts")
    for n, run in enumerate(runs):
        assert whole.broken_step.isel(run=n).equals(run.broken_step)
        assert whole.crack_step.isel(run=n).dropna("crack").astype(int).equals(run.crack_step)
    for name in ("i", "j", "role", "reference", "bond_ends", "shell", "site"):
        assert whole[name].identical(runs[0][name]), name
    assert {"experiment"} <= runs[0].attrs.keys() - whole.attrs.keys() <= {"experiment", "created"}


def test_concatenated_runs_contain_their_differences():
    runs = [torn(0.2), torn(1.2), torn(2.2, name="other", leaders=[HELD])]
    whole = pbdkit.concat(runs)
    assert whole.cracks_0_1_1.values.tolist() == [0.2, 1.2, 2.2]
    assert whole.name.values.tolist() == ["small", "small", "other"]
    assert whole.leaders.dims == ("run",)
    assert json.loads(whole.leaders.values[2])[0]["motion"] == {"type": "hold"}
    assert "frame" not in whole.coords
    again = pbdkit.rerun(whole.isel(run=1), progress=False)
    assert again.drop_attrs().identical(runs[1].drop_attrs())
    np.testing.assert_array_equal(again.broken_step, whole.broken_step.isel(run=1))


def test_runs_of_different_bodies_are_concatenated(tmp_path):
    wider = torn(body={"type": "grid", "columns": 7, "rows": 5})
    whole = pbdkit.concat([torn(), wider, torn(fracture={"type": "none"})], "sheet")
    assert whole.columns.values.tolist() == [6, 7, 6]
    assert whole.fracture.values.tolist() == ["threshold", "threshold", "none"]
    np.testing.assert_array_equal(whole.position.isel(sheet=1), wider.position)
    assert whole.position.isel(sheet=0).dropna("particle").sizes["particle"] == 56
    assert whole.broken_step.isel(sheet=2).isnull().all()
    whole.to_netcdf(tmp_path / "whole.nc")
    with xarray.open_dataset(tmp_path / "whole.nc") as opened:
        assert opened.load().equals(whole)


def test_datasets_that_are_no_runs_are_not_concatenated(sheet):
    for runs, said in [
        ([], "there are no runs"),
        ([sheet, sheet.drop_attrs()], "has no experiment"),
    ]:
        with pytest.raises(pbdkit.ExperimentError, match=said):
            pbdkit.concat(runs)
    with pytest.raises(pbdkit.ExperimentError, match="variable or dimension 'time'"):
        pbdkit.concat([sheet], "time")


def test_parameters_are_coordinates_of_a_sweep():
    given = experiment(leaders=[HELD, pull_right(0.3, 0.0)], steps=3)
    vary, keep = {"solver.relaxation": [0.5, 1.0]}, {"variables": ["u"]}
    found = pbdkit.sweep(given, vary=vary, keep=keep, workers=1, progress=False)
    assert found.relaxation.values.tolist() == [0.5, 1.0]
    ones = [pbdkit.run(given | {"solver": {"type": "stepping", "relaxation": r}}, progress=False)
            for r in (0.5, 1.0)]  # fmt: skip
    whole = pbdkit.concat(ones, "relaxation_")
    np.testing.assert_array_equal(whole.u, found.u)
    assert whole.relaxation.values.tolist() == [0.5, 1.0]
    for name in ("i", "j", "role"):
        assert found[name].equals(ones[0][name])


def test_members_of_a_sweep_are_joined_along_their_cracks():
    given = experiment(leaders=[HELD, pull_right(0.3, 0.0, 8)], steps=10,
                       diagnostics=[{"type": "crack-path"}],
                       fracture={"type": "threshold", "thresholds": [1.4]})  # fmt: skip
    found = pbdkit.sweep(
        given, vary={"fracture.thresholds": [[1.4], [9.0]]}, workers=1, progress=False
    )
    assert found.crack_step.dims == ("thresholds", "crack")
    assert found.crack.values.tolist() == list(range(1, found.sizes["crack"] + 1))
    assert found.bond_ends.dims == ("bond", "end")
    assert (found.crack_step.sel(thresholds=1) == found.crack_step.fill_value).all()


def test_unfinished_run_has_the_same_layout(tmp_path, monkeypatch):
    given = pbdkit.Experiment(**experiment(leaders=[HELD, pull_right(0.3, 0.0)], steps=40,
                                           fracture={"type": "threshold", "thresholds": [1.4]},
                                           diagnostics=[{"type": "crack-path"}]))  # fmt: skip
    output, looks = tmp_path / "out.nc", iter(range(100))
    run = Simulation.of_scene(build_scene(given), watch=Watch(lambda: next(looks) >= 5))
    assert record(run, NetcdfSink(output)).outcome.status == "interrupted"
    whole = pbdkit.run(given, progress=False)
    with pbdkit.open(output) as left:
        assert {n: (v.dims, v.dtype, repr(v.attrs)) for n, v in left.variables.items()} == {
            n: (v.dims, v.dtype, repr(v.attrs)) for n, v in whole.variables.items()
        }
        assert {*left.coords} == {*whole.coords}


def test_fields_are_plotted_over_the_components_of_the_reference(sheet):
    np.testing.assert_array_equal(np.stack([sheet.X, sheet.Y], axis=1), sheet.reference)
    assert sheet.X.attrs["units"] == sheet.reference.attrs["units"]
    last = sheet.isel(time=-1)
    dots = last.plot.scatter(x="X", y="Y", hue="pe1")
    np.testing.assert_array_equal(dots.get_offsets(), sheet.reference)
    np.testing.assert_array_equal(np.ma.filled(dots.get_array(), np.nan), last.pe1)


def test_tables_contain_the_variables_of_one_kind_of_objects(sheet):
    table = sheet.pbd.to_dataframe()
    assert len(table) == sheet.sizes["time"] * sheet.sizes["particle"]
    assert not {"number", "broken_step", "reference_x"} & {*table.columns}
    row = table.loc[(10, 20)]
    at = sheet.sel(time=10, particle=20)
    assert row[["X", "Y"]].tolist() == at.reference.values.tolist()
    assert row[["position_x", "position_y"]].tolist() == at.position.values.tolist()
    np.testing.assert_equal(row.pe1, at.pe1.item())
    bonds = sheet.pbd.to_dataframe("bond")
    assert bonds.broken_step.tolist() == sheet.broken_step.values.tolist()
    assert {"crack_step", "crack_midpoint_x"} <= {*sheet.pbd.to_dataframe("crack").columns}
    with pytest.raises(pbdkit.ExperimentError, match="no variable has only the dimension 'load'"):
        sheet.pbd.to_dataframe("load")


def of_rows(rows):
    body = {"type": "grid", "columns": 4, "rows": rows}
    return torn(body=body, diagnostics=[{"type": "pe1"}, {"type": "displacement"}])


def test_runs_of_different_bodies_are_joined_by_sites():
    runs = [of_rows(5), of_rows(7)]
    joined = pbdkit.concat(runs, by="site")
    assert not {"bond", "crack"} & {*joined.dims}
    for n, run in enumerate(runs):
        ours = joined.isel(run=n)
        ours = ours.isel(particle=np.flatnonzero(ours.number.notnull()))
        rows = ours.number.values.astype(int) - 1
        assert sorted(rows) == [*range(run.sizes["particle"])]
        np.testing.assert_array_equal(ours.u, run.u.isel(particle=rows))
        for name in ("i", "j", "X", "Y"):
            np.testing.assert_array_equal(ours[name], run[name][rows])
    assert joined.X.dims == ("particle",)
    assert joined.reference.attrs == runs[0].reference.attrs
    with pytest.raises(pbdkit.ExperimentError, match="expected 'number' or 'site', got 'name'"):
        pbdkit.concat(runs, by="name")


def test_difference_of_different_bodies_is_by_sites():
    small, large = of_rows(5), of_rows(7)
    with pytest.warns(pbdkit.errors.SceneWarning, match=r"is at \(.*\) in the first run and at"):
        difference_of(small, large, "u_x", None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        difference_of(small, small, "u_x", None)
        changed, _ = difference_of(small, large, "u_x", None, "site")
    assert len(changed.particle) == len({*site_keys(small)} & {*site_keys(large)})
    for i, j in ((0, 0), (2, 3)):
        one, two, both = (d.pbd.at(i=i, j=j) for d in (small, large, changed))
        difference = two.u.isel(time=-1) - one.u.isel(time=-1)
        np.testing.assert_array_equal(both.difference, difference)


@pytest.fixture
def old(tmp_path):
    """A file that pbdkit wrote when the layout was that of version 1."""
    path = tmp_path / "old.nc"
    path.write_bytes(gzip.decompress(OLD.read_bytes()))
    return path


@pytest.mark.filterwarnings("ignore:.*(has no seal|made by):pbdkit.PbdkitWarning")
def test_file_of_version_1_has_current_names(old):
    with pbdkit.open(old) as before:
        again = pbdkit.rerun(before, progress=False)
        assert (before.schema_version, again.schema_version) == ("1", "2")
        assert {*before.variables} == {*again.variables}
        assert {*before.coords} == {*again.coords}
        for name, variable in again.variables.items():
            assert (before[name].dims, before[name].dtype) == (variable.dims, variable.dtype)
            assert before[name].attrs.keys() == variable.attrs.keys()
            assert before[name].attrs["long_name"] == variable.attrs["long_name"]
            now = variable.fillna(0.0) if name == "pe1" else variable
            if now.dtype.kind == "f":
                np.testing.assert_allclose(before[name], now, rtol=1e-12, atol=1e-12)
            else:
                np.testing.assert_array_equal(before[name], now)
        in_order = before.broken_step.sel(bond=before.crack_bond)
        np.testing.assert_array_equal(in_order, before.crack_step)


@pytest.mark.filterwarnings("ignore:.*has no seal:pbdkit.PbdkitWarning")
def test_file_of_version_1_can_be_plotted_and_explained(old, call, tmp_path):
    with xarray.open_dataset(old, engine="h5netcdf") as raw:
        before = raw.copy(deep=True)
        assert raw.pbd.at(i=0, j=0).kind.isel(time=0) == 0
        assert raw.pbd.plot(color="pe1", contours=True).get_title() == "old-layout, step 12"
        assert raw.identical(before)
    explained = call("explain", str(old))
    assert explained.out.splitlines()[0] == "fracture threshold: 9 of 49 bonds broke"
    assert call("plot", str(old), "-o", str(tmp_path / "old.png")).code == 0
    refused = call("resume", str(old), "--steps", "20")
    assert (refused.code, "has schema_version 1" in refused.err) == (2, True)
    assert call("verify", str(old)).code == 6
