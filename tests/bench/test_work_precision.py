"""`pbdkit bench`: the table, the figures as JSON, the picture, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.bench import work_precision as measurement
from pbdkit.bench.work_precision import (
    FLOOR,
    Row,
    as_dict,
    engines,
    measure,
    resized,
    table,
    work_precision_figure,
)
from pbdkit.scene.scene import build_scene

FOUR = [("numpy", "float64", 1), ("numpy", "float32", 1), ("compiled", "float64", 1)]
HOLD = {"type": "hold"}


def work_here(job, folder, cache):
    """Run a job in this process: one of its own takes a second to start."""
    return measurement._without_fault(json.loads(json.dumps(measurement.result_of(job))))


@pytest.fixture
def here(monkeypatch):
    """Jobs that compile run in processes of their own, and others in this process."""
    apart = measurement._run_in_process

    def work(job, folder, cache):
        if "engine=compiled" not in str(job):
            return work_here(job, folder, cache)
        if not job["at"]:
            return apart(job, folder, cache)
        with monkeypatch.context() as patch:
            patch.setenv("PBDKIT_CACHE_DIR", str(cache))
            return work_here(job, folder, cache)

    monkeypatch.setattr(measurement, "_run_in_process", work)


@pytest.fixture
def few(here, monkeypatch):
    """Three methods, one of which takes some seconds."""
    monkeypatch.setattr("pbdkit.bench.work_precision.engines", lambda: FOUR)


def measured(method=FOUR[0], size=10, error=0.0):
    return Row(size, *method, particles=size**2, ns_per_particle_step=20.0, error=error)


def test_table_figures_and_plot_are_written(call, few):
    result = call(
        "bench", "e.json", "--sizes", "6", "--steps", "8", "--json", "b.json", "--plot", "b.png"
    )
    assert result.code == 0, result.err
    found = json.loads(Path("b.json").read_text())
    assert set(found) == {"experiment", "settings", "steps", "machine", "rows"}
    assert found["steps"] == 8
    rows = found["rows"]
    assert [(r["method"], r["precision"], r["threads"]) for r in rows] == FOUR
    for row in rows:
        assert row["size"] == 6
        assert row["particles"] == 8 * 6
        assert row["setup_s"] > 0
        assert row["setup_first_s"] > 0
        assert row["ns_per_particle_step"] > 0
        assert row["peak_memory_mib"] >= 0
    exact, single, compiled = rows
    assert exact["error"] == compiled["error"] == 0
    assert 0 < single["error"] < 1e-5
    assert compiled["setup_first_s"] > compiled["setup_s"]
    assert Path("b.png").read_bytes().startswith(b"\x89PNG")
    for row in rows:
        assert any(row["method"] in line and row["precision"] in line
                   for line in result.out.splitlines())  # fmt: skip


def test_without_sizes_the_body_keeps_its_size(call, here, monkeypatch):
    monkeypatch.setattr("pbdkit.bench.work_precision.engines", lambda: FOUR[:1])
    result = call("bench", "e.json", "--set", "leaders.0.select={numbers: [7, 8]}", "--json", "b")
    assert result.code == 0, result.err
    assert "unchanged" in result.out
    (row,) = json.loads(Path("b").read_text())["rows"]
    assert row["size"] is None
    assert row["particles"] == 6 * 5


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--sizes", "6,x"], 2, "'x' is not a number of sites"),
        (["--sizes", "1"], 2, "'1' is not a number of sites"),
        (["--steps", "0"], 2, "--steps"),
        (["--plot", "b.txt"], 2, "the name of a picture must end in .png, .svg, .pdf"),
        (["--plot", "nowhere/b.png"], 6, "there is no folder nowhere"),
        (["--json", "."], 2, "is a folder"),
        (["--set", "rule.K=1"], 2, "rule"),
        (["--set", "body={type: grid, columns: 1000000, rows: 1000000}"], 2, "reduce it"),
        (
            ["--sizes", "6", "--set", "leaders.0.select={numbers: [7]}"],
            2,
            "leaders selected by number cannot be resized",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_invalid_input_is_refused_in_one_line(call, here, arguments, code, words):
    result = call("bench", "e.json", *arguments)
    assert result.code == code
    assert words in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert "Traceback" not in result.err


def test_unavailable_method_is_a_row_with_a_reason(tmp_path, tensile, here, monkeypatch):
    file = tmp_path / "e.json"
    file.write_text(json.dumps(tensile))
    never = ("abacus", "float64", 1)
    monkeypatch.setattr("pbdkit.bench.work_precision.engines", lambda: [FOUR[0], never])
    exact, other = rows = list(measure(str(file), (), None, lambda _: None))
    assert (exact.reason, exact.error) == ("", 0.0)
    assert "engine" in other.reason
    assert as_dict("e", (), 3, rows)["rows"][1]["reason"] == other.reason
    monkeypatch.setattr("pbdkit.bench.work_precision.engines", lambda: [never])
    with pytest.raises(pbdkit.ExperimentError, match="engine"):
        list(measure(str(file), (), None, lambda _: None))


def test_missing_engine_names_its_extra(here, monkeypatch, tmp_path, tensile):
    """The measuring process itself finds no numba."""
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.util as util\nfind = util.find_spec\n"
        "util.find_spec = lambda name, *more: None if name == 'numba' else find(name, *more)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    monkeypatch.setattr("pbdkit.bench.work_precision.engines", lambda: [FOUR[0], FOUR[2]])
    file = tmp_path / "e.json"
    file.write_text(json.dumps(tensile))
    _, other = measure(str(file), (), None, lambda _: None)
    assert "numba is not installed: pip install 'pbdkit[fast]'" in other.reason


def sheet(**parts):
    base = {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0, "origin": [1.0, 2.0]},
        "body": {"type": "grid", "columns": 5, "rows": 3},
        "rule": {"type": "barycentre"},
        "leaders": [{"select": {"edge": "left"}, "motion": HOLD}],
        "steps": 3,
    }
    return pbdkit.Experiment(**(base | parts))


def at_size(tmp_path, experiment, size):
    file = tmp_path / "e.json"
    file.write_text(experiment.model_dump_json())
    return build_scene(pbdkit.load(file, settings=resized(experiment, size)))


def test_resizing_a_grid_keeps_coordinates_in_place(tmp_path):
    groups = [
        {"select": {"box": [4.5, 0.0, 5.5, 9.0]}, "motion": HOLD},
        {
            "select": {"nearest": [[1.0, 4.0]]},
            "motion": {"type": "rotation", "centre": [3.0, 3.0], "angle": 1.0, "steps": 2},
        },
    ]
    cracks = [[[2.5, 0.0], [2.5, 3.0]]]
    fracture = {"type": "threshold", "thresholds": [3.0], "cracks": cracks}
    scene = at_size(tmp_path, sheet(leaders=groups, fracture=fracture), 9)
    body = scene.experiment.body
    assert (body.columns, body.rows) == (9, 5)
    right, corner = (group.rows for group in scene.leading)
    x = scene.raster.reference(right)
    assert set(x[:, 0]) == {8.0, 9.0}
    np.testing.assert_array_equal(scene.raster.reference(corner), [[1.0, 6.0]])
    assert scene.experiment.leaders[1].motion.centre == (5.0, 4.0)
    assert scene.experiment.fracture.cracks == (((4.0, -2.0), (4.0, 4.0)),)


@pytest.mark.parametrize(
    ("lattice", "body"),
    [
        ({"type": "square", "a": 1.0}, {"type": "disc", "radius": 5.0, "centre": [0.0, 0.0]}),
        ({"type": "hexagonal", "a": 0.7}, {"type": "rectangle", "width": 10.0, "height": 4.0}),
        (
            {"type": "rectangular", "a": 1.0, "b": 0.5},
            {"type": "rectangle", "width": 4.0, "height": 10.0},
        ),
    ],
    ids=lambda part: part["type"],
)
def test_other_bodies_get_a_finer_lattice(tmp_path, lattice, body):
    parts = {"lattice": lattice, "body": body, "frame": {"type": "none"}}
    fracture = {"type": "threshold", "thresholds": [2.0]}
    before = sheet(**parts, fracture=fracture)
    scene = at_size(tmp_path, before, 41)
    after = scene.experiment
    factor = after.lattice.a / before.lattice.a
    assert after.fracture.thresholds[0] == pytest.approx(2.0 * factor)
    assert after.body == before.body
    x = scene.raster.reference()
    longer = np.argmax(np.ptp(x, axis=0))
    spacing = {0: after.lattice.a, 1: getattr(after.lattice, "b", after.lattice.a)}[int(longer)]
    assert np.ptp(x, axis=0).max() / spacing + 1 == pytest.approx(41, abs=1.01)


def test_a_grid_within_another_body_cannot_be_resized():
    grid = {"type": "grid", "columns": 5, "rows": 3}
    with pytest.raises(pbdkit.ExperimentError, match="a grid within another body"):
        resized(sheet(body={"type": "union", "of": [grid]}), 10)


def test_every_method_has_a_row_and_a_marker():
    rows = [measured(m, s, e) for m, e in zip(engines(), (0.0, 1e-7) * 3, strict=False)
            for s in (10, 20)]  # fmt: skip
    assert table(rows).row_count == len(rows)
    panels = work_precision_figure([*rows, measured(error=np.inf)], "a title").axes
    drawn = np.concatenate([points.get_offsets() for ax in panels for points in ax.collections])
    assert len(drawn) == len(rows)
    assert drawn[:, 1].min() == FLOOR
    assert "0" in [label.get_text() for label in panels[0].get_yticklabels()]
