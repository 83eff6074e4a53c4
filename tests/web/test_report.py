"""The page of a result: what it holds, and what it does in a browser."""

import gzip
import io
import json
import re
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from browser import until
from hypothesis import given, strategies as st
from PIL import Image

import pbdkit
from pbdkit.io.explain import BondRecords
from pbdkit.io.layout import json_attribute
from pbdkit.model.reading import read_text
from pbdkit.scene.scene import build_scene
from pbdkit.web import report, report as bonds
from pbdkit.web.page import packed, script
from pbdkit.web.report import RunContent, experiment_text, moves_of

HOSTILE = "</title></script><img src=x onerror=alert(1)><!-- <b>bold</b> &amp;"
LIMIT = 5_000_000
RULES = [{"type": "barycentre"}, {"type": "mean-displacement"}]


def written(dataset, folder, **more):
    return pbdkit.report(dataset, folder / "page.html", **more)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    """The paper's first case and its page."""
    dataset = pbdkit.run("paper/a", progress=False)
    return dataset, written(dataset, tmp_path_factory.mktemp("sheet"))


@pytest.fixture(scope="module")
def torn(tmp_path_factory):
    """A sheet that is torn, and its page."""
    dataset = pbdkit.run("paper/d1", progress=False)
    return dataset, written(dataset, tmp_path_factory.mktemp("torn"))


def opened(page, path):
    page.goto(Path(path).as_uri())
    page.wait_for_selector("main[data-ready]")
    return page


def show_step(page, row):
    slider = page.get_by_role("slider", name="step")
    slider.evaluate("(s, v) => { s.value = v; s.dispatchEvent(new Event('input')); }", row)


def click_at(page, dataset, place):
    """Clicks where a place of the lattice is drawn: the box of all steps stands in the middle."""
    page.locator("canvas").scroll_into_view_if_needed()
    canvas = page.locator("canvas").bounding_box()
    positions = dataset.position.values
    low, high = positions.min((0, 1)), positions.max((0, 1))
    size = np.array([canvas["width"], canvas["height"]])
    scale = (size / (high - low + 2.0)).min()
    x, y = (place - (low + high) / 2) * scale * (1, -1) + size / 2
    page.mouse.click(canvas["x"] + x, canvas["y"] + y)


def number_beside(page, name):
    row = page.locator("aside tr").filter(has=page.get_by_role("cell", name=name, exact=True))
    return float(row.locator("td").nth(1).inner_text().split()[0])


@pytest.fixture(scope="module")
def hole(tmp_path_factory):
    """A plate with a hole that cuts cells, and its page."""
    given = ["lattice.a=0.1", "diagnostics=[{type: stress, youngs_modulus: 1.0}]"]
    dataset = pbdkit.run(pbdkit.load("material/hole", settings=given), progress=False)
    return dataset, written(dataset, tmp_path_factory.mktemp("hole"))


def test_page_contains_the_outline_if_it_cuts_cells(hole, sheet):
    held = RunContent(hole[0]).within(LIMIT)["run"]["lattice"]
    away = 0.5 - np.hypot(*(hole[0].reference.values - 1.0).T)
    edges = np.abs(hole[0].reference.values - 1.0).max(axis=1) - 1.0
    np.testing.assert_allclose(unpacked(held["beyond"]), np.maximum(away, edges), atol=1e-6)
    assert "beyond" not in RunContent(sheet[0]).within(LIMIT)["run"]["lattice"]


def test_a_page_is_in_the_units_of_the_user():
    settings = ["units.length=2 mm", "fracture={type: strain, failure: 0.5}"]
    dataset = pbdkit.run(
        pbdkit.load("modelling/composite-plate", settings=settings), progress=False
    )
    run = RunContent(dataset).within(LIMIT)["run"]
    lattice, bonds = run["lattice"], run["bonds"]
    reference = dataset.reference_mm.values
    assert lattice["length"] == "mm"
    assert lattice["spacing"] == pytest.approx(2.0)
    assert lattice["box"][0] == pytest.approx(reference[:, 0].min(), abs=0.1)
    assert lattice["box"][2] == pytest.approx(60.0, abs=0.1)
    np.testing.assert_allclose(
        unpacked(lattice["u"])[1::2], dataset.u_mm[-1].values.ravel(), rtol=1e-6
    )
    rest = unpacked(bonds["rest"], "<f8").reshape(-1, 2)
    assert np.hypot(*rest.T).min() == pytest.approx(2.0)
    (curve,) = [c for c in run["curves"] if c["title"].startswith("mean displacement of")]
    assert curve["y_label"] == "mm"


def test_a_field_of_a_page_ends_at_the_outline(page, hole):
    dataset, path = hole
    opened(page, path)
    page.get_by_label("Colour").select_option("stress_xx")
    page.get_by_label("Fill").check()
    show_step(page, 0)
    image = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"))
    low, high = dataset.position.values.min((0, 1)), dataset.position.values.max((0, 1))
    size = np.array(image.shape[1::-1])
    scale = (size / (high - low + 0.2)).min()
    turn = np.linspace(0, 2 * np.pi, 60)
    for radius, empty in ((0.46, True), (0.54, False)):
        at = 1.0 + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        x, y = ((at - (low + high) / 2) * scale * (1, -1) + size / 2).round().astype(int).T
        is_white = (image[y, x] == 255).all(axis=1)
        assert is_white.mean() > 0.9 if empty else is_white.mean() < 0.1


def test_the_slider_and_the_keys_move_the_lattice(page, sheet):
    opened(page, sheet[1])
    canvas, read = page.locator("canvas"), page.locator(".time output")
    assert read.inner_text() == "step 400"
    last = canvas.screenshot()
    show_step(page, 10)
    assert read.inner_text() == "step 10"
    assert canvas.screenshot() != last
    page.locator("h1").click()
    page.keyboard.press("ArrowRight")
    assert read.inner_text() == "step 11"
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    assert read.inner_text() == "step 9"
    page.keyboard.press(" ")
    until(lambda: int(read.inner_text().split()[1]) > 12)
    page.keyboard.press(" ")
    show_step(page, 400)
    assert canvas.screenshot() == last


def test_a_click_on_a_particle_shows_its_history(page, sheet):
    dataset, path = sheet
    opened(page, path)
    page.get_by_label("Colour").select_option("pe1")
    show_step(page, 20)
    click_at(page, dataset, dataset.position.sel(particle=67, time=20).values)
    assert page.locator("aside h3").inner_text() == "Particle 67"
    at = dataset.sel(particle=67)
    u = (at.position - at.reference).transpose("axis", "time").values
    for row in (20, 400):
        show_step(page, row)
        x, y = at.position.values[row]
        told = (number_beside(page, name) for name in ("u_x", "u_y", "pe1"))
        np.testing.assert_allclose([*told], [*u[:, row], at.pe1[row]], rtol=1e-5, atol=1e-12)
        assert f"{x:.6g}, {y:.6g}" in page.locator("aside table").inner_text()
    words = page.locator("aside .readout").all_inner_texts()
    assert words[0] == f"step 400: u_x {u[0, 400]:.4g}, u_y {u[1, 400]:.4g}"
    lines = [line.get_attribute("d") for line in page.locator("aside path.series").all()]
    assert [len(re.findall("[ML]", line)) for line in lines] == [401, 401, 401]


def test_click_on_a_bond_shows_its_events(page, torn):
    dataset, path = torn
    known = BondRecords(dataset, build_scene(pbdkit.load("paper/d1")))
    opened(page, path)
    show_step(page, 0)
    first = known.order[0]
    a, b = known.bonds.ends[first]
    click_at(page, dataset, known.bonds.midpoint[first])
    assert page.locator("aside h3").inner_text() == f"Bond {a}-{b}"
    story = page.locator("aside ul").inner_text()
    (status,) = known.statuses(known.order[:1])
    assert (
        f"It broke in step {status.step} at strain {status.strain_at_break:.6g}, "
        f"bond 1 of {len(known.order)} in the order of breaking." in story
    )
    assert f"it breaks above the strain {status.breaks_above:.6g}" in story
    around = known.statuses(known.around(first))
    together = [s for s in around if s.step == status.step]
    assert all("-".join(map(str, s.bond)) in story for s in together)
    step, strain = known.most_strained(first)
    assert f"in the steps shown: {strain:.6g}, in step {step}." in story
    a, b = known.bonds.ends[known.steps.argmin()]
    page.get_by_label("Find").fill(f"{b} {a}")
    page.get_by_label("Find").press("Enter")
    assert page.locator("aside h3").inner_text() == f"Bond {a}-{b}"
    assert "It is intact at the end." in page.locator("aside ul").inner_text()
    page.get_by_label("Find").fill("1 144")
    page.get_by_label("Find").press("Enter")
    assert page.locator("aside").inner_text() == "No bond between these is shown."


def test_list_has_the_broken_bonds_in_order(page, torn, monkeypatch, tmp_path):
    monkeypatch.setattr(bonds, "MAX_LISTED", 3)
    dataset, _ = torn
    opened(page, written(dataset, tmp_path))
    section = page.locator("section").filter(has_text="Fracture model")
    rows = [row.split("\t") for row in section.locator("tbody").inner_text().splitlines()]
    broken = dataset.broken_step.values
    assert [int(row[1]) for row in rows] == sorted(broken[broken >= 0])[:3]
    assert f"The first 3 of {(broken >= 0).sum()} are listed" in section.inner_text()


def test_colours_and_their_range(page, sheet):
    dataset, path = sheet
    opened(page, path)
    page.get_by_label("Colour").select_option("u_x")
    page.get_by_label("Range").select_option("all")
    most = float(abs(dataset.position - dataset.reference).sel(axis="x").max())
    assert page.locator(".scale").inner_text().split()[1] == f"{most:.4g}"
    page.get_by_label("Range").select_option("each")
    now = (dataset.position - dataset.reference).isel(time=-1).sel(axis="x")
    assert page.locator(".scale").inner_text().split()[1] == f"{float(now.max()):.4g}"
    page.get_by_label("Range").select_option("typed")
    before = page.locator("canvas").screenshot()
    page.get_by_label("to value").fill("0.02")
    page.get_by_label("to value").press("Enter")
    assert page.locator(".scale").inner_text().split()[1] == "0.02"
    assert page.locator("canvas").screenshot() != before


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_wider_than_the_window(page, torn, width):
    page.set_viewport_size({"width": width, "height": 900})
    opened(page, torn[1])
    click_at(page, torn[0], torn[0].position.values[-1, 60])
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_decayed_field_opens_at_the_range_of_its_step(page, sheet):
    """PE1 is 3.9 in step 10 and 4e-4 in the last step."""
    dataset, path = sheet
    opened(page, path)
    assert page.get_by_label("Colour").input_value() == "pe1"
    assert page.get_by_label("Range").input_value() == "each"
    each = dataset.pe1.isel(time=-1)
    assert page.locator(".scale").inner_text().split()[1] == short(each.max())
    page.get_by_label("Range").select_option("all")
    assert page.locator(".scale").inner_text().split()[1] == short(dataset.pe1.max())
    linear = page.locator("canvas").screenshot()
    page.get_by_label("Scale").select_option("log")
    assert page.locator(".scale").inner_text().split()[:2] == ["≤", short(dataset.pe1.max() * 1e-4)]
    assert page.locator("canvas").screenshot() != linear


def short(value):
    """The text of a positive number on the page."""
    if value >= 1e-3:
        return f"{value:.4g}"
    return re.sub(r"(\.?0+)?e-0?", "e-", f"{value:.3e}")


def test_predicted_and_measured_spectral_radius(page, sheet):
    dataset, path = sheet
    predicted = pbdkit.analyse("paper/a").spectral_radius
    measured = moves_of(dataset).decay
    assert measured == pytest.approx(predicted, abs=2e-5)
    opened(page, path)
    row = page.get_by_role("row").filter(has_text="spectral radius")
    assert row.locator("td").all_inner_texts()[1:] == [f"{predicted:.6g}", f"{measured:.6g}"]


def test_pages_are_small(sheet, torn):
    assert all(path.stat().st_size < LIMIT for _, path in (sheet, torn))


def test_large_body_is_thinned_with_a_note(page, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "FIRST", 200_000)
    monkeypatch.setattr(report, "MAX_PAGE_BYTES", 200_000)
    settings = ["body.columns=60", "body.rows=60", "steps=80"]
    dataset = pbdkit.run(pbdkit.load("paper/a", settings=settings), progress=False)
    opened(page, written(dataset, tmp_path))
    steps, particles = page.locator("#left-out li").all_inner_texts()
    assert re.fullmatch(r"\d+ of the 81 recorded steps are shown: one of 2, and the last.", steps)
    count = int(re.match(rf"(\d+) of the {62 * 62} particles are shown", particles)[1])
    content = RunContent(dataset).within(200_000)
    assert content["run"]["lattice"]["reference"]["shape"] == [count, 2]
    assert len(content["run"]["lattice"]["times"]) == int(steps.split()[0])
    assert content["run"]["lattice"]["times"][-1] == 80


def test_the_map_of_a_sweep_opens_its_members(page, tmp_path):
    found = pbdkit.sweep(
        "paper/a",
        vary={"solver.relaxation": [0.5, 1.0], "rule": RULES},
        keep={"variables": ["pe1", "position"], "times": [0, 10, 40]},
        workers=1,
        progress=False,
    )  # fmt: skip
    opened(page, written(found, tmp_path))
    cell = page.get_by_role("button", name="relaxation = 0.5, rule = mean-displacement")
    largest = float(found.pe1.isel(relaxation=0, rule=1, time=-1).max())
    assert f": {largest:.4g}, complete" in cell.get_attribute("aria-label")
    cell.click()
    page.wait_for_selector("canvas")
    assert "Member: relaxation = 0.5" in page.locator("h2").nth(2).inner_text()
    page.get_by_label("Find").fill("67")
    page.get_by_label("Find").press("Enter")
    page.keyboard.press("Tab")
    show_step(page, 1)
    at = found.isel(relaxation=0, rule=1).sel(particle=67, time=10).position
    assert f"{at.values[0]:.6g}, {at.values[1]:.6g}" in page.locator("aside table").inner_text()
    page.get_by_label("Colour").first.select_option("status")
    assert "complete or settled" in page.locator(".scale").first.inner_text()


def test_members_of_different_bodies(page, tmp_path):
    found = pbdkit.sweep(
        "paper/a",
        together={"body.columns": [8, 10], "body.rows": [10, 4], "steps": [12, 14]},
        workers=1,
        progress=False,
    )
    opened(page, written(found, tmp_path))
    for n, (columns, rows, steps) in enumerate(((8, 10, 12), (10, 4, 14))):
        page.get_by_role("button", name=f"columns {columns}, rows {rows}, steps {steps}").click()
        page.wait_for_selector(f"section:has(canvas) h2:has-text('rows {rows}')")
        assert page.locator(".time output").inner_text() == f"step {steps}"
        page.get_by_label("Find").fill("30")
        page.get_by_label("Find").press("Enter")
        x, y = found.isel(case=n).position.sel(particle=30, time=steps).values
        assert f"{x:.6g}, {y:.6g}" in page.locator("aside table").inner_text()


def test_failed_members_and_sweeps_without_positions(page, tmp_path):
    found = pbdkit.sweep(
        "paper/a",
        vary={"solver.relaxation": [1.0, 9.0]},
        keep={"variables": ["pe1"], "times": "last"},
        workers=1,
        progress=False,
    )
    opened(page, written(found, tmp_path))
    assert "`position` was not kept" in page.locator("#left-out").inner_text()
    page.get_by_role("button", name="relaxation = 9").click()
    page.wait_for_selector("h2:has-text('Member')")
    assert "diverged" in page.locator("section").nth(2).inner_text()


def test_texts_of_the_file_are_escaped(page, sheet, tmp_path):
    dataset = sheet[0].copy()
    dataset.attrs |= {"title": HOSTILE, "stop_reason": HOSTILE}
    dataset["pe1"] = dataset.pe1.assign_attrs(long_name=HOSTILE, units=HOSTILE)
    opened(page, written(dataset, tmp_path))
    assert page.locator("h1").inner_text() == HOSTILE
    assert page.title() == f"{HOSTILE}: report"
    assert HOSTILE in page.get_by_label("Colour").inner_text()
    assert page.locator("img, b").count() == 0


def test_equilibrium_and_its_error_bound(page, tmp_path):
    dataset = pbdkit.run("modelling/inclusion", progress=False)
    opened(page, written(dataset, tmp_path))
    assert page.get_by_label("Colour").input_value() == "stress_xx"
    assert page.get_by_label("Fill").is_checked()
    assert page.locator(".chart").count() == 0  # of two points
    before = page.locator("canvas").screenshot()
    page.get_by_label("Displacement factor").fill("20")
    page.get_by_label("Displacement factor").press("Enter")
    assert page.locator("canvas").screenshot() != before
    distance = json_attribute(dataset, "certificate")["distance"]
    assert f"{distance:.6g}" in page.locator("main").inner_text()
    page.get_by_label("Find").fill("100")
    page.get_by_label("Find").press("Enter")
    told = float(dataset.stress_xx.sel(particle=100).isel(time=-1))
    assert number_beside(page, "stress_xx") == pytest.approx(told, rel=1e-5)
    assert page.locator(".chart").count() == 0


def test_benchmarks_and_scenes_that_cannot_be_built(page, sheet, tmp_path):
    dataset = sheet[0].copy()
    parts = json_attribute(dataset, "experiment") | {"rule": {"type": "of-nobody"}}
    dataset.attrs["experiment"] = json.dumps(parts)
    bench = tmp_path / "bench.json"
    row = {"size": None, "method": "numpy", "precision": "float64", "error": 2e-9, "reason": ""}
    told = {"experiment": "paper/a", "steps": 9, "machine": {"processors": 2}, "rows": [row]}
    bench.write_text(json.dumps(told))
    opened(page, written(dataset, tmp_path, bench=bench))
    assert "2.0e-09" in page.locator("section").last.inner_text()
    assert "unknown type 'of-nobody'" in page.locator("#left-out").inner_text()
    assert "There is no prediction" in page.locator("main").inner_text()


@pytest.mark.parametrize("name", ["paper/f2", "modelling/composite-plate", "stability/oscillation"])
def test_displayed_experiment_is_that_of_the_run(name):
    whole = pbdkit.load(name).model_dump(mode="json", by_alias=True)
    text = experiment_text(whole)
    assert pbdkit.Experiment.build(read_text(text, "page")) == pbdkit.load(name)
    assert len(text) < 0.7 * len(experiment_text({"all": whole}))


@given(st.lists(st.floats(-(2.0**90), 2.0**90, width=32)))
def test_packed_arrays_equal_the_arrays(values):
    np.testing.assert_array_equal(unpacked(packed(values, "f4")), np.float32(values))


def unpacked(made, kind="<f4"):
    places = np.frombuffer(gzip.decompress(b64decode(made["data"])), np.uint8)
    return places.reshape(np.dtype(kind).itemsize, -1).T.copy().view(kind).ravel()


def test_scripts_have_no_imports():
    text = script("view", exports=True)
    assert not re.search(r"^\s*import\b", text, re.M)
    assert text.endswith("export const { LatticeView } = view_js;")


def test_other_files_are_refused(call):
    assert call("run", "e.json", "--quiet").code == 0
    made = call("report", "tensile.nc")
    assert made.code == 0
    assert made.out.startswith("tensile.html written")
    again = call("report", "tensile.nc")
    assert (again.code, again.err) == (
        2, "pbdkit: tensile.html: exists; --force replaces it, -o names another file\n",
    )  # fmt: skip
    assert call("report", "tensile.nc", "--force").code == 0
    wrong = call("report", "e.json", "-o", "a.html")
    assert wrong.code == 2
    assert "e.json: is an experiment; `pbdkit run e.json`" in wrong.err
    none = call("report", "nothing.nc")
    assert (none.code, none.err) == (6, "pbdkit: nothing.nc: there is no such file\n")
    bench = call("report", "tensile.nc", "-o", "a.html", "--bench", "e.json")
    assert bench.code == 2
    assert "e.json: contains no measurement; `pbdkit bench EXPERIMENT --json e.json`" in bench.err
    folder = call("report", "tensile.nc", "-o", "none/a.html")
    assert (folder.code, folder.err) == (6, "pbdkit: none/a.html: there is no folder none\n")


def test_a_dataset_without_positions(sheet, tmp_path):
    with pytest.raises(pbdkit.ExperimentError, match="has no positions"):
        written(sheet[0].drop_vars("position"), tmp_path)
    with pytest.raises(pbdkit.ExperimentError, match="select one of several runs with isel"):
        written(pbdkit.concat([sheet[0], sheet[0]]), tmp_path)
    for none in ("time", "particle"):
        with pytest.raises(pbdkit.ExperimentError, match="has no step or no particle"):
            written(sheet[0].isel({none: []}), tmp_path)


def test_a_body_of_one_particle_has_no_bonds(page, tmp_path):
    alone = pbdkit.Experiment(
        version=1, name="alone", lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": 1, "rows": 1}, rule={"type": "barycentre"},
        neighbours={"type": "coordination", "shells": 1}, frame={"type": "none"},
        leaders=[{"select": {"numbers": [1]}, "motion": {"type": "hold"}}],
        fracture={"type": "threshold", "thresholds": [1.5]}, steps=3,
    )  # fmt: skip
    dataset = pbdkit.run(alone, progress=False)
    assert dataset.sizes["bond"] == 0
    opened(page, written(dataset, tmp_path))
    assert page.locator("h1").inner_text() == "alone"


def test_part_of_a_dataset(page, torn, tmp_path):
    some = torn[0].isel(particle=slice(20, 60), time=slice(0, 9))
    opened(page, written(some, tmp_path))
    assert ("the dataset does not contain all particles of the run") in page.locator(
        "#left-out"
    ).inner_text()
    page.get_by_label("Find").fill("30")
    page.get_by_label("Find").press("Enter")
    assert page.locator("aside h3").inner_text() == "Particle 30"
