"""Representations in a notebook of an experiment, of an analysis and of an unfinished run."""

import io
import sys
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from property_cases import LATTICES, experiment, pull_right

import pbdkit
from pbdkit import progress
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.model.shipped import shipped_names
from pbdkit.plotting import notebook, plot_experiment
from pbdkit.plotting.scene_figure import Svg, edge_of, extreme, picture_of
from pbdkit.plotting.style import figure_of
from pbdkit.scene.scene import build_scene

PULLED = {"leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}},
                      pull_right(0.3, 0.0)]}  # fmt: skip


def scene_of(**parts):
    return build_scene(pbdkit.Experiment(**experiment(**PULLED | parts)))


def shapes(html):
    """The elements of the picture in a page, and the page as XML."""
    page = ElementTree.fromstring(html)
    found = page.find(".//{http://www.w3.org/2000/svg}svg")
    return page, [*found] if found is not None else []


def numbers(element):
    text = element.get("d", "").replace("h0", " ")
    return np.array("".join(c if c in "0123456789.- " else " " for c in text).split(), float)


@pytest.mark.parametrize("name", [n for n in shipped_names() if n != "paper/e-40"])
def test_figures_of_shipped_experiments_are_within_their_edges(name):
    drawn = picture_of(build_scene(pbdkit.load(name)))
    picture = ElementTree.fromstring(drawn.svg)
    width, height = float(picture.get("width")), float(picture.get("height"))
    assert 0 < width <= 480
    assert 0 < height <= 400
    led = [s for s in picture if s.get("stroke") in ("#0072B2", "#D55E00") and "h0" in s.get("d")]
    for shape in led:
        x, y = numbers(shape).reshape(-1, 2).T
        assert 0 <= x.min() <= x.max() <= width
        assert 0 <= y.min() <= y.max() <= height
    assert {"body", "edge of the body"} & {said for _, said in drawn.legend}


def test_legend_lists_the_contents_of_the_scene():
    whole = scene_of(
        neighbours={"type": "chebyshev", "shells": 1},
        rule={"type": "elastic", "poisson_ratio": 0.3, "stiffness": {"otherwise": 1, "core": 2}},
        frame={"type": "natural"},
        regions={"core": {"type": "disc", "radius": 1.5, "centre": [2.5, 2.0]}},
        cuts=[{"from": [-1.0, 2.5], "to": [1.0, 2.5], "at": 3}],
        loads=[{"select": {"edge": "top"}, "force": [0.0, -1e-3]}],
        obstacles=[{"shape": {"half_plane": {"point": [0.0, -1.0], "normal": [0.0, 1.0]}},
                    "motion": {"type": "hold"}}],
    )  # fmt: skip
    said = [words for _, words in picture_of(whole).legend]
    assert {"region core", "obstacle", "body", "cut at step 3", "held", "led", "force"} == {*said}
    framed = picture_of(scene_of()).legend
    assert "frame" in [words for _, words in framed]


def test_areas_of_body_and_region_have_their_true_outlines():
    drawing = picture_of(build_scene(pbdkit.load("modelling/composite-plate")))
    assert {"region steel", "body", "body, outside the outline"} <= {w for _, w in drawing.legend}
    filled = [s for s in ElementTree.fromstring(drawing.svg) if s.get("fill-rule")]
    body, steel = (
        [numbers({"d": ring}).reshape(-1, 2) for ring in s.get("d").split("Z")[:-1]] for s in filled
    )
    (plate, hole), (inclusion,) = body, steel
    scale = np.ptp(plate[:, 0]) / 60.0
    for ring, centre, radius in ((hole, (18.0, 20.0), 6.0), (inclusion, (42.0, 20.0), 8.0)):
        at = (ring - [plate[:, 0].min(), plate[:, 1].max()]) / [scale, -scale]
        np.testing.assert_allclose(np.hypot(*(at - centre).T), radius, atol=0.15 / scale)
        assert len(ring) > 12


UNITS = {"units": {"length": "2 mm"}}


def test_setup_is_drawn_on_axes_in_mm():
    ring = {"type": "ring", "inner": 0.5, "outer": 1.0, "centre": [2.5, -2.0]}
    whole = pbdkit.Experiment(
        **experiment(
            **PULLED,
            **UNITS,
            cuts=[{"from": [-1.0, 2.5], "to": [1.0, 2.5], "at": 3}],
            obstacles=[{"shape": ring, "motion": {"type": "hold"}}],
        )
    )  # fmt: skip
    ax = plot_experiment(whole, dpi=80)
    scene = build_scene(whole)
    assert {"x (mm)", "y (mm)"} <= {text.get_text() for text in figure_of(ax).texts}
    drawn = np.concatenate([line.get_xydata() for line in ax.lines])
    body = 2.0 * scene.raster.reference(scene.raster.body_rows)
    assert {*map(tuple, body)} <= {*map(tuple, drawn)}
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    assert (drawn > [left, low]).all()
    assert (drawn < [right, high]).all()
    arrows = [a for a in ax.texts if a.arrow_patch]
    assert arrows
    assert all(a.xy[0] > a.xyann[0] and a.xy[1] == a.xyann[1] for a in arrows)
    (ring,) = ax.patches
    assert ring.get_path().contains_point((5.0 + 1.5, -4.0))
    figure_of(ax).canvas.draw()
    image = np.asarray(figure_of(ax).canvas.buffer_rgba())[::-1]
    column, row = (round(v) for v in ax.transData.transform((5.0, -4.0)))
    assert image[row, column].tolist() == [255, 255, 255, 255]  # a hole
    words = {text.get_text() for legend in figure_of(ax).legends for text in legend.get_texts()}
    assert words == {"obstacle", "frame", "body", "cut at step 3", "held", "led"}


@pytest.mark.parametrize(
    "name", ["paper/f1", "modelling/composite-plate", "modelling/mass-on-a-bar"]
)
def test_a_notebook_and_the_axes_show_the_same(name):
    loaded = pbdkit.load(name)
    ax = plot_experiment(loaded, dpi=60)
    words = {text.get_text() for legend in figure_of(ax).legends for text in legend.get_texts()}
    named = [said for _, said in picture_of(build_scene(loaded)).legend]
    assert {w for text in words for w in text.split("; ")} == {*named}


def test_setup_is_drawn_into_given_axes():
    given = Figure().subplots()
    assert plot_experiment(pbdkit.load("paper/a"), ax=given) is given
    assert given.get_title() == "paper/a"
    assert given.get_legend() is not None


def test_arrows_point_along_the_leader_motion():
    drawn = ElementTree.fromstring(picture_of(scene_of()).svg)
    shafts = [s for s in drawn if s.get("stroke") == "#D55E00" and "L" in s.get("d")]
    assert shafts
    for shaft in shafts:
        x0, y0, x1, y1 = numbers(shaft)
        assert x1 > x0
        assert y1 == y0


def test_force_on_particles_close_together_has_an_arrow_at_their_centre():
    def ends(*points):
        load = {"select": {"nearest": [*points]}, "force": [0.0, 1.0]}
        whole = scene_of(
            body={"type": "grid", "columns": 60, "rows": 4},
            neighbours={"type": "chebyshev", "shells": 1},
            rule={"type": "elastic", "poisson_ratio": 0.3},
            frame={"type": "natural"},
            loads=[load],
        )
        drawn = ElementTree.fromstring(picture_of(whole).svg)
        (shaft,) = [s for s in drawn if s.get("stroke") == "#007A5A" and "L" in s.get("d")]
        return np.array(numbers(shaft))

    left, right = [30.0, 0.0], [31.0, 0.0]
    centre = (ends(left) + ends(right)) / 2
    np.testing.assert_allclose(ends(left, right), centre, atol=0.11)
    assert ends(left)[0] < centre[0] - 1.0


@pytest.mark.parametrize(
    ("motion", "way"),
    [
        ({"type": "velocity", "velocity": [0.1, 0.0], "steps": 5}, [0.5, 0.0]),
        ({"type": "velocity", "velocity": [0.1, 0.0], "steps": 500}, [3.0, 0.0]),
        ({"type": "displace", "displacement": [0.0, -2.0]}, [0.0, -2.0]),
        ({"type": "path", "steps": [2, 4], "displacements": [[0.0, 3.0], [0.0, 0.0]]}, [0.0, 3.0]),
        ({"type": "oscillation", "amplitude": [1.0, 0.5], "period": 8}, [1.0, 0.5]),
    ],
)
def test_motion_is_shown_at_its_largest_displacement(motion, way):
    made = scene_of(leaders=[{"select": {"edge": "right"}, "motion": motion}])
    (leading,) = made.leading
    found = extreme(leading.group.motion, leading.reference, made.experiment.steps)
    np.testing.assert_allclose(found, np.broadcast_to(way, found.shape), rtol=1e-12)


def test_rotations_are_shown_by_their_first_step():
    motion = {"type": "rotation", "centre": [0.0, 0.0], "angle": 90.0, "steps": 4}
    made = scene_of(leaders=[{"select": {"nearest": [[5.0, 0.0]]}, "motion": motion}])
    (leading,) = made.leading
    found = extreme(leading.group.motion, leading.reference, 4)
    np.testing.assert_allclose(found, [[-5.0, 5.0]], atol=1e-12)


@pytest.mark.parametrize("lattice", LATTICES)
def test_the_edge_of_a_large_body_is_its_own(lattice):
    made = scene_of(lattice=lattice, columns=12, rows=11)
    raster, rows = made.raster, edge_of(made.raster)
    assert (raster.table_kind[rows] == FOLLOWER).all()
    assert len(np.unique(rows)) == len(rows) < (raster.table_kind == FOLLOWER).sum()
    X = raster.reference()
    body = X[raster.table_kind == FOLLOWER]
    for end in (body.min(axis=0), body.max(axis=0)):
        assert (np.isclose(X[rows], end).any(axis=0)).all()


def test_large_bodies_give_small_pages():
    made = pbdkit.load("paper/a", settings=["body.columns=300", "body.rows=300"])
    page = made._repr_html_()
    assert len(page) < 60_000
    assert "edge of the body" in page


def test_omitted_slow_analyses_are_reported(monkeypatch):
    monkeypatch.setattr(notebook, "MAX_ANALYSED_PARTICLES", 10)
    assert "not computed for" in pbdkit.load("paper/a")._repr_html_()


def test_pages_agree_with_check(call):
    page = pbdkit.load("paper/a")._repr_html_()
    told = call("check", "paper/a", "--verbose").out
    text = "".join(ElementTree.fromstring(page).itertext())
    for said in ("144, of which", "stable"):
        assert said in told.replace("spectrum", "stability")
        assert said in text


def test_invalid_scene_is_a_page_with_the_reason():
    made = pbdkit.Experiment(
        **experiment(leaders=[{"select": {"box": [90, 90, 91, 91]}, "motion": {"type": "hold"}}])
    )
    page, drawn = shapes(made._repr_html_())
    assert "selects no particle" in "".join(page.itertext())
    assert not drawn


def test_text_is_escaped():
    hostile = "<script>alert('&\")</script>"
    page, _ = shapes(notebook._page(hostile, "", [(hostile, hostile)], [hostile]))
    assert "".join(page.itertext()).count(hostile) == 4
    assert "<script>" not in Svg(np.zeros(2), np.ones(2), (90.0, 90.0), 9.0).text(hostile)


def test_three_dimensional_scenes_have_no_figure():
    assert picture_of(SimpleNamespace(axes=3)) is None


def test_analyses_show_their_verdict():
    found = pbdkit.analyse("paper/a")
    text = "".join(ElementTree.fromstring(found._repr_html_()).itertext())
    assert f"stable: spectral radius {found.spectral_radius:.9g}" in text
    assert f"{found.smallest_eigenvalue:.6g}" in text
    wild = pbdkit.analyse(pbdkit.load("paper/a", settings=["solver.relaxation=1.9"]))
    assert "not stable" in "".join(ElementTree.fromstring(wild._repr_html_()).itertext())


def test_identities_describe_the_rule():
    found = pbdkit.identify("paper/f2")
    text = "".join(ElementTree.fromstring(found._repr_html_()).itertext())
    for said in ("isotropic diffusion", "stable below 1.5", *found.notes):
        assert said in text


def test_each_colour_is_once_in_the_legend():
    text = "".join(pbdkit.load("modelling/composite-plate")._repr_html_())
    assert "held along x; held along y" in text


def test_equilibrium_page_has_no_number_of_steps():
    page = pbdkit.load("material/bar")._repr_html_()
    text = "".join(ElementTree.fromstring(page).itertext())
    assert "computes the equilibrium directly" in text
    assert "converges" not in text


@pytest.mark.parametrize("of", [pbdkit.analyse, pbdkit.identify])
def test_without_a_notebook_representations_are_short(of):
    assert len(repr(of("paper/a"))) < 1500


def test_representations_add_no_field_to_the_experiment():
    made = pbdkit.load("paper/a")
    assert "_repr_html_" not in str(made.model_dump())
    assert not any("repr" in name for name in type(made).model_fields)


def test_progress_in_a_notebook_is_an_updated_line(monkeypatch, recwarn):
    shown = io.StringIO()
    kernel = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=1))
    monkeypatch.setitem(sys.modules, "IPython", kernel)
    monkeypatch.setattr(progress, "DELAY_S", 0.0)
    monkeypatch.setattr(progress, "LINE_S", 0.0)
    monkeypatch.setattr(sys, "stdout", shown)
    with progress.progress_bar(True) as show:
        show("step 10 of 100", 0.1)
        show("step 100 of 100", 1.0)
    first, second, end = shown.getvalue().split("\r")[1:4]
    assert first.startswith("step 10 of 100 10% after")
    assert second.startswith("step 100 of 100 100% after")
    assert end == " " * len(second)
    assert "\n" not in shown.getvalue()
    assert not recwarn.list


def test_progress_elsewhere_is_a_bar(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    monkeypatch.setattr(progress, "DELAY_S", 0.0)
    with progress.progress_bar(True) as show:
        show("step 10 of 100", 0.1)
    assert "after" not in capsys.readouterr().out
