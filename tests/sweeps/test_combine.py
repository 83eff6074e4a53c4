"""Names of the parameters of a sweep, and one member chosen among all."""

import numpy as np
import pytest

import pbdkit
from pbdkit.model.reading import Source
from pbdkit.plotting.data import shape_of
from pbdkit.sweeps.specification import checked, coordinate
from pbdkit.web.report import SweepContent

PLATE = {
    "name": "plate",
    "units": {"length": "1 mm", "youngs_modulus": "70 GPa", "thickness": "1 mm"},
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "rectangle", "width": 8.0, "height": 4.0},
    "regions": {"steel": {"type": "rectangle", "width": 4.0, "height": 4.0}},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "elastic", "poisson_ratio": {"otherwise": 0.3, "steel": 0.25}},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {"select": {"edge": "right"},
         "motion": {"type": "displace", "displacement": [0.01, 0.0]}},
    ],
    "steps": 1,
    "solver": {"type": "equilibrium"},
    "diagnostics": [{"type": "displacement"}],
}  # fmt: skip
VARY = {
    "rule.poisson_ratio.otherwise": [0.2, 0.3],
    "rule.poisson_ratio.steel": [0.1, 0.2, 0.3],
    "body.width": ["7 mm", "8 mm"],
}


@pytest.fixture(scope="module")
def swept():
    keep = {"variables": ["u"], "times": "last"}
    names = {"body.width": "span"}
    return pbdkit.sweep(PLATE, vary=VARY, keep=keep, names=names, workers=1, progress=False)


def test_parameters_have_names_units_and_their_paths(swept):
    assert swept.status.dims == ("poisson_ratio", "steel", "span")
    said = {name: swept[name].attrs for name in swept.status.dims}
    assert [one["long_name"] for one in said.values()] == [*[*VARY][:2], "span"]
    assert [one["parameter"] for one in said.values()] == [*VARY]
    assert (said["span"]["units"], swept.span.values.tolist()) == ("mm", [7.0, 8.0])


def test_copies_in_mm_are_kept(swept):
    assert {"u", "u_mm"} == {*swept.data_vars} - {"status", "message"}
    np.testing.assert_array_equal(swept.u_mm, swept.u)
    assert swept.u_mm.attrs["units"] == "mm"


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["rule.nu.otherwise", "rule.E.otherwise"], ["nu", "E"]),
        (["rule.nu.steel", "rule.E.steel"], ["nu_steel", "E_steel"]),
        (["leaders.0.until", "leaders.1.until"], ["leaders_0_until", "leaders_1_until"]),
        (["fracture.thresholds.0"], ["thresholds_0"]),
        (["rule.time"], ["rule_time"]),
        (["steps"], ["steps"]),
        (["rule.type", "fracture.type"], ["rule", "fracture"]),
    ],
)
def test_automatic_names_are_the_shortest_meaningful_ones(paths, names):
    from pbdkit.sweeps.specification import names_of

    assert [*names_of(paths, {"time"}).values()] == names


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"body.widht": "span"}, "names: 'body.widht' is not varied; did you mean 'body.width'?"),
        (
            {"body.width": "time"},
            "names: body.width: 'time' has another meaning in results; choose another",
        ),
        ({"body.width": "2a"}, "names.body.width: "),
        ({"body.width": "w", "rule.poisson_ratio.steel": "w"}, "two parameters have the same name"),
    ],
)
def test_invalid_names_are_refused(names, said):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.sweep(PLATE, vary=VARY, names=names, workers=1, progress=False)
    assert said in str(caught.value)


def test_member_equals_the_run_of_its_parameters(swept):
    one = swept.pbd.member(poisson_ratio=0.3, steel=0.2, span=7)
    again = pbdkit.rerun(one, progress=False)
    last = again.u.isel(time=-1)
    np.testing.assert_array_equal(one.u.isel(time=-1).dropna("particle", how="all"), last)
    assert one.attrs["title"] == "sweep of plate, poisson_ratio=0.3, steel=0.2, span=7"
    assert swept.pbd.member(steel=0.2).status.dims == ("poisson_ratio", "span")


@pytest.mark.parametrize(
    ("name", "settings", "path", "values"),
    [
        ("material/hole", {}, "lattice.a", [0.25, 0.5]),
        ("paper/d1", {"steps": 60}, "body.columns", [8, 10]),
    ],
)
def test_member_has_only_the_particles_and_bonds_of_a_plain_run(name, settings, path, values):
    experiment = pbdkit.load(name, settings=settings)
    swept = pbdkit.sweep(experiment, vary={path: values}, workers=1, progress=False)
    for value in values:
        one = swept.pbd.member(**{path.rpartition(".")[2]: value})
        plain = pbdkit.run(experiment, settings={path: value}, progress=False)
        assert dict(one.sizes) == dict(plain.sizes)
        for each, variable in plain.variables.items():
            assert variable.equals(one[each].variable), each


def test_outline_of_a_member_has_the_parameters_of_the_member(swept):
    shape = shape_of(swept.pbd.member(poisson_ratio=0.3, steel=0.2, span=7))
    assert shape.width == 7.0


def test_report_states_why_lattices_are_missing_and_the_units_of_the_map(swept):
    content = SweepContent(swept).within(10**6)
    assert [axis["unit"] for axis in content["grid"]] == ["", "", "mm"]
    (note,) = content["left_out"]
    assert note == ("No lattices are shown: `position` was not kept; add it to `keep.variables`.")


def test_maps_are_drawn_at_rest_without_recorded_positions(swept):
    ax = swept.pbd.member(poisson_ratio=0.3, steel=0.2, span=8).pbd.plot("u_x")
    assert "drawn at rest" in ax.get_title()


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ({"steel": 9}, "steel=9: no member has this value; there are 0.1, 0.2, 0.3"),
        ({"span": "9 mm"}, "span=9 mm: no member has this value; there are 7, 8 mm"),
        ({"span": "7 s"}, "span=7 s: '7 s' is not a value in mm; write for instance mm"),
        (
            {"stel": 1},
            "stel: is not a parameter of this sweep; did you mean 'steel'? (",
        ),
    ],
)
def test_invalid_member_selection_is_refused(swept, choice, said):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        swept.pbd.member(**choice)
    assert said in str(caught.value)


def test_members_are_selected_by_values_with_units(swept):
    assert swept.pbd.member(span="0.7 cm").span == 7.0
    # A parameter in lattice units is converted with the units of the experiment.
    coarse = swept.assign_coords(span=swept.span.assign_attrs(units="lattice unit"))
    assert coarse.pbd.member(span="0.8 cm").span == 8.0


@pytest.mark.parametrize("section", ["vary", "together"])
def test_values_with_units_of_one_kind_have_the_unit_of_the_first(section):
    values = ["7 mm", "1 cm", "0.6 in"]
    sweep = checked({"experiment": PLATE, section: {"body.width": values}}, Source())
    experiment = pbdkit.Experiment.build(Source(data=PLATE))
    found = coordinate("body.width", getattr(sweep, section)["body.width"], experiment, "span")
    assert (found.values.tolist(), found.attributes["units"]) == ([7.0, 10.0, 15.24], "mm")


def test_texts_that_begin_with_numbers_are_no_values_with_units():
    values = ("2 plates", "3 discs")
    sweep = checked({"experiment": PLATE, "vary": {"name": [*values]}}, Source())
    assert sweep.vary["name"] == values


def test_commands_select_a_member(swept, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    swept.to_netcdf("s.nc")
    refused = call("plot", "s.nc", "--color", "u_x")
    assert refused.code == 2
    assert "--at NAME=VALUE, in Python with" in refused.err
    assert "steel: 0.1, 0.2, 0.3; span: 7, 8 mm" in refused.err
    choice = ["--at", "steel=0.2", "--at", "poisson_ratio=0.3", "--at", "span=7"]
    assert call("plot", "s.nc", "--color", "u_x", "--dpi", "50", *choice).code == 0
    assert call("curve", "s.nc", "--y", "u_x", *choice[:2]).code == 0
    without = call("export", "s.nc", *choice)
    assert (without.code, "keep the variable `position`" in without.err) == (2, True)
    wrong = call("explain", "s.nc", "--at", "steel=4")
    assert (wrong.code, "--at steel=4: no member has this value" in wrong.err) == (2, True)
    assert "expected NAME=VALUE" in call("plot", "s.nc", "--at", "steel").err


@pytest.mark.parametrize(
    ("path", "unit"),
    [
        ("fracture.failure", "1"),
        ("fracture.energy", "lattice unit"),
        ("lattice.a", "lattice unit"),
    ],
)
def test_numbers_without_a_unit_are_divided_by_the_modulus(path, unit):
    fracture = {"type": "cohesive", "energy": 0.1, "onset": 0.1}
    if path == "fracture.failure":
        fracture = {"type": "strain", "failure": 0.1}
    rule = {"type": "elastic", "poisson_ratio": 0.3}
    parts = {"rule": rule, "fracture": fracture, "neighbours": {"type": "chebyshev"}}
    experiment = pbdkit.load(
        "paper/a", settings=parts | {"frame": {"type": "natural"}, "diagnostics": []}
    )
    assert coordinate(path, (0.1, 0.2), experiment, "limit").attributes == {
        "long_name": "limit",
        "parameter": path,
        "units": unit,
    }
