"""The first calls of Python users, and the messages of wrong ones."""

import inspect
import pickle
import re
import subprocess
import sys
import warnings

import pytest

import pbdkit

SMALL = ["steps=4", "record.every=2"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("calls") / "a.nc"
    pbdkit.run(pbdkit.load("paper/a", settings=SMALL), progress=False).to_netcdf(path)
    return path


@pytest.fixture(scope="module")
def ds(file):
    import xarray

    return xarray.load_dataset(file)


@pytest.mark.parametrize("order", ["import pbdkit, xarray", "import xarray, pbdkit"])
def test_datasets_opened_by_xarray_have_the_accessor(file, order):
    check = "import sys; ds = xarray.open_dataset(sys.argv[1]); print(ds.pbd.at(i=4, j=5).number)"
    command = [sys.executable, "-c", f"{order}; {check}", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert "number" in done.stdout


def test_import_loads_no_xarray_and_a_search_registers_nothing():
    check = (
        "import sys, pbdkit, importlib.util as u; assert u.find_spec('xarray');"
        "assert 'xarray' not in sys.modules and 'numpy' not in sys.modules;"
        "import xarray; print(hasattr(xarray.Dataset, 'pbd'), len([f for f in sys.meta_path"
        " if type(f).__module__.startswith('pbdkit')]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, timeout=100
    )
    assert (done.stdout.strip(), done.stderr) == ("True 0", "")


@pytest.mark.parametrize("name", ["plot", "compare", "animate", "animation"])
def test_signatures_use_matplotlib_option_names(ds, name):
    parameters = inspect.signature(getattr(ds.pbd, name)).parameters
    assert {"color", "cmap", "vmin", "vmax", "figsize", "dpi"} <= {*parameters}
    assert not any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def test_one_colour_limit_leaves_the_other_automatic(ds):
    bar = ds.pbd.plot("pe1", vmax=7.0).figure.axes[1]
    lowest = float(ds.pe1.isel(time=-1).min())
    assert max(bar.get_xlim(), bar.get_ylim(), key=max) == pytest.approx((lowest, 7.0))


@pytest.mark.parametrize(
    "settings",
    [
        {"steps": 20, "solver": {"relaxation": 0.25}, "leaders": {0: {"until": 7}}},
        {"steps": 20, "solver.relaxation": 0.25, "leaders.0.until": 7},
        ["steps=20", "solver.relaxation=0.25", "leaders.0.until=7"],
    ],
)
def test_settings_are_maps_or_strings_and_change_nothing_else(settings):
    plain = pbdkit.load("paper/a")
    changed = pbdkit.load("paper/a", settings=settings)
    assert (changed.steps, changed.solver.relaxation, changed.leaders[0].until) == (20, 0.25, 7)
    assert (changed.rule, changed.leaders[1:]) == (plain.rule, plain.leaders[1:])
    assert plain.with_settings(settings) == changed
    assert pbdkit.analyse("paper/a", settings=settings).scene.experiment.steps == 20


def test_map_with_a_type_or_a_component_replaces_the_part():
    rule = {"type": "distance-weighted"}
    other = pbdkit.load("paper/a", settings={"rule": rule}).rule
    assert other.type == "distance-weighted"
    assert pbdkit.load("paper/a", settings={"rule": other}).rule == other


def test_a_dataset_returns_its_experiment(ds):
    assert ds.pbd.experiment() == pbdkit.load("paper/a", settings=SMALL)


def test_modified_copies_are_validated_when_they_run():
    experiment = pbdkit.load("modelling/composite-plate")
    again = experiment.model_copy(update={"seed": 3})
    assert again.as_written().data["seed"] == 3
    assert not again.is_as_validated
    wrong = experiment.record.model_copy(update={"every": -1})
    for update, place in (({"steps": -5}, "steps: "), ({"record": wrong}, "record.every: ")):
        with pytest.raises(pbdkit.ExperimentError, match=f"^{place}.*, got -"):
            pbdkit.analyse(experiment.model_copy(update=update))


LIST = "as {'steps': 20}, or a list of texts, as ['steps=20']"
RESULT = (
    "got a dataset, which is a result: `pbdkit.rerun(ds)` runs its experiment again, and `ds.pbd"
)
MISTAKES = {
    "settings: key": (lambda ds: load(settings={"stepz": 20}), "settings: stepz", "'steps'"),
    "settings: value": (lambda ds: load(settings={"steps": -2}), "settings: steps", "equal to 1"),
    "settings: leader": (
        lambda ds: load(settings={"leaders": {9: {"until": 3}}}), "'9' is not an index of",
    ),
    "settings: text": (lambda ds: load(settings="steps"), "setting steps: expected PATH=VALUE"),
    "settings: number": (lambda ds: load(settings=5), "settings: expected a map", LIST, "got 5"),
    "settings: list": (lambda ds: load(settings=[5]), "got 5 in the list", LIST),
    "run of a dataset": (lambda ds: pbdkit.run(ds), "expected an experiment", RESULT),
    "identify of a dataset": (lambda ds: pbdkit.identify(ds), RESULT),
    "sweep of a dataset": (lambda ds: pbdkit.sweep(ds), RESULT),
    "load of a dataset": (lambda ds: pbdkit.load(ds), "load: expected a file or the name", RESULT),
    "load of a dict": (lambda ds: pbdkit.load({}), "pass it to `pbdkit.run` directly"),
    "run of a number": (lambda ds: pbdkit.run(5), "of type int", "shipped experiment as 'paper/a'"),
    "run of a class": (lambda ds: pbdkit.run(pbdkit.FollowerRule), "got a class; give a file"),
    "rerun of a file": (lambda ds: pbdkit.rerun("a.nc"), "pbdkit.open('a.nc') returns that of"),
    "open of a dataset": (lambda ds: pbdkit.open(ds), "open: expected the path of a result"),
    "concat of one": (lambda ds: pbdkit.concat(ds), "expected a list", "write concat([a, b])"),
    "compare with a file": (lambda ds: ds.pbd.compare("b.nc"), "pbdkit.open('b.nc') returns that"),
    "variable misspelt": (lambda ds: ds.pbd.plot("pe_1"), "'pe_1' cannot be drawn", "mean 'pe1'?"),
    "variable not recorded": (
        lambda ds: ds.pbd.plot("stress_xx"), "'stress_xx' was not recorded", "{type: stress,",
    ),
    "family not recorded": (lambda ds: ds.pbd.plot("stress"), "'stress' was not", "{type: stress,"),
    "curve not recorded": (lambda ds: ds.pbd.curve("contact"), "add {type: contact"),
    "component not recorded": (lambda ds: ds.pbd.plot("u_x"), "add {type: displacement}"),
    "time first": (lambda ds: ds.pbd.plot(4, "pe1"), "color: expected the name", "as time=400"),
    "variable as time": (lambda ds: ds.pbd.plot("pe1", "pe1"), "time: expected a recorded step"),
    "no such step": (lambda ds: ds.pbd.plot("pe1", 3), "step 3 was not", "recorded: 2 and 4"),
    "no such map": (lambda ds: ds.pbd.plot("pe1", cmap="virdis"), "'virdis'", "mean 'viridis'?"),
    "one size": (lambda ds: ds.pbd.plot(figsize=5), "figsize: expected a width and a height in in"),
    "limit": (lambda ds: ds.pbd.plot("pe1", vmin="a"), "vmin: expected a finite number, got 'a'"),
    "limits": (lambda ds: ds.pbd.plot("pe1", vmin=2, vmax=1), "vmin 2 is not below vmax 1; "),
    "file first": (lambda ds: ds.pbd.animate("a.gif", "pe1"), "write animate('pe1', file='a.gif')"),
    "no file": (lambda ds: ds.pbd.animate("pe1"), "write animate('pe1', file='movie.mp4')"),
    "no particle": (lambda ds: ds.pbd.history("pe1"), "write history('pe1', particle=67), or i=4"),
    "particle first": (lambda ds: ds.pbd.history(67), "history: expected the name", "particle=67"),
}  # fmt: skip


def load(**more):
    return pbdkit.load("paper/a", **more)


@pytest.mark.parametrize("name", MISTAKES)
def test_errors_have_place_cause_and_remedy(ds, name):
    call, *words = MISTAKES[name]
    with pytest.raises(pbdkit.PbdkitError) as caught:
        call(ds)
    assert [word for word in words if word not in str(caught.value)] == []


def test_prefix_suggests_all_matching_names(ds):
    for draw in (ds.assign(heat_in=ds.pe1, heat_out=ds.pe1).pbd.plot, ds.assign(heat_in=ds.time,
                 heat_out=ds.time).pbd.curve):  # fmt: skip
        with pytest.raises(pbdkit.ExperimentError, match="mean 'heat_in' or 'heat_out'"):
            draw("heat")


def test_run_into_a_file_equals_the_output_of_the_command(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ds = pbdkit.run("paper/a", settings=SMALL, output="a.nc", progress=False)
    assert call("run", "paper/a", "--set", SMALL[0], "--set", SMALL[1], "-o", "b.nc").code == 0
    assert ds.drop_attrs(deep=False).identical(pbdkit.open("b.nc").drop_attrs(deep=False))
    assert call("verify", "a.nc").code == 0
    with pytest.raises(pbdkit.ExperimentError, match=r"^a.nc: exists; force=True replaces it"):
        pbdkit.run("paper/a", output="a.nc", progress=False)
    other = pbdkit.run("paper/a", settings={"steps": 2}, output="a.nc", force=True, progress=False)
    assert other.time.values[-1] == pbdkit.open("a.nc").time.values[-1] == 2
    longer = pbdkit.resume("a.nc", steps=4, progress=False)
    assert longer.time.values[-1] == 4


def test_a_dataset_is_saved_as_a_sealed_result(ds, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    some = ds.isel(time=[0, -1])
    path = some.pbd.save("some.nc")
    assert call("verify", "some.nc").code == 0
    assert pbdkit.open(path).identical(some)
    with pytest.raises(pbdkit.ExperimentError, match=r"^some.nc: exists; force=True repl"):
        some.pbd.save("some.nc")
    pbdkit.open(path).isel(time=[0]).pbd.save("some.nc", force=True)
    assert pbdkit.open(path).sizes["time"] == 1
    with pytest.raises(pbdkit.ExperimentError, match=r"'axis', which .* use `to_netcdf`"):
        ds[["pe1"]].pbd.save("part.nc")
    with pytest.raises(pbdkit.StorageError):
        ds.pbd.save(tmp_path / "nowhere" / "a.nc")
    assert [p.name for p in tmp_path.glob("*.nc")] == ["some.nc"]


def test_warnings_are_silenced_individually(tensile):
    """A body with growing waves and an unused region has a warning of the class of each."""
    parts = tensile | {"solver": {"type": "stepping", "relaxation": 2.5}, "steps": 2}
    parts["regions"] = {"nowhere": {"type": "disc", "radius": 1.0, "centre": [4.5, 4.5]}}
    with pytest.warns(pbdkit.PbdkitWarning) as told:
        pbdkit.run(parts, progress=False)
    kinds = {w.category.__name__: str(w.message) for w in told}
    assert kinds["StabilityWarning"].startswith("solver.relaxation: 2.5 can diverge")
    assert kinds["SceneWarning"].startswith("regions.nowhere: not referenced")
    with warnings.catch_warnings(record=True) as left:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", pbdkit.errors.StabilityWarning)
        pbdkit.run(parts, progress=False)
    assert {w.category for w in left} == {pbdkit.errors.SceneWarning}


def test_every_warning_has_a_class_of_its_subject():
    for name in pbdkit.errors.__all__:
        if name.endswith("Warning"):
            assert issubclass(getattr(pbdkit.errors, name), pbdkit.PbdkitWarning)
    text = pbdkit.errors.WarningText("doubtful", pbdkit.errors.AccuracyWarning)
    again = pickle.loads(pickle.dumps(text))
    assert (again, again.category) == ("doubtful", pbdkit.errors.AccuracyWarning)


def test_sweeps_take_only_keywords(tensile):
    with pytest.raises(TypeError, match="takes 1 positional argument but 2 were given"):
        pbdkit.sweep(tensile, {"steps": [1, 2]})


def test_representations_of_analyses_and_identities_are_readable(tensile):
    known = str(pbdkit.analyse(tensile))
    assert known.startswith("analysis of tensile\n  stability ")
    assert re.search(r"^  converges +to 1e-3 in \d+, .* steps$", known, re.M)
    identity = str(pbdkit.identify("material/bar"))
    assert identity.startswith("material/bar: elastic, ")
    assert re.search(r"^  Poisson", identity, re.M | re.I)
