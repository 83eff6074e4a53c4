"""Pictures of bodies: nothing is clipped or overprinted, for any shape, and colours have their
meaning."""

import functools
import re
from dataclasses import fields
from inspect import Parameter, signature
from itertools import combinations
from pathlib import Path as FilePath
from typing import get_type_hints

import numpy as np
import pytest
import xarray
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit import ExperimentError

pytest.importorskip("matplotlib")

from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.text import Text

from pbdkit.plotting import animate, animation, compare, plot, plot_experiment
from pbdkit.plotting.data import Trajectory, cells_of, distance_from, outline, whole
from pbdkit.plotting.layers import PixelGrid
from pbdkit.plotting.style import PlotKeywords, PlotOptions

HOLD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
SIDEWAYS = {"type": "velocity", "velocity": [0.3, 0.1], "steps": 10}
WHOLE = {"type": "coordination", "shells": 1}


def pulled(name, lattice, body, neighbours=WHOLE, **more):
    """A body held on the left, of which one particle is pulled away."""
    given = {"lattice": lattice, "body": body, "neighbours": neighbours, **more}
    ds = pbdkit.run(
        {
            "name": name,
            "rule": {"type": "barycentre"},
            "leaders": [HOLD, {"select": {"nearest": [[1e3, 1e3]]}, "motion": SIDEWAYS}],
            "steps": 12,
            "diagnostics": [{"type": "pe1"}, {"type": "displacement"}],
            "fracture": {"type": "threshold", "thresholds": [2.5]},
            **given,
        },
        progress=False,
    )
    assert ds.attrs["status"] == "complete"
    return ds


SQUARE, HEXAGONAL = {"type": "square", "a": 1.0}, {"type": "hexagonal", "a": 0.5}
RING = {"type": "ring", "inner": 4.0, "outer": 9.0, "centre": [0.0, 0.0]}
MADE = {
    "120 x 4": lambda: pulled("flat", SQUARE, {"type": "grid", "columns": 120, "rows": 4}),
    "4 x 120": lambda: pulled("tall", SQUARE, {"type": "grid", "columns": 4, "rows": 120}),
    "50 x 50": lambda: pulled("a/plate", SQUARE, {"type": "grid", "columns": 50, "rows": 50}),
    "few": lambda: pulled("few", SQUARE, {"type": "grid", "columns": 3, "rows": 1}),
    "ring": lambda: pulled("a-ring-with-a-long-name" * 5, HEXAGONAL, RING),
}


@pytest.fixture(scope="module")
def bodies():
    """Each made when first wanted."""
    found = {}

    def body(name):
        if name not in found:
            found[name] = MADE[name]()
        return found[name]

    return body


@pytest.fixture(scope="module")
def torn():
    return pbdkit.run(pbdkit.load("paper/f2", settings=["steps=20"]), progress=False)


def drawn_texts(figure, monkeypatch):
    """Return all texts of a figure, with their boxes in pixels."""
    found, draw = [], Text.draw

    def drawing(self, renderer):
        if self.get_visible() and self.get_text().strip():
            found.append((self.get_text(), self.get_window_extent(renderer)))
        draw(self, renderer)

    with monkeypatch.context() as patch:
        patch.setattr(Text, "draw", drawing)
        figure.canvas.draw()
    return found


def faults(figure, monkeypatch):
    """Texts and axes beyond the edge of a figure, and pairs of texts over one another."""
    page, texts = figure.bbox, drawn_texts(figure, monkeypatch)
    boxes = texts + [(f"axes {ax.get_label()}", ax.get_window_extent()) for ax in figure.axes]
    clipped = [
        name
        for name, box in boxes
        if min(box.x0, box.y0) < -0.5 or box.x1 > page.x1 + 0.5 or box.y1 > page.y1 + 0.5
    ]
    panels = [(f"axes {ax.get_label()}", ax.get_window_extent()) for ax in figure.axes]
    over = [
        (a, b)
        for (a, one), (b, other) in combinations(texts, 2)
        if min(one.x1, other.x1) - max(one.x0, other.x0) > 0.5
        and min(one.y1, other.y1) - max(one.y0, other.y0) > 0.5
    ]
    apart = [
        (a, b)
        for (a, one), (b, other) in combinations(panels, 2)
        if min(one.x1, other.x1) > max(one.x0, other.x0)
        and min(one.y1, other.y1) > max(one.y0, other.y0)
    ]
    return clipped + over + apart


def figure_of(axes):
    return (axes[0] if isinstance(axes, list) else axes).get_figure(root=True)


LOOKS = {
    "kinds": {},
    "a field or dots": {"color": "u_x"},
    "7 panels": {"color": "u", "time": range(7)},
    "bonds in a given size": {"color": "broken_step", "figsize": (4.0, 9.0)},
    "two in a given size": {"time": [0, 12], "figsize": (7.0, 6.5)},
    "numbers": {"numbers": True},
}
TRIED = [
    (name, look)
    for n, name in enumerate(("120 x 4", "4 x 120", "few"))
    for m, look in enumerate(LOOKS)
    if AT_LENGTH or (n + m) % 3 == 1
]
TRIED += [("50 x 50", "7 panels"), ("50 x 50", "kinds"), ("ring", "bonds in a given size")]
TRIED += [("ring", "a field or dots"), ("ring", "two in a given size")]


@pytest.mark.parametrize(("name", "look"), TRIED)
def test_nothing_is_clipped_or_overlaps(bodies, name, look, monkeypatch):
    axes = plot(bodies(name), **LOOKS[look], dpi=100)
    assert faults(figure_of(axes), monkeypatch) == []
    for ax in axes if isinstance(axes, list) else [axes]:  # a body's shape is that of its panel
        box, (left, right), (low, high) = ax.get_window_extent(), ax.get_xlim(), ax.get_ylim()
        assert box.width / (right - left) == pytest.approx(box.height / (high - low), rel=0.02)


def test_labels_with_units_fit_the_space(monkeypatch):
    strip = pbdkit.run("modelling/strip", progress=False)
    axes = plot(strip, "stress_xx")
    assert faults(figure_of(axes), monkeypatch) == []
    assert axes.get_title() == "modelling/strip, step 1"
    said = " ".join(" ".join(text.split()) for text, _ in drawn_texts(axes.figure, monkeypatch))
    assert "x (mm)" in said
    left, right = axes.get_xlim()
    assert (left, right) == pytest.approx((0.0, 100.0), abs=6.0)
    assert "stress, xx component (MPa)" in said


def test_plots_are_in_the_units_of_the_user():
    coarse = ["units.length=2 mm"]
    plate = pbdkit.run(pbdkit.load("modelling/composite-plate", settings=coarse), progress=False)
    drawn, again = (
        plot(ds, color="u_x", filled=True, dpi=80) for ds in (plate, plate.pbd.physical())
    )
    assert figure_of(drawn).texts[0].get_text() == "x (mm)"
    (bar,) = [ax for ax in figure_of(drawn).axes if ax is not drawn]
    assert bar.get_ylabel() == "displacement, along x (mm)"
    image, same = image_of(drawn), image_of(again)
    assert image.get_clim()[1] == pytest.approx(float(plate.u_mm.sel(axis="x").max()))
    np.testing.assert_allclose(image.get_extent(), same.get_extent())
    holes = [np.isnan(one.get_array().filled(np.nan)) for one in (image, same)]
    np.testing.assert_array_equal(*holes)
    middle = np.mean(image.get_extent()[:2])
    assert middle == pytest.approx(30.0, abs=0.5)  # of 60 mm


def image_of(ax):
    """The pixels of a field, and the colour of nothing."""
    (image,) = ax.get_images()
    return image


def test_fields_of_both_signs_are_neutral_at_zero(bodies):
    ds = bodies("50 x 50")
    signed = ds.assign(stress_xx=ds.pe1 - 0.3 * float(ds.pe1.max()))
    image = image_of(plot(signed, "stress_xx", dpi=50))
    low, high = image.get_clim()
    assert low == -high
    assert image.cmap.name == "RdBu_r" or np.allclose(image.cmap(0.5)[:3], 0.97, atol=0.01)
    one = image_of(plot(signed, "stress_xx", vmin=-0.1, vmax=0.3, dpi=50))
    assert one.get_clim() == (-0.1, 0.3)
    neutral = one.cmap(one.norm(0.0))
    assert np.allclose(neutral[:3], 0.97, atol=0.02)
    above = image_of(plot(ds, "pe1", dpi=50))
    below = image_of(plot(ds.assign(pe1=-ds.pe1), "pe1", dpi=50))
    assert (above.get_clim()[0], below.get_clim()[1]) == (0.0, 0.0)
    assert above.cmap(0.0) == below.cmap(1.0)


def test_all_panels_share_scale_and_extent(torn):
    axes = plot(torn, "pe1_intact", [0, 10, 20])
    assert len({ax.collections[-1].get_clim() for ax in axes}) == 1
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in axes}) == 1
    assert [ax.get_title() for ax in axes] == ["step 0", "step 10", "step 20"]
    given = plot(torn, "pe1_intact", [0, 20], vmin=0.0, vmax=5.0, cmap="magma")
    assert {ax.collections[-1].get_clim() for ax in given} == {(0.0, 5.0)}
    assert {ax.collections[-1].get_cmap().name for ax in given} == {"magma"}


def test_every_panel_has_contents():
    """At the last step of a sheet that came to rest there is next to nothing to see in colour."""
    last = pbdkit.load("paper/a", settings=["record={at: [10, 400]}"])
    sheet = pbdkit.run(last, progress=False)
    for ax in plot(sheet, "pe1", [10, 400], contours=True):
        pixels = image_of(ax).get_array()
        assert np.isfinite(np.ma.filled(pixels, np.nan)).mean() > 0.3


@pytest.mark.parametrize(
    ("color", "expected", "said"),
    [
        ("u", lambda ds: np.hypot(*ds.u.values.T), "length of displacement"),
        ("u_x", lambda ds: ds.u.sel(axis="x"), "displacement, along x"),
        ("u_y", lambda ds: ds.u.sel(axis="y"), "displacement, along y"),
        ("reference_y", lambda ds: ds.reference.sel(axis="y"), "reference position, along y"),
        ("i", lambda ds: ds.i, "site index i"),
        ("pe1", lambda ds: ds.pe1, "pseudo-energy PE1"),
    ],
)
def test_colours_match_values(bodies, color, expected, said):
    ds = bodies("50 x 50")
    ax = plot(ds, color, 6, filled=False)
    dots = next(c for c in ax.collections if isinstance(c, PathCollection))
    order = np.argsort([*map({2: 0, 1: 1, 0: 2}.get, ds.kind.sel(time=6).values)], kind="stable")
    wanted = np.asarray(expected(ds.sel(time=6)), float)[order]
    np.testing.assert_allclose(np.ma.filled(dots.get_array(), np.nan), wanted)
    np.testing.assert_array_equal(dots.get_offsets(), ds.position.sel(time=6).values[order])
    label = ax.figure.axes[-1].get_ylabel() or ax.figure.axes[-1].get_xlabel()
    assert said in " ".join(label.split())


def test_bonds_show_their_step_of_breaking_and_broken_ones_are_dashed(torn):
    shown = int(((torn.broken_step >= 0) & (torn.broken_step <= 8)).sum())
    ax = plot(torn, "broken_step", 8)
    whole_lines, values = (c for c in ax.collections if isinstance(c, LineCollection))
    assert len(values.get_segments()) == shown > 0
    assert len(whole_lines.get_segments()) == torn.sizes["bond"] - shown
    assert values.get_array().max() <= 8
    kinds = plot(torn, time=8, broken=True, outline=True)
    dashed = [c for c in kinds.collections if isinstance(c, LineCollection)][1]
    assert len(dashed.get_segments()) == shown
    assert dashed.get_linestyle()[0][1] is not None


def test_overlapping_numbers_are_thinned(bodies, monkeypatch):
    few = {t for t, _ in drawn_texts(plot(bodies("few"), numbers=True).figure, monkeypatch)}
    assert {str(n) for n in bodies("few").number.values} <= few
    ax = plot(bodies("120 x 4"), numbers=True, figsize=(7.0, 2.0))
    written = [t for t, _ in drawn_texts(ax.figure, monkeypatch) if t.isdigit()]
    assert 10 < len(written) < bodies("120 x 4").sizes["particle"] / 4


REFUSED = {
    "not recorded": ({"time": 7000}, "step 7000 was not recorded; the nearest recorded: 20"),
    "no time": ({"time": []}, "a figure requires at least one time"),
    "misspelt": (
        {"color": "pe1_intat"},
        "'pe1_intat' cannot be drawn; did you mean 'pe1_intact'? drawable: position, ",
    ),
    "component": ({"color": "position_z"}, "did you mean 'position_"),
    "not measured": ({"color": "u_x"}, "add {type: displacement} to `diagnostics`"),
    "of nothing": ({"color": "track"}, "'track' cannot be drawn"),
    "field of names": ({"contours": True}, "contours require values at particles"),
    "field of bonds": ({"color": "broken_step", "filled": True}, "contours require values at"),
    "dots and contours": (
        {"color": "pe1", "filled": False, "contours": True},
        ("require filled=True"),
    ),
    "limits": (
        {"color": "pe1", "vmin": 2.0, "vmax": 1.0},
        "vmin 2 is not below vmax 1; exchange them",
    ),
    "map": (
        {"color": "pe1", "cmap": "virids"},
        "'virids' is not a colour map of matplotlib; did you mean",
    ),
    "size": (
        {"figsize": (0.0, 3.0)},
        "a height in inches, each above 0 and at most 100; got (0.0, 3",
    ),
    "no room": ({"figsize": (0.4, 0.4)}, "figsize: 0.4 by 0.4 inches are too small for 1 panels"),
    "dpi": ({"dpi": 5}, "dpi: 5 is not between 10 and 2400"),
    "axes": ({"time": [0, 1], "ax": []}, "expected one axes for each of 2 steps, got 0"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unplottable_data_are_refused(torn, name):
    look, message = REFUSED[name]
    with pytest.raises(ExperimentError) as refused:
        plot(torn, **look)
    assert message in str(refused.value)


def test_missing_bonds_are_refused(tensile):
    ds = pbdkit.run(tensile | {"fracture": {"type": "none"}, "diagnostics": []}, progress=False)
    for look in ({"bonds": True}, {"broken": True}):
        with pytest.raises(ExperimentError, match="the dataset has no bonds to draw"):
            plot(ds, **look)


def test_data_without_positions_are_refused(torn):
    with pytest.raises(ExperimentError, match="keep the variable `position`"):
        torn.drop_vars(["position", "reference"]).pbd.plot()
    with pytest.raises(ExperimentError, match="there are no positions to draw: all are NaN"):
        torn.assign(position=torn.position * np.nan).pbd.plot()


def test_result_without_kinds_is_drawn_by_a_variable(torn):
    unkind = torn.drop_vars("kind")
    pictures = [ds.pbd.plot("pe1", filled=False) for ds in (torn, unkind)]
    assert len({max(len(c.get_offsets()) for c in ax.collections) for ax in pictures}) == 1
    message = "the kinds of particles, which are drawn by default, were not recorded; .*: .*pe1"
    with pytest.raises(ExperimentError, match=message):
        unkind.pbd.plot()


def test_variable_without_attributes_is_labelled_with_its_name(torn):
    silent = torn.assign(pe1=torn.pe1.assign_attrs(long_name="", units=""))
    bar = silent.pbd.plot(color="pe1", vmin=0.0, vmax=1.0).figure.axes[1]
    assert bar.get_ylabel() == "pe1"


def test_one_of_several_runs_must_be_selected(tensile):
    kinds = ["barycentre", "mean-displacement"]
    swept = pbdkit.sweep(tensile, vary={"rule.type": kinds}, workers=1)
    with pytest.raises(ExperimentError) as refused:
        swept.pbd.plot()
    dimension = next(d for d in swept.position.dims if d not in ("time", "particle", "axis"))
    assert f"({dimension}: 2); select one" in str(refused.value)
    assert f"ds.isel({dimension}=0).pbd.plot(...)" in str(refused.value)
    assert swept.isel({dimension: 1}).pbd.plot().get_title().endswith(f"step {swept.time[-1]:d}")


def test_part_of_a_dataset_is_plotted(torn):
    left = torn.isel(particle=torn.reference.sel(axis="x").values < 5, time=[3, 8])
    ax = left.pbd.plot(color="pe1")
    assert ax.get_title() == "paper/f2, step 8"
    assert ax.get_xlim()[1] < 12
    assert torn.isel(time=8).pbd.plot(color="broken_step").get_title() == "paper/f2, step 8"


def test_fields_end_at_the_outline_and_scales_exclude_the_outside():
    """Cells that the outline cuts are drawn, with the mean of the corners that have a value."""
    hole = {"type": "disc", "radius": 2.6, "centre": [5.0, 4.0]}
    plate = {"type": "rectangle", "width": 10.0, "height": 8.0}
    ds = pbdkit.run(
        {
            "name": "hole",
            "lattice": {"type": "square", "a": 1.0},
            "body": {"type": "difference", "of": [plate, hole]},
            "neighbours": {"type": "chebyshev"},
            "rule": {"type": "elastic", "poisson_ratio": 0.3},
            "frame": {"type": "natural"},
            "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
            "loads": [{"select": {"edge": "right"}, "force": [1e-6, 0.0]}],
            "steps": 1,
            "solver": {"type": "equilibrium"},
            "diagnostics": [{"type": "stress", "youngs_modulus": 1.0}],
        },
        progress=False,
    )
    distance = np.hypot(*(ds.reference - [5.0, 4.0]).values.T)
    np.testing.assert_array_equal(ds.inside, distance >= 2.6)
    image = image_of(ds.pbd.plot(color="stress_von_mises", filled=True))
    assert image.get_clim()[1] == pytest.approx(float(ds.stress_von_mises.max()))
    pixels = np.ma.filled(image.get_array(), np.nan)
    left, right, bottom, top = image.get_extent()

    def drawn(x, y):
        row, column = (y - bottom) / (top - bottom), (x - left) / (right - left)
        return np.isfinite(pixels[int(row * pixels.shape[0]), int(column * pixels.shape[1])])

    assert drawn(5.0, 6.8)  # between the outline at 6.6 and the next line of particles
    assert drawn(2.1, 4.0)
    assert not drawn(5.0, 4.0)


CHEBYSHEV = {"type": "chebyshev", "shells": 1}
PLATE = {"type": "rectangle", "width": 12.3, "height": 8.0, "origin": [-0.2, 0.0]}
NOTCH = {"type": "polygon", "vertices": [[7.4, -1.0], [9.8, -1.0], [8.55, 5.3]]}
CLIPPED = {
    "hole": (CHEBYSHEV, SQUARE, [PLATE, {"type": "disc", "radius": 2.3, "centre": [3.6, 4.4]}]),
    "notch": (WHOLE, {"type": "hexagonal", "a": 0.8}, [PLATE, NOTCH]),
    "dogbone": (CHEBYSHEV, SQUARE, [{"type": "dogbone", "length": 24.0, "width": 9.0,
                "gauge_length": 10.0, "gauge_width": 5.6, "radius": 8.0}]),
}  # fmt: skip


FILLET = 8.0 * np.arccos(1 - 1.7 / 8.0), np.sqrt(8.0**2 - 6.3**2)
LENGTHS = {
    "hole": 2 * (12.3 + 8.0) + 2 * np.pi * 2.3,
    "notch": 2 * (12.3 + 8.0) - 5.3 / 6.3 * 2.4 + np.hypot(1.15, 6.3) * 5.3 / 6.3
    + np.hypot(1.25, 6.3) * 5.3 / 6.3,
    "dogbone": 2 * (9.0 + 10.0 + 2 * FILLET[0] + (14.0 - 2 * FILLET[1])),
}  # fmt: skip
PLAIN = {"name": "plain", "lattice": SQUARE, "rule": {"type": "barycentre"}, "steps": 1}


@functools.cache
def cut_body(name):
    neighbours, lattice, parts = CLIPPED[name]
    given = {"rule": {"type": "elastic", "poisson_ratio": 0.3}, "frame": {"type": "natural"},
             "fracture": {"type": "none"}}  # fmt: skip
    body = {"type": "difference", "of": parts} if len(parts) > 1 else parts[0]
    return pulled(name, lattice, body, neighbours, **given), body


def bent(x):
    """Places where a body is stretched, sheared and turned, and the way back."""
    a = np.array([[1.3, 0.25], [-0.35, 0.9]])
    return x @ a.T + [3.0, -1.0], lambda y: (y - [3.0, -1.0]) @ np.linalg.inv(a).T


@pytest.mark.parametrize("name", CLIPPED)
def test_fields_end_at_the_deformed_outline(name):
    ds, body = cut_body(name)
    assert not ds.inside.all()
    moved, back = bent(ds.reference.values)
    ds = ds.isel(time=[0]).assign(position=ds.position.isel(time=[0]).copy(data=moved[None]))
    ax = plot(ds, color="reference_x", filled=True, figsize=(6, 4.5), dpi=60)
    image = np.asarray(image_of(ax).get_array().filled(np.nan))
    left, right, low, high = image_of(ax).get_extent()
    pixel = (right - left) / image.shape[1]
    x = left + pixel * (np.arange(image.shape[1]) + 0.5)
    y = low + (high - low) / image.shape[0] * (np.arange(image.shape[0]) + 0.5)
    at = back(np.stack(np.meshgrid(x, y), axis=-1))
    shape = pbdkit.Experiment(**PLAIN | {"body": body}).body
    distance = distance_from(shape, at)
    clear = np.abs(distance) > 4 * pixel  # the distance of a dogbone is along y
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    loops = [Path(corners).contains_points(places) for corners in clip_of(ax).to_polygons()]
    inside = np.logical_xor.reduce(loops)
    drawn = np.isfinite(image) & inside.reshape(image.shape)
    np.testing.assert_array_equal(drawn[clear], distance[clear] < 0)
    shown = clear & (distance < 0)
    np.testing.assert_allclose(image[shown], at[shown][:, 0], atol=3 * pixel)
    assert (~clear).mean() < 0.1


@pytest.mark.parametrize("name", CLIPPED)
def test_the_outline_at_rest_is_that_of_the_body(name):
    ds, body = cut_body(name)
    ax = plot(ds, "reference_x", 0, outline=True, dpi=50)
    sides = np.array(
        [c for c in ax.collections if isinstance(c, LineCollection)][-1].get_segments()
    )
    shape = pbdkit.Experiment(**PLAIN | {"body": body}).body
    away = np.abs(distance_from(shape, sides.reshape(-1, 2)))
    assert np.quantile(away, 0.98) < 0.01
    assert away.max() < 0.1  # a corner within a part of a cell
    length = np.hypot(*(sides[:, 1] - sides[:, 0]).T).sum()
    # Of the notch a cell at its tip is left out, as it would connect both sides.
    assert length == pytest.approx(LENGTHS[name], rel=0.02)


def test_missing_values_outside_the_outline_cause_no_jumps():
    ds, _ = cut_body("hole")
    values = np.where(ds.inside, ds.reference[:, 0], np.nan)
    ds = ds.isel(time=[0]).assign(seen=("particle", values))
    image = np.asarray(image_of(plot(ds, color="seen", filled=True)).get_array().filled(np.nan))
    jumps = np.abs(np.diff(image, axis=0))
    assert np.nanmax(jumps) < 0.1


def test_plots_draw_into_given_axes(torn):
    figure = Figure((8, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    assert plot(torn, "pe1", [0, 20], ax=axes)[0] is axes[0]
    assert torn.pbd.plot(time=8, ax=Figure().add_subplot()).get_title() == "paper/f2, step 8"
    assert isinstance(torn.pbd.plot(time=[0, 8]), Figure)


def test_two_runs_side_by_side_share_scale_and_extent(torn):
    other = pbdkit.run(pbdkit.load("paper/f1", settings=["steps=8"]), progress=False)
    one, two = compare(torn, other, "pe1_intact", 8)
    assert one.get_xlim() == two.get_xlim()
    assert one.collections[-1].get_clim() == two.collections[-1].get_clim()
    assert [ax.get_title() for ax in (one, two)] == ["paper/f2, step 8", "paper/f1, step 8"]


def test_difference_matches_particles_by_number(bodies):
    ds = bodies("50 x 50")
    more = ds.assign(pe1=ds.pe1 + ds.reference.sel(axis="x"))
    some = ds.isel(particle=ds.reference.sel(axis="x").values < 30)
    ax = compare(some, more, color="pe1", difference=True, filled=False)
    dots = ax.collections[-1]
    body = dots.get_array().compressed()
    assert len(body) == int((some.role == 0).sum())
    assert ax.get_title() == "a/plate less a/plate, step 12"
    np.testing.assert_allclose(body, dots.get_offsets()[~dots.get_array().mask][:, 0], atol=1e-9)
    moved = compare(ds.isel(time=[0]), ds, difference=True)  # of positions, about the rest
    assert moved.get_title() == "a/plate less a/plate, step 12"
    with pytest.raises(ExperimentError, match="have no particle in common"):
        compare(ds.isel(particle=[0]), ds.isel(particle=[1]), color="pe1", difference=True)
    with pytest.raises(ExperimentError, match="of particles, but 'broken_step' is one of bonds"):
        compare(ds, ds, color="broken_step", difference=True)


def test_field_has_the_value_of_its_place_and_holes_stay_empty():
    """Test a linear quantity, on cells larger and smaller than pixels; a cell is left out."""
    for count in (4, 9, 60, 300):
        site = np.stack(np.meshgrid(*2 * [np.arange(count + 1)], indexing="ij"), -1).reshape(-1, 2)
        x = site / count + 0.05 * np.sin(3 * site[:, ::-1] / count)
        cells = cells_of(site, site.astype(float))
        assert cells.shape == (count**2, 4)
        gone = count // 2 * count + count // 2
        grid = PixelGrid((-0.2, 1.2, -0.2, 1.2), 140, 140)
        corners, value = grid.places(x), (2 * x[:, 0] - x[:, 1]).astype(np.float32)
        found = grid.mean(corners[cells], value[cells])
        row, column = np.nonzero(np.isfinite(found))
        at = 2 * (column + 0.5) / 100 - 0.4 - (row + 0.5) / 100 + 0.2
        assert np.abs(found[row, column] - at).max() < 0.03
        middle = found[40:100, 40:100]
        assert np.isfinite(middle).all()
        if count <= 9:
            kept = np.delete(cells, gone, axis=0)
            less = grid.mean(corners[kept], value[kept])
            hole = np.isfinite(found) & np.isnan(less)
            assert hole.sum() == pytest.approx(1e4 / count**2, rel=0.3)


@pytest.mark.parametrize(
    "corners",
    [
        [(0.813, 0.282), (0.273, 0.745), (0.732, 0.811), (0.732, 0.811)],
        [(0.1, 0.1), (0.6, 0.3), (0.9, 0.9), (0.4, 0.7)],
    ],
)
def test_no_pixel_within_a_sheared_cell_is_missed(corners):
    size, places = 59, np.array(corners, np.float32)
    grid = PixelGrid((0.0, 1.0, 0.0, 1.0), size, size)
    field = grid.mean(grid.places(places)[None], np.ones((1, 4)))
    y, x = np.mgrid[:size, :size] + 0.5
    inside = np.ones((size, size), bool)
    shape = list(dict.fromkeys(map(tuple, places * size)))
    middle = np.mean(shape, axis=0)
    for (ax, ay), (bx, by) in zip(shape, shape[1:] + shape[:1], strict=True):
        normal = np.array([ay - by, bx - ax]) / np.hypot(bx - ax, by - ay)
        normal *= np.sign(normal @ (middle - (ax, ay)))
        inside &= normal[0] * (x - ax) + normal[1] * (y - ay) > 1.0
    assert inside.sum() > 100
    assert np.isfinite(field[inside]).all()


def test_cells_with_a_broken_side_are_excluded_from_field_and_outline():
    site = np.stack(np.meshgrid(*2 * [np.arange(4)], indexing="ij"), -1).reshape(-1, 2)
    cells = cells_of(site, site.astype(float))
    kept = cells[whole(cells, np.array([[5, 6]]), 16)]
    assert len(kept) == 7
    assert len(outline(cells, 16)) == 12
    assert len(outline(kept, 16)) == 16
    leaning = site + np.array([0.5, 0.0]) * site[:, 1:]  # a lattice of triangles
    assert len(cells_of(site, leaning)) == 18


def test_only_plotted_parts_of_a_file_are_read(tmp_path, call, monkeypatch):
    """Draw one step of five and one field of three."""
    given = {"name": "some", "lattice": SQUARE, "body": {"type": "grid", "columns": 30, "rows": 30}}
    more = {"rule": {"type": "barycentre"}, "steps": 4, "leaders": [HOLD], "neighbours": WHOLE}
    given |= more | {"diagnostics": [{"type": "pe1"}, {"type": "pe2"}, {"type": "displacement"}]}
    monkeypatch.chdir(tmp_path)
    pbdkit.run(given, progress=False).to_netcdf("some.nc")
    read = []
    load = xarray.Dataset.load
    monkeypatch.setattr(
        xarray.Dataset,
        "load",
        lambda ds: read.append((dict(ds.sizes), {*ds.data_vars})) or load(ds),
    )
    with xarray.open_dataset("some.nc", decode_times=False) as ds:
        ds.pbd.plot(time=2, color="u_x")
    ((sizes, names),) = read
    assert sizes["time"] == 1
    assert names == {"position", "kind", "u"}


def test_figures_belong_to_pyplot_if_it_is_in_use(tmp_path):
    """So that scripts and notebooks show them; a movie leaves none behind."""
    plt = pytest.importorskip("matplotlib.pyplot")
    ds = pbdkit.run(pbdkit.load("paper/a", settings=["steps=3"]), progress=False)
    before = len(plt.get_fignums())
    ax = ds.pbd.plot()
    assert ax.figure.number in plt.get_fignums()
    assert ds.pbd.history(particle=67).figure.number in plt.get_fignums()
    ds.pbd.animate(file=tmp_path / "a.gif", every=2, dpi=40)
    assert len(plt.get_fignums()) == before + 2


def test_rounding_errors_of_the_last_step_are_drawn_as_zero():
    ds = pbdkit.run(pbdkit.load("paper/a", settings=["steps=3"]), progress=False)
    noise = np.random.default_rng(1).normal(size=ds.pe1.shape)
    noise[-1] *= 1e-13
    ds["stress"] = ds.pe1.copy(data=noise)
    dots = next(c for c in plot(ds, "stress").collections if isinstance(c, PathCollection))
    assert (dots.norm.vmin, dots.norm.vmax) == (0.0, 1.0)
    bar = dots.figure.axes[-1]
    assert bar.get_ylabel().replace("\n", " ").endswith(": zero within rounding")
    for options in ({"limits": "each"}, {"time": 2}):
        dots = next(
            c for c in plot(ds, "stress", **options).collections if isinstance(c, PathCollection)
        )
        assert dots.norm.vmin < 0.0
    ds["stress"][-1] *= 100.0
    dots = next(c for c in plot(ds, "stress").collections if isinstance(c, PathCollection))
    assert 0.0 < dots.norm.vmax < 1e-10


WINDOW = (1.5, 5.5, -0.5, 3.5)


def test_window_limits_picture_colours_and_legend():
    ds = pbdkit.run(pbdkit.load("paper/a", settings=["steps=3"]), progress=False)
    ax = plot(ds, "reference_x", window=WINDOW)
    assert (*ax.get_xlim(), *ax.get_ylim()) == WINDOW
    dots = next(c for c in ax.collections if isinstance(c, PathCollection))
    assert dots.norm.vmin <= 2.0 < 5.0 <= dots.norm.vmax < 6.0
    legend = plot(ds, window=WINDOW).figure.legends[0]
    assert [text.get_text() for text in legend.get_texts()] == ["follower"]
    assert plot_experiment(pbdkit.load("paper/a"), window=WINDOW).get_xlim() == WINDOW[:2]
    with pytest.raises(pbdkit.ExperimentError, match="the body extends from -1 to 1"):
        plot(ds, window=(50, 60, 0, 1))
    with pytest.raises(pbdkit.ExperimentError, match="window: expected left, right, bottom and"):
        plot(ds, window=(5, 1, 0, 1))


@pytest.mark.parametrize("verb", [plot, compare, animate, animation], ids=lambda v: v.__name__)
def test_plots_share_documented_keyword_options(verb):
    """An editor completes them, with types; `numbers` is not legible in movies."""
    options = {part.name: part.type for part in fields(PlotOptions)}
    keywords = get_type_hints(PlotKeywords)
    assert keywords == {n: hint for n, hint in get_type_hints(PlotOptions).items() if n in options}
    with pytest.raises(TypeError, match="no argument 'colormap'; did you mean 'cmap'"):
        verb(None, colormap="magma")
    if verb in (animate, animation):
        del options["numbers"]
    parameters = signature(verb).parameters
    assert {n: p.annotation for n, p in parameters.items() if n in options} == options
    assert all(parameters[name].kind is Parameter.KEYWORD_ONLY for name in options)
    assert all(p.kind is not Parameter.VAR_KEYWORD for p in parameters.values())
    page = (FilePath(__file__).parents[2] / "docs" / "pictures.md").read_text()
    assert not [name for name in options if f"--{name}" not in page and f"{name}=" not in page]
    sections = re.findall(r"^    ([a-z, ]+) : ", plot.__doc__, re.M)
    assert not {*options} - {name for names in sections for name in names.split(", ")}


def clip_of(ax):
    """The line to which the field is clipped, in the coordinates of the axes."""
    return image_of(ax).get_clip_path().get_transformed_path_and_affine()[0]


def area_of(path):
    return sum(
        0.5 * (p[:-1, 0] * p[1:, 1] - p[1:, 0] * p[:-1, 1]).sum()
        for p in path.to_polygons(closed_only=True)
    )


AREAS = {
    "hole": 12.3 * 8.0 - np.pi * 2.3**2,
    "notch": 12.3 * 8.0 - 0.5 * 2.4 * (5.3 / 6.3) * 5.3,
}


@pytest.mark.parametrize("name", AREAS)
def test_the_clipped_field_has_the_area_of_the_deformed_outline(name):
    ds, body = cut_body(name)
    moved, back = bent(ds.reference.values)
    ds = ds.isel(time=[0]).assign(position=ds.position.isel(time=[0]).copy(data=moved[None]))
    clip = clip_of(plot(ds, "reference_x", filled=True, dpi=40))
    determinant = 1.3 * 0.9 + 0.25 * 0.35
    assert area_of(clip) == pytest.approx(determinant * AREAS[name], rel=0.005)
    shape = pbdkit.Experiment(**PLAIN | {"body": body}).body
    assert distance_from(shape, back(clip.vertices)).max() < 0.05  # at the tip of the notch


def test_cracks_are_gaps_of_the_clipped_field_and_inverted_cells_are_not_clipped(torn):
    recording = Trajectory(torn, "pe1")
    (snapshot,) = recording.snapshots([recording.row(8)])
    body = recording.body
    corners = snapshot.position[body.cells[body.whole_cells(body.cells, snapshot.broken)]]
    (x, y), (x_next, y_next) = corners.T, np.roll(corners, -1, axis=1).T
    area = 0.5 * (x * y_next - x_next * y).sum()
    clip = clip_of(plot(torn, "pe1", 8, filled=True, dpi=40))
    assert area_of(clip) == pytest.approx(area)
    first = torn.isel(time=[0])
    position = first.position.values.copy()
    position[0, first.role.values == 0] *= np.linspace(1.0, 9.0, (first.role.values == 0).sum())[
        :, None
    ]
    position[0, 60] -= [6.0, 0.0]
    ax = plot(first.assign(position=first.position.copy(data=position)), "pe1", filled=True, dpi=40)
    assert image_of(ax).get_clip_path() is None
