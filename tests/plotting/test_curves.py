"""Histories, curves and cracks show the numbers of the dataset, under labels that can be read."""

import csv
import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from property_cases import experiment, pull_right

import pbdkit
from pbdkit.plotting import curves, data as series
from pbdkit.plotting.style import label

plt = pytest.importorskip("matplotlib.pyplot")
HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
FORCES = [
    {"type": "reaction", "youngs_modulus": 2.0},
    {"type": "strain-energy", "youngs_modulus": 2.0},
    {"type": "displacement"},
    {"type": "track", "numbers": [9, 10]},
    {"type": "stress-strain", "youngs_modulus": 2.0, "width": 4.0, "group": 1, "against": 0},
]
MM = {"units": {"length": "2 mm", "youngs_modulus": "70 GPa", "thickness": "1 mm"}}
CALIBRATED = {
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
}


def run(**parts):
    return pbdkit.run(experiment(**parts), progress=False)


@pytest.fixture(scope="module")
def torn():
    """A sheet with a crack from the start, pulled apart in step 5 and cut in step 9."""
    cracks = [[[2.5, -2.0], [2.5, 0.2]]]
    return run(
        leaders=[HELD, pull_right(0.3, 0.0, 8)],
        fracture={"type": "threshold", "thresholds": [1.9], "cracks": cracks},
        cuts=[{"from": [1.5, -0.5], "to": [1.5, 2.5], "at": 9}],
        diagnostics=[{"type": t} for t in ("pe1", "pe1-intact", "pe2", "broken")],
        steps=20,
    )


@pytest.fixture(scope="module")
def pulled():
    """An elastic sheet with its right edge, leader group 1, pulled to the left and up."""
    return run(
        **CALIBRATED, leaders=[HELD, pull_right(-0.02, 0.005, 4)], diagnostics=FORCES, steps=8
    )


@pytest.fixture(scope="module")
def swept():
    return pbdkit.sweep(
        experiment(leaders=[HELD, pull_right(0.1, 0.0)], diagnostics=[{"type": "pe1"}], steps=6),
        vary={"solver.relaxation": [0.4, 0.7, 1.0]},
        workers=1,
        progress=False,
    )


def drawn(ax):
    return [line.get_xydata().T for line in ax.lines]


def legend_texts(ax):
    legend = ax.get_legend()
    return [" ".join(t.get_text().split()) for t in legend.get_texts()] if legend else []


def texts(figure):
    """Return all visible texts, with their boxes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    FigureCanvasAgg(figure).draw()
    found = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    ticks = {
        t for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)
        for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        for t in (tick.label1, tick.label2) if not _shown(tick, axis)
    }  # fmt: skip
    return [(t.get_text(), t.get_window_extent()) for t in found if t not in ticks]


def _shown(tick, axis):
    low, high = sorted(axis.get_view_interval())
    return low <= tick.get_loc() <= high


def refuse_bad_layout(ax):
    """No text lies on another or is cut by the figure's edge."""
    figure = ax.get_figure(root=True)
    boxes, whole = texts(figure), figure.bbox
    for text, box in boxes:
        assert whole.x0 - 1 <= box.x0 <= box.x1 <= whole.x1 + 1, text
        assert whole.y0 - 1 <= box.y0 <= box.y1 <= whole.y1 + 1, text
    for (a, one), (b, other) in combinations(boxes, 2):
        assert not one.padded(-1).overlaps(other.padded(-1)), (a, b)


# Histories


def test_history_matches_the_dataset(torn):
    ax = torn.pbd.history("pe1", particle=[19, 20])
    for line, number in zip(drawn(ax), (19, 20), strict=True):
        np.testing.assert_array_equal(line, [torn.time, torn.pe1.sel(particle=number)])
    i, j = torn.site.sel(particle=19).values
    assert legend_texts(ax)[0] == f"19 (i {i}, j {j})"
    (line,) = drawn(torn.pbd.history("pe1", i=i, j=j))
    np.testing.assert_array_equal(line[1], torn.pe1.sel(particle=19))
    assert (ax.get_xlabel(), ax.get_ylabel()) == (
        "time (step)",
        "pseudo-energy PE1 (lattice unit²)",
    )


def test_displacements_are_available_whether_recorded_or_not(torn, pulled):
    for ds in (torn, pulled):
        u = ds.position - ds.reference
        ax = ds.pbd.history(particle=20)
        across, up = drawn(ax)
        np.testing.assert_allclose(across[1], u.sel(particle=20, axis="x"), atol=1e-15)
        np.testing.assert_allclose(up[1], u.sel(particle=20, axis="y"), atol=1e-15)
        assert [line.get_linestyle() for line in ax.lines] == ["-", "--"]
        assert [name[-3:] for name in legend_texts(ax)] == [", x", ", y"]
        assert ax.get_ylabel() == "displacement (lattice unit)"
        (alone,) = drawn(ds.pbd.history("u_y", particle=20))
        np.testing.assert_array_equal(alone, up)


def test_tracks_have_every_step():
    ds = run(diagnostics=[{"type": "track", "numbers": [9, 10]}], record={"every": 10}, steps=20,
             leaders=[HELD, pull_right(0.1, 0.0)])  # fmt: skip
    lines = drawn(ds.pbd.history("track_x"))
    assert [len(line[0]) for line in lines] == [21, 21]
    (one,) = drawn(ds.pbd.history("track_x", particle=10))
    np.testing.assert_array_equal(one[1], ds.track.sel(tracked=10, axis="x"))


def test_lines_of_particles_have_colours_and_a_colorbar_if_many(torn):
    few = torn.pbd.history("pe1", j=2)
    assert len({line.get_color() for line in few.lines}) == len(few.lines) > 5
    many = torn.pbd.history("pe1", particle=torn.number.values[10:40])
    assert many.get_legend() is None
    assert many.figure.axes[1].get_ylabel() == "number of the particle"


SHORT = [
    "solver.increments=1",
    "body.columns=13",
    "cuts=[{from: [-1.0, 5.5], to: [3.25, 5.5]}]",
]
"""Settings of a shorter double cantilever."""


def test_bonds_have_a_history(torn):
    a, b = torn.bond_ends.values[torn.broken_step.values > 0][0]
    (line,) = drawn(torn.pbd.history(bond=(b, a)))
    x = torn.position.sel(particle=[a, b]).diff("particle").squeeze("particle")
    np.testing.assert_allclose(line[1], np.hypot(*x.values.T) - 1.0, atol=1e-12)
    damaged = pbdkit.run(pbdkit.load("modelling/double-cantilever", settings=SHORT), progress=False)
    row = int(np.flatnonzero(damaged.broken_step > 0)[0])
    (line,) = drawn(damaged.pbd.history("damage_left", bond=damaged.bond_ends.values[row]))
    np.testing.assert_array_equal(line[1], damaged.damage_left.isel(bond=row))


def test_crack_of_a_part_of_a_body_is_between_its_particles(torn):
    part = torn.isel(particle=np.flatnonzero(torn.i.values > 1))
    ends = torn.bond_ends.values[torn.broken_step.values >= 0]
    there = np.isin(ends, part.number.values).all(axis=1)
    of_body = (torn.role.values[ends - 1] == 0).all(axis=1)
    assert 0 < (there & of_body).sum() < of_body.sum()
    (line,) = drawn(part.pbd.crack("bonds"))
    assert line[1].max() == (there & of_body).sum()
    with pytest.raises(pbdkit.ExperimentError, match="the dataset does not contain both particles"):
        torn.isel(particle=[0, 1]).pbd.crack()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({}, "expected a particle; write history('u', particle=67), or i=4, j=5"),
        ({"particle": 999}, "there is no particle 999; the dataset has 56 particles"),
        ({"particle": 3, "i": 1}, "either by number or by i and j, not by both"),
        ({"i": 77, "j": 1}, "there is no particle at i=77, j=1"),
        ({"name": "broken_bonds", "particle": 3}, "no values at particles; `pbdkit curve OUT"),
        ({"name": "stress_xx", "particle": 3}, "add {type: stress, youngs_modulus: ...} to"),
        ({"name": "pe11", "particle": 3}, "did you mean 'pe1'?"),
        ({"bond": (1, 2, 3)}, "given by two numbers of particles, got [1, 2, 3]"),
        (
            {"name": "pe1", "bond": (19, 20)},
            ("bonds have no history of 'pe1'; available: ['strain']"),
        ),
        ({"name": "track"}, "add {type: track, numbers: ...} to `diagnostics`"),
    ],
)
def test_variables_without_history_are_refused(torn, asked, said):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        torn.pbd.history(**asked)
    assert said in str(caught.value)


# Curves


def test_force_against_displacement_of_a_leader_group(pulled):
    ax = pulled.pbd.curve(kind="load-displacement")
    (line,) = drawn(ax)
    np.testing.assert_allclose(line[0], 0.02 * np.minimum(pulled.time, 4), atol=1e-14)
    np.testing.assert_array_equal(line[1], -pulled.reaction.sel(leader_group=1, axis="x"))
    assert ax.get_xlabel().replace("\n", " ").startswith("displacement of leader group 1 along −x")
    (other,) = drawn(pulled.pbd.curve(kind="load-displacement", group=0))
    np.testing.assert_array_equal(other[0], 0.0)


def test_force_against_displacement_of_a_load():
    loaded = run(
        **CALIBRATED, leaders=[HELD], steps=5,
        loads=[{"select": {"edge": "right"}, "force": [1e-3, 0.0]}],
        diagnostics=[{"type": "load-displacement", "youngs_modulus": 2.0}],
    )  # fmt: skip
    (line,) = drawn(loaded.pbd.curve())
    across = {"load": 0, "axis": "x"}
    np.testing.assert_array_equal(line[0], loaded.load_displacement.sel(across))
    np.testing.assert_array_equal(line[1], loaded.load_resultant.sel(across))


def test_force_against_depth_of_an_obstacle():
    """It stays where it was last once it is gone."""
    disc = {"type": "disc", "radius": 4.0, "centre": [2.5, 8.0]}
    motion = {"type": "velocity", "velocity": [0.0, -0.01], "steps": 9}
    pressed = run(
        **CALIBRATED, steps=9, leaders=[{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}],
        obstacles=[{"shape": disc, "motion": motion, "until": 6}],
        diagnostics=[{"type": "contact", "youngs_modulus": 2.0}],
    )  # fmt: skip
    (line,) = drawn(pressed.pbd.curve())
    np.testing.assert_allclose(line[0], 0.01 * np.minimum(pressed.time, 6), atol=1e-14)
    np.testing.assert_array_equal(line[1], -pressed.contact_force.sel(obstacle=0, axis="y"))


def test_stress_against_strain(pulled):
    ax = pulled.pbd.curve()
    (line,) = drawn(ax)
    np.testing.assert_array_equal(line, [pulled.nominal_strain, pulled.nominal_stress])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("nominal strain", "nominal stress (stress unit)")


def test_curves_are_in_physical_units_if_known():
    pytest.importorskip("pint")
    strip = pbdkit.run("modelling/strip", progress=False)
    ax = strip.pbd.curve(kind="load-displacement")
    (line,) = drawn(ax)
    np.testing.assert_allclose(line[0][-1], 0.1, rtol=1e-9)  # mm, as in the experiment
    assert ax.get_xlabel().endswith("(mm)")
    assert ax.get_ylabel().endswith("(N)")


def test_energies_are_sums_over_the_body(torn, pulled):
    ax = torn.pbd.curve(kind="energies")
    assert [name.replace(", sum over the body", "") for name in legend_texts(ax)] == [
        "pseudo-energy PE1", "pseudo-energy PE1 of intact bonds",
    ]  # fmt: skip
    body = torn.isel(particle=torn.role.values == 0)
    np.testing.assert_allclose(drawn(ax)[0][1], body.pe1.sum("particle"), rtol=1e-12)
    (energy,) = drawn(pulled.pbd.curve(kind="energies"))
    np.testing.assert_array_equal(energy[1], pulled.strain_energy)


def test_any_number_against_another(torn, pulled):
    (line,) = drawn(torn.pbd.curve(y="broken_bonds"))
    np.testing.assert_array_equal(line, [torn.time, torn.broken_bonds])
    (alone,) = drawn(torn.pbd.curve("broken_bonds"))
    np.testing.assert_array_equal(alone, line)
    (line,) = drawn(torn.pbd.curve("broken_bonds", "pe2"))
    np.testing.assert_allclose(line[1], torn.pe2.where(torn.role == 0).mean("particle"), rtol=1e-12)
    (line,) = drawn(pulled.pbd.curve("strain_energy", "reaction_x", group=1))
    np.testing.assert_array_equal(line[1], pulled.reaction.sel(leader_group=1, axis="x"))


def test_summed_variables_are_read_in_blocks(torn, monkeypatch):
    whole = drawn(torn.pbd.curve(y="pe1"))
    monkeypatch.setattr(series, "BLOCK_BYTES", 1)
    np.testing.assert_allclose(drawn(torn.pbd.curve(y="pe1")), whole, rtol=1e-14)


def test_curves_draw_into_given_axes(pulled):
    figure, (left, right) = plt.subplots(1, 2)
    assert pulled.pbd.curve(ax=left) is left
    assert pulled.pbd.history(particle=20, ax=right) is right
    assert len(left.lines) == 1
    plt.close(figure)


def test_crack_maps_keep_their_legend_within_given_axes(torn):
    figure, ax = plt.subplots()
    assert torn.pbd.crack(ax=ax) is ax
    assert legend_texts(ax) == ["broken from the start"]
    plt.close(figure)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"kind": "stress-strain"}, "add {type: stress-strain, youngs_modulus: ..., width: ...}"),
        ({"kind": "load-displacement"}, "{type: load-displacement, youngs_modulus: ...} for loads"),
        (
            {"kind": "speed"},
            "there is no curve 'speed'; use one of stress-strain, load-displacement",
        ),
        ({"y": "pe1", "kind": "energies"}, "give either y or the kind 'energies', not both"),
        ({"y": "position"}, "'position' is a vector; use one of 'position_x', 'position_y'"),
        ({"y": "strain_energy"}, "add {type: strain-energy, youngs_modulus: ...} to `diagnostics`"),
        ({"y": "reaction_x"}, "add {type: reaction, youngs_modulus: ...} to `diagnostics`"),
    ],
)
def test_data_without_a_curve_are_refused(torn, asked, said):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        torn.pbd.curve(**asked)
    assert said in str(caught.value)


def test_ambiguous_group_must_be_selected(pulled):
    with pytest.raises(
        pbdkit.ExperimentError, match="0, 1: several are recorded; select one by --group"
    ):
        pulled.pbd.curve(y="reaction_x")
    with pytest.raises(pbdkit.ExperimentError, match="there is no leader group 7; there are 0, 1"):
        pulled.pbd.curve(kind="load-displacement", group=7)


@pytest.mark.parametrize(
    "draw",
    [lambda ds: ds.pbd.curve(), lambda ds: ds.pbd.history(particle=20), lambda ds: ds.pbd.crack()],
)
def test_without_matplotlib_the_extra_is_named(torn, draw, monkeypatch):
    monkeypatch.setattr("pbdkit.errors.find_spec", lambda name: None)
    with pytest.raises(pbdkit.ExperimentError, match=r"pip install 'pbdkit\[plot\]'"):
        draw(torn)


# Sweeps


def test_sweep_has_one_line_per_member(swept):
    ax = swept.pbd.curve(kind="energies")
    assert legend_texts(ax) == ["relaxation 0.4", "relaxation 0.7", "relaxation 1"]
    for line, relaxation in zip(drawn(ax), swept.relaxation, strict=True):
        np.testing.assert_allclose(line[1], swept.pe1.sel(relaxation=relaxation).sum("particle"))
    ax = swept.pbd.history("u_x", particle=20)
    assert legend_texts(ax) == ["relaxation 0.4", "relaxation 0.7", "relaxation 1"]
    many = swept.isel(relaxation=np.arange(15) % 3).assign_coords(relaxation=np.arange(15.0))
    ax = many.pbd.curve(y="pe1")
    assert len(ax.lines) == 15
    assert ax.figure.axes[1].get_ylabel() == "relaxation"


@pytest.mark.parametrize(("units", "name"), [("MPa", "0.4 MPa"), ("lattice unit", "0.4")])
def test_names_of_members_have_the_unit_of_the_parameter(swept, units, name):
    ds = swept.assign_coords(relaxation=swept.relaxation.assign_attrs(units=units))
    (first, *_) = curves.lines_of(ds, ds.time, ds.pe1.sum("particle"))
    assert first.name == f"relaxation {name}"


def test_loads_of_a_sweep_have_one_line_per_member():
    loaded = experiment(
        **CALIBRATED, leaders=[HELD], steps=5,
        loads=[{"select": {"edge": "right"}, "force": [0.0, -1e-3]}],
        diagnostics=[{"type": "load-displacement", "youngs_modulus": 2.0}],
    )  # fmt: skip
    found = pbdkit.sweep(loaded, vary={"solver.relaxation": [0.5, 1.0]}, workers=1, progress=False)
    ax = found.pbd.curve()
    assert legend_texts(ax) == ["relaxation 0.5", "relaxation 1"]
    across = {"load": 0, "axis": "y", "relaxation": 0.5}
    np.testing.assert_array_equal(drawn(ax)[0][1], -found.load_resultant.sel(across))


def test_leader_curves_of_a_sweep_are_those_of_its_members(call, tmp_path):
    led = experiment(**CALIBRATED, **MM, leaders=[HELD, pull_right(0.01, 0.0)], steps=2,
                     diagnostics=[{"type": "reaction"}])  # fmt: skip
    values = [0.5, 1.0]
    found = pbdkit.sweep(led, vary={"solver.relaxation": values}, workers=1, progress=False)
    ax = found.pbd.curve()
    assert legend_texts(ax) == ["relaxation 0.5", "relaxation 1"]
    alone = [drawn(found.pbd.member(relaxation=value).pbd.curve())[0] for value in values]
    np.testing.assert_array_equal(drawn(ax), alone)
    assert np.ptp(alone, axis=0).max() > 0.0
    found.to_netcdf(tmp_path / "s.nc")
    assert call("curve", str(tmp_path / "s.nc"), "-o", "s.csv").out == "s.csv written\n"
    heading, *rows = csv.reader(Path("s.csv").read_text().splitlines())
    assert heading == ["relaxation", "displacement of leader group 1 along x (mm)",
                       "force of leader group 1 along x (N)"]  # fmt: skip
    points = [
        [value, *point] for value, line in zip(values, alone, strict=True) for point in line.T
    ]
    np.testing.assert_array_equal(np.array(rows, float), points)


def test_histories_are_tables_with_a_row_for_each_point(torn):
    chart = curves.history_chart(torn, "u", [8, 9], (None, None), None)
    heading, *rows = csv.reader(chart.csv().splitlines())
    assert heading == ["line", "time (step)", "displacement (lattice unit)"]
    names = [line.name for line in chart.lines]
    assert [*dict.fromkeys(row[0] for row in rows)] == names
    assert len(names) == 4
    u = [float(row[2]) for row in rows if row[0] == names[1]]
    np.testing.assert_array_equal(u, torn.position[:, 7, 1] - torn.reference[7, 1])


def test_tables_contain_no_negative_zero(torn):
    chart = curves.history_chart(torn, "u", [8], (None, None), None)
    chart.lines[0].y[0] = -0.0
    assert chart.csv().splitlines()[1].endswith(",0,0")


def test_map_of_a_crack_is_not_a_table(call, torn):
    torn.pbd.save("torn.nc")
    assert "cannot be written as CSV" in call("curve", "torn.nc", "crack", "-o", "crack.csv").err
    assert call("curve", "torn.nc", "broken-bonds", "-o", "b.csv").code == 0
    last = Path("b.csv").read_text().splitlines()[-1]
    assert last == f"20,{(torn.broken_step >= 0).sum().item()}"


def test_variables_that_a_sweep_did_not_keep_are_no_damage(call, tmp_path):
    led = experiment(**CALIBRATED, leaders=[HELD, pull_right(0.01, 0.0)], steps=2,
                     diagnostics=[{"type": "reaction", "youngs_modulus": 2.0}])  # fmt: skip
    found = pbdkit.sweep(
        led, vary={"solver.relaxation": [0.5, 1.0]}, keep={"variables": ["reaction"]}, workers=1,
        progress=False,
    )  # fmt: skip
    file = str(tmp_path / "s.nc")
    found.to_netcdf(file)
    at = ["--at", "relaxation=0.5"]
    curve = call("curve", file, "load-displacement", *at)
    assert (curve.code, "damaged" in curve.err) == (2, False)
    assert "load-displacement requires `position`" in curve.err
    strain = call("curve", file, "--bond", "1", "2", *at)
    assert (strain.code, "damaged" in strain.err) == (2, False)
    assert "requires `number`, which the sweep did not keep; add `position` to kee" in strain.err
    whole = call("curve", file, "load-displacement")
    assert (whole.code, "load-displacement requires `position`" in whole.err) == (2, True)
    force = call("curve", file, "--y", "reaction_x", *at)
    assert (force.code, "select one by --group 1, in Python by group=1" in force.err) == (2, True)


def test_members_are_labelled_by_the_types_of_their_components():
    rules = [{"type": "barycentre"}, {"type": "mean-displacement"}]
    found = pbdkit.sweep(
        experiment(leaders=[HELD, pull_right(0.1, 0.0)], diagnostics=[{"type": "pe1"}], steps=2),
        vary={"rule": rules}, workers=1, progress=False,
    )  # fmt: skip
    assert legend_texts(found.pbd.curve(y="pe1")) == ["rule barycentre", "rule mean-displacement"]


# Cracks


def test_axes_of_a_crack_are_in_mm_with_units(torn):
    scaled = torn.copy()
    scaled["reference"].attrs |= {"physical_units": "mm", "physical_factor": 1.27}
    ax = scaled.pbd.crack()
    ax.figure.canvas.draw()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "y (mm)")
    texts = [float(text.get_text().replace("−", "-")) for text in ax.get_xticklabels()]
    assert texts == ax.get_xticks().tolist()
    assert np.diff(texts).tolist() == [1.0] * (len(texts) - 1)
    (line,) = ax.lines
    assert line.get_xdata().max() == pytest.approx(1.27 * torn.reference[:, 0].max() - 1.27)


def test_crack_is_drawn_as_its_broken_bonds(torn):
    ax = torn.pbd.crack()
    old, new = sorted(ax.collections, key=lambda c: c.get_array() is not None)
    body = (torn.role.sel(particle=torn.bond_ends) == 0).all("end")
    for part, which in ((old, torn.broken_step == 0), (new, torn.broken_step > 0)):
        X = torn.reference.sel(particle=torn.bond_ends[(which & body).values]).values
        np.testing.assert_array_equal(
            sorted(np.array(part.get_segments()).tolist()), sorted(X.tolist())
        )
    steps = torn.broken_step.values[((torn.broken_step > 0) & body).values]
    np.testing.assert_array_equal(np.sort(new.get_array()), np.sort(steps))


def test_crack_length_and_broken_bonds_over_steps(torn):
    body = (torn.role.sel(particle=torn.bond_ends) == 0).all("end").values
    steps = torn.broken_step.values[body]
    (count,), (length,) = (drawn(torn.pbd.crack(kind)) for kind in ("bonds", "length"))
    for step in range(21):
        at = np.searchsorted(count[0], step, side="right") - 1
        assert count[1][at] == ((steps >= 0) & (steps <= step)).sum()
        # One bond from the start; in step 5 the whole height, four bonds apart at most.
        assert length[1][at] == pytest.approx(0.0 if step < 5 else 4.0)


def test_lengths_of_separate_cracks_are_not_added():
    cracks = [[[2.5, -0.5], [2.5, 1.5]], [[12.5, 3.4], [12.5, 4.6]]]
    two = run(columns=16, steps=1, fracture={"type": "threshold", "thresholds": [9.0],
                                             "cracks": cracks})  # fmt: skip
    (length,) = drawn(two.pbd.crack("length"))
    assert length[1][-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("of", "kind", "said"),
    [
        ("pulled", "map", "no bond can break in this run; add `fracture` or `cuts`"),
        ("torn", "paths", "'paths' is not a picture of a crack; use one of map, length, bonds"),
    ],
)
def test_data_without_a_crack_are_refused(of, kind, said, request):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        request.getfixturevalue(of).pbd.crack(kind)
    assert said in str(caught.value)


def test_without_broken_bonds_nothing_is_drawn():
    whole = run(steps=1, fracture={"type": "threshold", "thresholds": [9.0]})
    with pytest.raises(pbdkit.ExperimentError, match="there is no crack to draw: no bond broke"):
        whole.pbd.crack()


# Layout


LAYOUTS = {
    "energies": ("torn", lambda ds: ds.pbd.curve(kind="energies")),
    "load-displacement": ("pulled", lambda ds: ds.pbd.curve(kind="load-displacement")),
    "stress-strain": ("pulled", lambda ds: ds.pbd.curve()),
    "mean": ("pulled", lambda ds: ds.pbd.curve(y="position_x")),
    "history": ("torn", lambda ds: ds.pbd.history(particle=[19, 20])),
    "line": ("torn", lambda ds: ds.pbd.history("pe1", j=2)),
    "many": ("torn", lambda ds: ds.pbd.history("pe1", particle=range(1, 40))),
    "bond": ("torn", lambda ds: ds.pbd.history(bond=(19, 20))),
    "crack": ("torn", lambda ds: ds.pbd.crack()),
    "crack-length": ("torn", lambda ds: ds.pbd.crack("length")),
    "sweep": ("swept", lambda ds: ds.pbd.curve()),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_text_overlaps_or_is_clipped(name, request):
    of, draw = LAYOUTS[name]
    refuse_bad_layout(draw(request.getfixturevalue(of)))


@pytest.mark.parametrize(("columns", "rows"), [(60, 3), (3, 60), (200, 6), (6, 200)])
def test_cracks_of_long_bodies_keep_their_text_apart(columns, rows):
    cracks = [[[1.5, -0.5], [1.5, 1.2]]]
    long = run(columns=columns, rows=rows, steps=1,
               fracture={"type": "threshold", "thresholds": [9.0], "cracks": cracks})  # fmt: skip
    refuse_bad_layout(long.pbd.crack())


def test_labels_are_wrapped_outside_formulas():
    long = label("force of leader group 1", "stress unit * thickness unit * lattice unit", width=34)
    assert max(map(len, long.splitlines())) <= 34
    assert "stress unit × thickness unit" in long
    assert label("a $b$", "lattice unit^2") == r"a \$b\$ (lattice unit²)"
    assert label("strain", "1") == "strain"
    assert label("sum of all over the body", "", width=20) == "sum of all\nover the body"


# The command


def test_one_command_draws_all_of_them(call, tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "DPI", 40)  # fewer pixels take less time to write
    monkeypatch.chdir(tmp_path)
    assert call("run", "paper/d1", "--set", "steps=20", "-o", "d.nc", "--quiet").code == 0
    named = {
        (): "d-curve.png",
        ("--y", "broken_bonds"): "d-broken_bonds.png",
        ("--particle", "67", "--particle", "68"): "d-history.png",
        ("--y", "pe1", "--particle", "67"): "d-history-pe1.png",
        ("history", "--y", "track"): "d-history.svg",
        ("crack",): "d-crack.png",
        ("broken-bonds",): "d-broken-bonds.png",
    }
    for asked, name in named.items():
        more = [] if name.endswith(".png") else ["-o", name]
        assert call("curve", "d.nc", *asked, *more).out == f"{name} written\n"
        assert (tmp_path / name).stat().st_size > 1000
    assert "exists; --force replaces it" in call("curve", "d.nc", "crack").err
    refused = call("curve", "d.nc", "stress-strain")
    assert refused.code == 2
    assert "d.nc: a stress-strain curve requires the diagnostic stress-strain" in refused.err


def test_the_command_draws_sweeps(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = experiment(leaders=[HELD, pull_right(0.1, 0.0)], diagnostics=[{"type": "pe1"}], steps=3)
    sweep = {"version": 1, "experiment": parts, "vary": {"solver.relaxation": [0.5, 1.0]}}
    (tmp_path / "s.json").write_text(json.dumps(sweep))
    assert call("sweep", "s.json", "--workers", "1", "--quiet").code == 0
    assert call("curve", "s/sweep.nc", "energies", "-o", "s.png").code == 0
    assert (tmp_path / "s.png").stat().st_size > 1000
