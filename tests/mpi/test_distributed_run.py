"""Several processes that share a run give the file of one, bit for bit."""

import sqlite3
import sys
from contextlib import closing
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar, Literal

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from property_cases import HOLD_LEFT, pull_right
from remembering_parts import Tiring, Weakest
from scene_strategies import calibrated_experiments, experiments, in_turn, pulled_apart, samples
from thread_ranks import on_ranks

import pbdkit
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.mpi.partition import subdomains
from pbdkit.progress import Watch
from pbdkit.restart import resumption
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Execution, record
from tests.test_restart import contents

NUMPY = {"type": "stepping", "engine": "numpy"}


def written(given_, path, processes=None, watch=None):
    """Return the outcome of a run into a file."""
    together = processes or Execution()
    scene = together.scene(pbdkit.Experiment.model_validate(given_))
    run = together.run(scene, watch or Watch())
    return record(run, run.sink(NetcdfSink(path, replace=True))).outcome


def without_ranks(path):
    values, attributes = contents(path)
    assert attributes.pop("/ranks", None) != "1"
    return values, attributes


def assert_same(one, other):
    (values, attributes), (others, theirs) = without_ranks(one), without_ranks(other)
    assert attributes == theirs
    assert values.keys() == others.keys()
    for name, value in values.items():
        np.testing.assert_array_equal(value, others[name], err_msg=name)


def compare(given_, folder, size):
    """Run like one process or, if that refuses the run, return the same message."""
    one, several = folder / "one.nc", folder / "several.nc"
    alone, together = (
        written_or_refused(given_, one),
        lambda ranks: written_or_refused(given_, several, ranks),
    )
    found = on_ranks(size, together)
    if "too few for" in str(found[0]):  # random bodies may have fewer rows than there are parts
        return found[0]
    assert found == [alone] * size
    if not isinstance(alone, str):
        assert_same(one, several)
    return alone


def written_or_refused(given_, path, processes=None):
    try:
        return written(given_, path, processes)
    except pbdkit.ExperimentError as error:
        return str(error)


def sheet(**parts):
    base = {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 17, "rows": 7},
        "rule": {"type": "barycentre"},
        "leaders": [HOLD_LEFT, pull_right(0.3, 0.1) | {"until": 9}],
        "steps": 40,
        "record": {"every": 7},
        "solver": NUMPY,
    }
    return base | parts


def still_neighbours(given_):
    """Neighbours that come and go stay in one process."""
    return given_["neighbours"].get("reevaluate") is not True


@samples(5)
@given(experiments().filter(still_neighbours), st.integers(2, 4))
def test_random_scenes(tmp_path_factory, given_, size):
    compare(given_ | {"solver": NUMPY}, tmp_path_factory.mktemp("ranks"), size)


@samples(5)
@given(
    experiments(leaders=pulled_apart(), fracturing=st.just(True)).filter(still_neighbours),
    st.integers(2, 3),
)
def test_broken_scenes(tmp_path_factory, given_, size):
    compare(given_ | {"solver": NUMPY}, tmp_path_factory.mktemp("ranks"), size)


@samples(5)
@given(calibrated_experiments(), st.integers(2, 3))
def test_calibrated_scenes(tmp_path_factory, given_, size):
    solver = given_.get("solver", {})
    assume(solver.get("type", "stepping") == "stepping")
    compare(given_ | {"solver": NUMPY | solver}, tmp_path_factory.mktemp("ranks"), size)


ELASTIC = {
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "frame": {"type": "natural"},
    "leaders": [HOLD_LEFT],
}


def along(motion, **more):
    """A group that lies in all parts."""
    return [HOLD_LEFT, {"select": {"box": [0.5, 5.5, 17.0, 7.0]}, "motion": motion} | more]


UP = {"type": "velocity", "velocity": [0.02, 0.1], "steps": 15}
DOWN = UP | {"velocity": [0.0, -0.1]}
DISC = {"type": "disc", "centre": [8.0, 9.0], "radius": 2.0}
MEASURED = ("strain", "stress", "rotation", "strain-energy", "reaction", "smallest-cell-area")
CASES = {
    "leaders in all parts": {"leaders": along(UP)},
    "everything in motion": {"initial": {"type": "noise", "amplitude": 0.1}, "leaders": []},
    "memory": {"solver": NUMPY | {"relaxation": 0.8, "memory": 0.4}},
    "single precision": {"solver": NUMPY | {"precision": "float32"}},
    "settling": {"solver": NUMPY | {"settle": {"tolerance": 0.2}}, "steps": 4000},
    "numbers of particles": {"rule": Tiring(spread=0.1)},
    "numbers of bonds": {"fracture": Weakest(spread=0.1)},
    "damage": {"fracture": {"type": "damage", "onset": 0.1, "failure": 0.4}},
    "torn by the stress of cells": ELASTIC
    | {
        "fracture": {"type": "cohesive", "energy": 0.05, "onset": 0.1},
        "initial": {"type": "noise", "amplitude": 0.1},
    },
    "diverging": {"solver": NUMPY | {"relaxation": 4.0}, "steps": 400},
    "every diagnostic of bonds": {
        "fracture": {"type": "threshold", "thresholds": [1.4371]},
        "diagnostics": [{"type": t} for t in ("broken", "crack-path", "pe1-intact")],
    },
}


OTHERS = {
    "masses": ELASTIC | {"leaders": along({"type": "newton", "mass": 40.0, "force": [0.02, 0.05]})},
    "rollers": ELASTIC | {"leaders": along(UP, axes=["y"])},
    "loads": ELASTIC | {"loads": [{"select": {"edge": "top"}, "force": [0.01, 0.02]}]},
    "an obstacle": ELASTIC
    | {"obstacles": [{"shape": DISC, "motion": {**UP, "velocity": [0, -0.1]}}]},
    "rollers and masses between obstacles": ELASTIC
    | {
        "leaders": [
            *along(UP | {"velocity": [0.02, 0.0]}, axes=["x"]),
            {"select": {"edge": "bottom"}, "motion": {"type": "newton", "mass": 40.0}, "from": 3},
        ],
        "obstacles": [
            {"shape": DISC, "motion": {**UP, "velocity": [0, -0.1]}},
            {"shape": {"half_plane": {"point": [0, 7.0], "normal": [0.3, -1]}}, "motion": DOWN},
            {"shape": {"half_plane": {"point": [17.1, 6.0], "normal": [-1, -1]}}},
            {"shape": {"half_plane": {"point": [0, -1.0], "normal": [0.0, 1.0]}}, "motion": UP},
        ],
        "diagnostics": [{"type": "contact", "youngs_modulus": 1.0}],
    },
    "bonds to the frame are spared": {
        "fracture": {"type": "threshold", "thresholds": [1.1], "frame_bonds": False},
        "initial": {"type": "affine", "gradient": [[0.2, 0.0], [0.0, 0.2]]},
        "frame": {"type": "none"},
        "diagnostics": [],
    },
    "frame points with bonds that reach far": {
        "neighbours": {"type": "euclidean", "radius": 4.0},
        "frame": {"type": "mean", "layers": 1},
        "cuts": [{"from": [5.5, -1.0], "to": [5.5, 3.5], "at": 5}],
        "steps": 8,
    },
    "cuts": {"cuts": [{"from": [5.5, -1.0], "to": [5.5, 3.5], "at": 5}]},
    "cells that the outline cuts": ELASTIC
    | {
        "body": {
            "type": "difference",
            "of": [
                {"type": "rectangle", "width": 16.4, "height": 6.3},
                {"type": "disc", "radius": 2.2, "centre": [8.1, 3.2]},
            ],
        },
        "leaders": [HOLD_LEFT, {"select": {"edge": "top"}, "motion": UP}],
        "diagnostics": [{"type": "strain"}, {"type": "stress", "youngs_modulus": 1.0}],
    },
    "a course": {
        "rule": {"type": "mixed-coordinate", "K": {"steps": [0, 20], "values": [0.0, -0.004]}}
    },
    "a field": ELASTIC
    | {
        "regions": {"inner": DISC | {"centre": [8.0, 3.0]}},
        "rule": ELASTIC["rule"] | {"stiffness": {"otherwise": 1.0, "inner": 5.0}},
        "leaders": along(UP),
    },
    "rules on the moves of another": {
        "rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.5},
        "neighbours": ELASTIC["neighbours"],
        "leaders": along(UP),
    },
    "lag": {"frame": {"type": "mean", "layers": 2, "lag": 1}, "leaders": along(UP)},
    "weights that are found": {"solver": NUMPY | {"relaxation": "auto", "memory": "auto"}},
    "every diagnostic of cells": ELASTIC
    | {
        "leaders": along(UP),
        "diagnostics": [{"type": name} for name in MEASURED],
        "units": {"length": "1 mm", "youngs_modulus": "200 GPa", "thickness": "1 mm"},
    },
}


class AheadBefore(pbdkit.Diagnostic):
    """Position of the particle three lines ahead before the last step."""

    type: Literal["ahead-before"] = "ahead-before"
    line: int

    local: ClassVar[bool] = True

    def variables(self):
        dims = ("particle", "axis")
        return (pbdkit.plugin.Variable("ahead_before", dims, "Ahead, a step ago", "lattice unit"),)

    def measure(self, now):
        found = np.zeros_like(now.displacement())
        found[: -self.line] = now.previous_displacement()[self.line :]
        found[~now.body] = np.nan
        return (found,)


@pytest.mark.parametrize("memory", [0.0, 0.3])
def test_rules_read_the_positions_of_distant_ranks(memory, tmp_path):
    """After several steps without an exchange a part has little of that right beyond its own."""
    parts = {
        "body": {"type": "grid", "columns": 200, "rows": 3},
        "frame": {"type": "none"},
        "initial": {"type": "noise", "amplitude": 0.3},
        "diagnostics": [AheadBefore(line=3 * 3)],
        "record": {"every": 8},
        "solver": NUMPY | {"memory": memory},
    }
    compare(sheet(**parts), tmp_path, 3)


def test_sums_over_cells_have_a_fixed_order(tmp_path, monkeypatch):
    monkeypatch.setattr("pbdkit.lattice.cells.CELLS_AT_ONCE", 30)  # so that bodies are cut
    compare(sheet(**OTHERS["every diagnostic of cells"]), tmp_path, 3)


@pytest.mark.parametrize("name", in_turn(OTHERS, 3))
def test_further_kinds_of_scenes(name, tmp_path):
    compare(sheet(**OTHERS[name]), tmp_path, 3)


COMPILED = ("single precision", "settling", "numbers of particles", "damage")
"""Scenes that differ in what ranks hand to kernels, each of which takes seconds to compile. That
kernels do as numpy does is tested with the engine."""


@pytest.mark.parametrize(
    ("name", "engine"),
    [*((name, "numpy") for name in in_turn(CASES, 3)), *((name, "compiled") for name in COMPILED)],
)
def test_every_kind_of_scene(name, engine, tmp_path, request):
    """Kernels of runs of a few steps are interpreted, and compiled in the profile `long`."""
    if engine == "compiled" and name != "settling":
        request.getfixturevalue("compiled_at_length")
    parts = CASES[name]
    solver = NUMPY | parts.get("solver", {}) | {"engine": engine}
    compare(sheet(**parts | {"solver": solver}), tmp_path, 3)


def stopping_after(looks):
    asked = count()
    return Watch(lambda: next(asked) >= looks)


@pytest.mark.parametrize("sizes", in_turn([(3, 2), (2, 1), (1, 3)], 3))
def test_resumed_on_another_number_of_processes(sizes, tmp_path, monkeypatch):
    """Stored and recorded data is read piece by piece."""
    for what in ("io.run_store.PART_BYTES", "restart.BLOCK_BYTES"):
        monkeypatch.setattr(f"pbdkit.{what}", 600)
    given_ = sheet(fracture={"type": "damage", "onset": 0.1, "failure": 0.4})
    one, several = tmp_path / "one.nc", tmp_path / "several.nc"
    written(given_, one)

    def begin(ranks):
        return written(given_, several, ranks, stopping_after(3)).status

    def resume(ranks):
        found = resumption(several, Watch(), execution=ranks)
        return found.record().outcome.status

    assert set(on(sizes[0], begin)) == {"interrupted"}
    assert set(on(sizes[1], resume)) == {"complete"}
    assert_same(one, several)

    def longer(ranks):
        return resumption(several, Watch(), steps=60, execution=ranks).record().outcome.steps

    written(given_ | {"steps": 60}, one)
    assert set(on(sizes[0], longer)) == {60}
    assert_same(one, several)


def test_damaged_state_is_reported_in_all_processes(tmp_path):
    """Also where the first process comes upon it while others wait for their parts."""
    path = tmp_path / "out.nc"
    begin = partial(written, sheet(), path, watch=stopping_after(3))
    assert on_ranks(3, lambda ranks: begin(processes=ranks).status)[0] == "interrupted"
    with closing(sqlite3.connect(f"{path}.run")) as store:
        changed = store.execute("UPDATE pieces SET data = x'00' WHERE key LIKE 'array/%.u/0'")
        assert changed.rowcount == 1
        store.commit()

    def resume(ranks):
        with pytest.raises(pbdkit.StorageError, match="is damaged"):
            resumption(path, Watch(), execution=ranks)
        return True

    assert on_ranks(3, resume) == [True] * 3


def on(size, work):
    return on_ranks(size, work) if size > 1 else [work(Execution())]


def test_lattice_with_too_few_rows_is_refused(tmp_path):
    small = sheet(body={"type": "grid", "columns": 3, "rows": 7})
    with pytest.raises(pbdkit.ExperimentError, match="too few for 9 processes; start fewer"):
        on_ranks(9, lambda ranks: written(small, tmp_path / "out.nc", ranks))
    assert list(tmp_path.iterdir()) == []


@given(st.integers(2, 6), st.integers(30, 200))
def test_partition_covers_all_rows_once_and_is_balanced(parts, columns):
    scene = build_scene(
        pbdkit.Experiment.model_validate(
            sheet(body={"type": "grid", "columns": columns, "rows": 2})
        )
    )
    found = subdomains(scene, parts)
    rows = [row for part in found for row in range(part.begin, part.end)]
    assert rows == list(range(scene.raster.shape[1]))
    sizes = [int((scene.raster.kind[:, part.begin : part.end] >= 0).sum()) for part in found]
    assert max(sizes) - min(sizes) <= 2 * 4 * parts


@pytest.mark.parametrize("names", [("PMI_SIZE",), ("OMPI_COMM_WORLD_SIZE", "PMIX_RANK")])
def test_unconnected_processes_are_refused(names, monkeypatch, call):
    """The launcher belongs to one MPI and mpi4py to another."""
    for name in names:
        monkeypatch.setenv(name, "2")
    monkeypatch.setattr("pbdkit.mpi.launch.refuse_without", lambda *missing: None)
    monkeypatch.setitem(sys.modules, "mpi4py", SimpleNamespace(MPI=Alone))
    done = call("run", "e.json")
    assert done.code == 2
    assert "2 processes were started" in done.err
    assert not Path("tensile.nc").exists()


def test_without_an_mpi_library_the_message_names_one(monkeypatch, tmp_path, call):
    """mpi4py installs without, and looks for one when it is imported."""
    (tmp_path / "mpi4py").mkdir()
    (tmp_path / "mpi4py" / "__init__.py").write_text("")
    (tmp_path / "mpi4py" / "MPI.py").write_text("raise RuntimeError('cannot load MPI library')")
    for module in [name for name in sys.modules if name.split(".")[0] == "mpi4py"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PMI_SIZE", "2")
    done = call("run", "e.json")
    assert done.code == 2
    assert "mpi4py finds no MPI library; install one, for instance by pip install mpich" in done.err


class Alone:
    COMM_WORLD = SimpleNamespace(size=1)
