"""Tabulated laws, and parameters that are chosen by name."""

import json
from collections import namedtuple
from typing import Annotated, Literal

import numba
import numpy as np
import pytest
from interpreted_kernels import interpreting
from pydantic import Field

import pbdkit
from pbdkit.plugin import LENGTH, Axes, FollowerRule, Table, Vector, interpolate, length
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.engine_choice import gpu_obstacle
from pbdkit.stepping.numba_engine import cache
from pbdkit.testing import examine

Parameters = namedtuple("Parameters", ["law", "mode"])
POINTS = [(0.0, 1.0), (0.3, 0.6), (0.5, 0.9), (2.0, 0.2)]


class Tabulated(FollowerRule):
    """Mean displacement, with a factor that depends on the stretch by a table."""

    type: Literal["tabulated"] = "tabulated"
    law: Annotated[Table, Axes(x=LENGTH)] = Field(Table(POINTS), description="Factor by stretch.")
    mode: Literal["stretch", "move"] = Field("stretch", description="Argument of the table.")

    @staticmethod
    def gather(d, r, w, p):
        if p.mode == "stretch":
            return interpolate(length(d), p.law) * d, 1.0
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        move = total[0] / total[1]
        if p.mode != "move":
            return move
        return interpolate(length(move), p.law) * move


def experiment(engine="auto", **rule):
    solver = {"type": "stepping", "engine": engine}
    settings = {"rule": {"type": "tabulated", **rule}, "solver": solver, "steps": 12}
    return pbdkit.load("paper/a", components=[Tabulated], settings=settings | {"diagnostics": []})


def position(engine="auto", **rule):
    return pbdkit.run(experiment(engine, **rule), progress=False).position.values


def test_interpolation_has_the_bits_of_numpy():
    x, y = np.sort(np.random.default_rng(0).normal(size=(2, 40)))
    table = Table(list(zip(x.tolist(), y.tolist(), strict=True)))
    places = np.concatenate([np.linspace(-4.0, 4.0, 1001), x, [np.nan, np.inf, -np.inf]])
    expected = np.interp(places, x, y)
    assert np.array_equal(interpolate(places, table.array), expected, equal_nan=True)
    assert interpolate(np.float32(0.1) * np.ones(3, np.float32), table.array).dtype == np.float32
    derivative = interpolate(0.2 + 1e-30j, table.array).imag / 1e-30
    n = np.searchsorted(x, 0.2) - 1
    assert derivative == pytest.approx((y[n + 1] - y[n]) / (x[n + 1] - x[n]))


def test_compiled_functions_have_the_same_bits():
    places, law, word = np.linspace(-0.2, 2.2, 997), Table(POINTS).array, cache.Word("move")
    apply = cache.compiled(Tabulated.apply)

    @numba.njit
    def moves(x, law):
        move = apply((Vector(x, 0.5 * x), 1.0), None, Parameters(law, word))
        return move.x, move.y

    expected = Tabulated.apply((Vector(places, 0.5 * places), 1.0), None, Parameters(law, "move"))
    assert np.array_equal(expected, np.array([moves(x, law) for x in places]).T)


def test_words_and_tables_reach_the_functions():
    results = {}
    for mode in ("move", "stretch"):
        results[mode] = position("numpy", mode=mode)
        with interpreting():
            assert np.array_equal(results[mode], position("compiled", mode=mode))
    assert not np.array_equal(results["move"], results["stretch"])
    mean = pbdkit.load("paper/a", settings={"rule": {"type": "mean-displacement"}, "steps": 12})
    plain = position(mode="move", law=[[0, 1], [1, 1]])
    assert np.array_equal(plain, pbdkit.run(mean, progress=False).position.values)


def test_a_file_with_units_gives_the_points(tmp_path):
    rows = "".join(f"{100 * x!r},{y!r}\n" for x, y in POINTS)
    (tmp_path / "law.csv").write_text("stretch,factor\n" + rows)
    base = pbdkit.load("paper/a", settings={"steps": 3, "diagnostics": []}).model_dump(mode="json")
    law = {"file": "law.csv", "columns": ["stretch", "factor"], "units": ["mm", "1"]}
    base["units"] = {"length": "100 mm", "youngs_modulus": "1 MPa", "thickness": "1 mm"}
    (tmp_path / "a.yaml").write_text(json.dumps(base | {"rule": {"type": "tabulated", "law": law}}))
    experiment = pbdkit.load(str(tmp_path / "a.yaml"), components=[Tabulated])
    assert np.allclose(experiment.rule.law.root, POINTS, rtol=1e-15)
    ds = pbdkit.run(experiment, progress=False)
    recorded = json.loads(ds.attrs["experiment"])["rule"]["law"]
    assert recorded == [list(point) for point in experiment.rule.law.root]
    assert ds.identical(pbdkit.rerun(ds, components=[Tabulated]).assign_attrs(ds.attrs))


def test_a_sweep_varies_a_table():
    laws = [[[0, 1], [1, 1]], [[0, 0.5], [1, 0.5]]]
    ds = pbdkit.sweep(experiment(), vary={"rule.law": laws}, progress=False)
    assert ds.sizes["law"] == 2
    moved = abs(ds.position - ds.reference).isel(time=-1).max(["particle", "axis"])
    assert (ds.position.isel(law=0) != ds.position.isel(law=1)).any()
    assert (moved > 0).all()


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ([[0, 1]], "rule.law: a table should have at least two points, got 1"),
        ([[0, 1], [2, 1], [1, 0]], "point 3 has x = 1 after 2; sort the points by x"),
        ([[0, 1], [0, 2]], "point 2 has x = 0 after 0"),
        ([[0, 1], [1, float("nan")]], "rule.law.1.1: should be a finite number"),
        ([[0, 1], [1, "soft"]], "rule.law.1.1: should be a valid number"),
        ([[0, 1], [1]], "rule.law.1.1"),
        (3.0, "rule.law: should be points [[x, y], ...]"),
        ({"x": [0, 1], "y": [1]}, "x and y should have one length, got 2 and 1 numbers"),
        ({"x": [0, 1], "z": [1]}, "got a map of x, z"),
        ({"file": "no.csv"}, "no.csv: does not exist; paths are relative to"),
        ({"file": "no.csv", "column": "x"}, "rule.law: a table from a file requires"),
    ],
)
def test_messages_about_tables(law, message):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        experiment(law=law)
    assert message in str(caught.value)


def test_an_unknown_word_is_refused():
    with pytest.raises(pbdkit.ExperimentError, match="did you mean 'stretch'"):
        experiment(mode="strech")


def test_a_gpu_is_refused_by_name():
    assert "tables or chosen by name" in gpu_obstacle(build_scene(experiment()))


def test_every_property_holds():
    with interpreting():
        report = examine(Tabulated(), lattice={"type": "hexagonal", "a": 0.7})
    assert report.holds, str(report)
