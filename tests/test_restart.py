"""A run that is stopped and resumed is the uninterrupted one, bit for bit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import assume, given
from scene_strategies import experiments, in_turn, samples

import pbdkit
from pbdkit.io import netcdf as netcdf_sink
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.sinks import MemorySink, OverlappingSink
from pbdkit.progress import Watch
from pbdkit.restart import resumption
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

Call = Callable[..., Any]
OUT = Path("tensile.nc")
EVERYTHING = [{"type": "pe1"}, {"type": "displacement"}, {"type": "track", "numbers": [13]}]
FRACTURE = {"type": "threshold", "thresholds": [1.6]}
LOADED: dict[str, Any] = {
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "springs"},
    "frame": {"type": "natural"},
    "loads": [{"select": {"edge": "top"}, "force": [0.0, 0.02], "from": 3, "until": 6}],
    "diagnostics": [{"type": "load-displacement", "youngs_modulus": 1.0}],
}
SOFTENED: dict[str, Any] = {
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.2},
    "frame": {"type": "natural"},
    "fracture": {"type": "cohesive", "energy": 0.1, "onset": 0.1},
}
COMES = [
    {
        "shape": {"type": "disc", "radius": 3.0, "centre": [4.5, 14.0]},
        "motion": {"type": "velocity", "velocity": [0.0, -0.2], "steps": 12},
    }
]
RUNS: dict[str, dict[str, Any]] = {
    "plain": {},
    "everything": {"diagnostics": EVERYTHING},
    "memory": {"solver": {"type": "stepping", "relaxation": 0.7, "memory": 0.4}},
    "fracture": {"fracture": FRACTURE},
    "float32": {"solver": {"type": "stepping", "precision": "float32"}},
    "small records": {"record": {"every": 3, "dtype": "float32"}},
    "zlib": {"record": {"every": 1, "compression": "zlib"}, "diagnostics": EVERYTHING},
    "auto": {"solver": {"type": "stepping", "relaxation": "auto", "memory": "auto"}},
    "settles": {"solver": {"type": "stepping", "settle": {"tolerance": 1e-2}}, "steps": 3000},
    "diverges": {"solver": {"type": "stepping", "relaxation": 9.0}, "steps": 900},
    "obstacles": {"obstacles": COMES},
    "equilibrium": {"solver": {"type": "equilibrium"}},
    "loads": LOADED,
    "equilibrium, loads": LOADED | {"solver": {"type": "equilibrium"}},
    "equilibrium, obstacles": {"solver": {"type": "equilibrium"}, "obstacles": COMES},
    "softened cells": SOFTENED,
    "equilibrium, softened cells": SOFTENED
    | {"solver": {"type": "equilibrium", "increments": 4, "tolerance": 1e-3}},
    "equilibrium, fracture": {
        "solver": {"type": "equilibrium", "increments": 20},
        "fracture": FRACTURE,
    },
}


def scene_of(given: dict[str, Any]) -> Any:
    return build_scene(pbdkit.Experiment(**given))


def stopping_after(looks: int) -> Watch:
    asked = count()
    return Watch(lambda: next(asked) >= looks)


def run_in_parts(given: dict[str, Any], path: Path, looks: Iterator[int]) -> int:
    """Stop the run at intervals of some checks; return how often it was resumed."""
    scene = scene_of(given)
    sink = OverlappingSink(NetcdfSink(path, False, scene.experiment.record.compression))
    report = record(Simulation.of_scene(scene, watch=stopping_after(next(looks))), sink)
    for resumed in count():
        if report.outcome.status != "interrupted":
            return resumed
        found = resumption(path, stopping_after(next(looks)))
        assert found is not None
        report = found.record()
    raise AssertionError


def contents(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return all variables, those of the final state too, and attributes except the time of
    creation and the versions of the libraries, which h5netcdf writes into new files only."""
    values, attributes = {}, dict[str, Any]()
    with h5py.File(path, "r") as file:
        for group in (file, *(item for item in file.values() if isinstance(item, h5py.Group))):
            attributes |= {f"{group.name}{name}": value for name, value in group.attrs.items()}
            for name, item in group.items():
                if isinstance(item, h5py.Dataset):
                    values[f"{group.name}{name}"] = item[...]
    facts = json.loads(attributes.pop("/final_statefacts"))
    attributes.pop("/_NCProperties", None)
    del attributes["/created"], facts["at"], facts["rate"]
    return values, attributes | {"facts": facts}


def assert_same(one: Path, other: Path) -> None:
    (values, attributes), (values_2, attributes_2) = contents(one), contents(other)
    assert attributes == attributes_2
    assert values.keys() == values_2.keys()
    for name, value in values.items():
        assert value.dtype == values_2[name].dtype, name
        np.testing.assert_array_equal(value, values_2[name], err_msg=name)


@pytest.mark.parametrize("change", in_turn(RUNS, 2))
def test_run_in_parts_equals_the_whole_run(
    change: str, tensile: dict[str, Any], tmp_path: Path
) -> None:
    given = tensile | RUNS[change]
    whole, parts = tmp_path / "whole.nc", tmp_path / "parts.nc"
    record(Simulation.of_scene(scene_of(given)), NetcdfSink(whole))
    random = np.random.default_rng(len(change))
    looks = (int(random.integers(0, 2 + 4 * n)) for n in count())
    assert run_in_parts(given, parts, looks) > 0
    assert_same(whole, parts)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts.nc", "whole.nc"]


@samples(6)
@given(experiments())
def test_any_run_in_parts_is_the_whole_run(tmp_path_factory: Any, given: dict[str, Any]) -> None:
    folder = tmp_path_factory.mktemp("parts")
    try:
        record(Simulation.of_scene(scene_of(given)), NetcdfSink(folder / "whole.nc"))
    except pbdkit.ExperimentError:  # leaders that contradict each other, perhaps on the way
        assume(False)
    run_in_parts(given, folder / "parts.nc", iter([1, 2, 3, 10**9]))
    assert_same(folder / "whole.nc", folder / "parts.nc")


def test_run_resumes_from_any_commit(
    tensile: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files in the folder after each commit, as a kill leaves them, are sufficient; bytes after
    it do no harm."""
    given = tensile | RUNS["everything"] | {"fracture": FRACTURE, "steps": 5}
    monkeypatch.setattr(netcdf_sink, "EVERY_S", 0.0)
    monkeypatch.setattr(netcdf_sink, "SHARE", 0)
    whole, live = tmp_path / "whole.nc", tmp_path / "live"
    record(Simulation.of_scene(scene_of(given)), NetcdfSink(whole))
    live.mkdir()
    sink = NetcdfSink(live / "out.nc", first_s=0.0)
    keep = sink.keep

    def keep_and_copy(standing: Any) -> None:
        keep(standing)
        shutil.copytree(live, tmp_path / f"kill-{standing.facts['step']}")

    monkeypatch.setattr(sink, "keep", keep_and_copy)
    record(Simulation.of_scene(scene_of(given)), sink)
    killed = sorted(tmp_path.glob("kill-*"))
    assert len(killed) == given["steps"]
    for folder in killed:
        records = folder / "out.nc.run-records"
        records.write_bytes(records.read_bytes() + b"what was not committed")
        found = resumption(folder / "out.nc", Watch())
        assert found is not None
        found.record()
        assert_same(whole, folder / "out.nc")
        assert [path.name for path in folder.iterdir()] == ["out.nc"]


@pytest.fixture
def stopped(call: Call, tensile: dict[str, Any]) -> dict[str, Any]:
    """An unfinished run of tensile.nc in the current folder."""
    sink = NetcdfSink(OUT, origin={"experiment": "e.json", "settings": []})
    given = tensile | {"steps": 40}
    Path("e.json").write_text(json.dumps(given))
    report = record(Simulation.of_scene(scene_of(given), watch=stopping_after(20)), sink)
    assert (report.outcome.status, OUT.exists()) == ("interrupted", False)
    return given


def test_unfinished_run_can_be_inspected(stopped: dict[str, Any], call: Call) -> None:
    before = {path: path.read_bytes() for path in Path().iterdir()}
    result = call("status", str(OUT))
    assert result.out.startswith("tensile.nc: step 20 of 40, stopped\n")
    assert json.loads(call("status", str(OUT), "--json").out)["state"] == "stopped"
    for name in (OUT, f"{OUT}.run"):
        with pbdkit.open(name) as ds:
            assert ds.attrs["status"] == "interrupted"
            assert ds.time.values.tolist() == list(range(21))
            ds.load()
    assert call("plot", str(OUT), "-o", "p.png").code == 0
    Path("p.png").unlink()
    assert {path: path.read_bytes() for path in Path().iterdir()} == before


def test_a_run_beside_an_unfinished_one_is_refused(stopped: dict[str, Any], call: Call) -> None:
    refused = call("run", "e.json")
    assert refused.code == 2
    assert "`pbdkit resume tensile.nc` continues it" in refused.err
    assert call("run", "e.json", "--force").code == 0
    assert sorted(path.name for path in Path().iterdir()) == ["e.json", "tensile.nc"]


def test_python_resumes_a_run(stopped: dict[str, Any]) -> None:
    whole = pbdkit.run(stopped, progress=False)
    with pbdkit.resume(OUT, progress=False) as ds:
        for name in whole.variables:
            np.testing.assert_array_equal(ds[name], whole[name])
    with pytest.raises(pbdkit.ExperimentError, match=r"is finished; --steps N continues it"):
        pbdkit.resume(OUT)
    with pytest.raises(pbdkit.ExperimentError, match="neither an unfinished run nor a result"):
        pbdkit.resume("none.nc")


def test_changes_since_the_start_are_refused(
    stopped: dict[str, Any], call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("e.json").write_text(json.dumps(stopped | {"seed": 7}))
    refused = call("resume", str(OUT))
    assert (refused.code, "e.json has changed since the run started" in refused.err) == (2, True)
    Path("e.json").write_text(json.dumps(stopped))
    with monkeypatch.context() as other:
        other.setattr("pbdkit.restart.version", lambda name: "99.0")
        refused = call("resume", str(OUT))
        assert (refused.code, "and 99.0 is installed" in refused.err) == (2, True)
        assert call("resume", str(OUT), "--anyway").code == 0


CONTINUED = ["plain", "everything", "memory", "fracture", "small records", "zlib", "settles"]


@pytest.mark.parametrize("change", in_turn(CONTINUED, 2))
def test_finished_run_is_extended_to_the_longer_one(
    change: str, tensile: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pbdkit.restart.BLOCK_BYTES", 3000)  # several rows, not all
    given = tensile | RUNS[change]
    given |= {"steps": given.get("steps", 10) + 17}
    whole, shorter = tmp_path / "whole.nc", tmp_path / "shorter.nc"
    record(Simulation.of_scene(scene_of(given)), NetcdfSink(whole))
    record(Simulation.of_scene(scene_of(given | {"steps": 10})), NetcdfSink(shorter))
    with pbdkit.resume(shorter, steps=given["steps"], progress=False) as ds:
        assert ds.time[-1] > 10
    assert_same(whole, shorter)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["shorter.nc", "whole.nc"]


BLOCK: dict[str, Any] = {
    "name": "block",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"numbers": [20]},
            "motion": {"type": "displace", "displacement": [0.1, 0.0]},
        },
    ],
    "solver": {"type": "stepping", "relaxation": 0.8, "settle": {"tolerance": 0.1}},
    "record": {"every": 50},
}
"""The run converges within 60 steps, unless there are later events."""
TURNS = {"type": "rotation", "centre": [0.0, 3.0], "angle": 2.0, "steps": 130}
LATER: dict[str, dict[str, Any]] = {
    "nothing": {},
    "a group": {
        "leaders": [
            *BLOCK["leaders"],
            {
                "select": {"numbers": [13]},
                "motion": {"type": "displace", "displacement": [0.0, 0.3]},
                "from": 150,
            },
        ]
    },
    "a motion that goes on": {
        "leaders": [BLOCK["leaders"][0], {"select": {"edge": "right"}, "motion": TURNS}]
    },
    "a group that ends": {"leaders": [BLOCK["leaders"][0], BLOCK["leaders"][1] | {"until": 140}]},
    "a load": {"loads": [{"select": {"edge": "right"}, "force": [0.0, -0.2], "from": 150}]},
    "a load that ends": {
        "loads": [{"select": {"edge": "right"}, "force": [0.0, -0.2], "until": 150}]
    },
    "an obstacle": {
        "obstacles": [
            {
                "shape": {"type": "disc", "radius": 3.0, "centre": [2.0, 5.9]},
                "motion": {"type": "displace", "displacement": [0.0, -0.2]},
                "from": 150,
            }
        ]
    },
    "a course": {
        "rule": {
            "type": "elastic",
            "poisson_ratio": 0.3,
            "stiffness": {"steps": [130, 160], "values": [1.0, 0.5]},
        },
        "loads": [{"select": {"edge": "right"}, "force": [0.0, -0.02]}],
    },
    "a course of a load": {
        "loads": [
            {
                "select": {"edge": "right"},
                "force": [0.0, {"steps": [40, 150], "values": [-0.01, -0.2]}],
            }
        ]
    },
    "a rule that is not linear": {
        "rule": {"type": "distance-weighted"},
        "frame": {"type": "mean"},
        "leaders": [
            BLOCK["leaders"][0],
            {
                "select": {"edge": "right"},
                "motion": {"type": "displace", "displacement": [0.6, 0.2]},
            },
        ],
        "solver": BLOCK["solver"] | {"relaxation": 0.5},
    },
}


@pytest.mark.parametrize("later", in_turn(LATER, 3))
@pytest.mark.filterwarnings("ignore:.* (begins|after the last step)")
def test_converging_run_is_extended_to_the_longer_one(later: str, tmp_path: Path) -> None:
    """Events after the shorter run take place, whether or not it has converged."""
    given, whole = BLOCK | LATER[later] | {"steps": 400}, tmp_path / "whole.nc"
    outcome = record(Simulation.of_scene(scene_of(given)), NetcdfSink(whole)).outcome
    assert outcome.status == "settled"
    assert outcome.steps > (8 if later in ("nothing", "a rule that is not linear") else 129)
    for shorter in (7, 60):
        part = tmp_path / f"part-{shorter}.nc"
        record(Simulation.of_scene(scene_of(given | {"steps": shorter})), NetcdfSink(part))
        found = resumption(part, Watch(), steps=400)
        assert found is not None
        found.record()
        assert_same(whole, part)


@pytest.mark.parametrize("later", ["a load", "a rule that is not linear"])
def test_interrupted_run_is_extended_to_more_steps(later: str, tmp_path: Path) -> None:
    given = BLOCK | LATER[later] | {"record": {"every": 1}}
    whole, part = tmp_path / "whole.nc", tmp_path / "part.nc"
    record(Simulation.of_scene(scene_of(given | {"steps": 900})), NetcdfSink(whole))
    record(
        Simulation.of_scene(scene_of(given | {"steps": 80}), watch=stopping_after(40)),
        NetcdfSink(part),
    )
    found = resumption(part, Watch(), steps=900)
    assert found is not None
    assert found.record().first > 5
    assert_same(whole, part)


def test_run_stopped_at_its_last_check_converges_nevertheless(tmp_path: Path) -> None:
    given = BLOCK | {"record": {"every": 1}, "steps": 400}
    steps = record(Simulation.of_scene(scene_of(given)), MemorySink()).outcome.steps
    given, whole = given | {"steps": steps}, tmp_path / "whole.nc"
    record(Simulation.of_scene(scene_of(given)), NetcdfSink(whole))
    stops = []
    for looks in count(steps + 2):
        part = tmp_path / f"part-{looks}.nc"
        report = record(
            Simulation.of_scene(scene_of(given), watch=stopping_after(looks)), NetcdfSink(part)
        )
        if report.outcome.status != "interrupted":
            break
        stops.append(report.outcome.steps)
        found = resumption(part, Watch())
        assert found is not None
        assert found.record().outcome.status == "settled"
        assert_same(whole, part)
    assert stops[-1] == steps


@pytest.mark.filterwarnings("ignore:.* starts after the last step")
def test_interrupted_run_is_not_mistaken_for_a_shorter_one(tmp_path: Path) -> None:
    """A run of 100 steps would have converged before the load of the longer one."""
    given, part = BLOCK | LATER["a load"] | {"record": {"every": 1}}, tmp_path / "part.nc"
    record(
        Simulation.of_scene(scene_of(given | {"steps": 900}), watch=stopping_after(40)),
        NetcdfSink(part),
    )
    with pytest.raises(pbdkit.ExperimentError, match="100 steps tests convergence from step 1 on"):
        resumption(part, Watch(), steps=100)
    found = resumption(part, Watch())
    assert found is not None
    assert found.record().outcome.status == "settled"


def test_resumed_equilibrium_search_is_unchanged(tensile: dict[str, Any], tmp_path: Path) -> None:
    given, part = tensile | RUNS["equilibrium, fracture"], tmp_path / "part.nc"
    record(Simulation.of_scene(scene_of(given), watch=stopping_after(9)), NetcdfSink(part))
    steps = given["steps"]
    with pytest.raises(
        pbdkit.ExperimentError, match="the load path to an equilibrium depends on `steps`"
    ):
        resumption(part, Watch(), steps=steps + 5)
    assert resumption(part, Watch(), steps=steps) is not None


def test_automatic_weights_are_those_of_the_longer_run(tmp_path: Path) -> None:
    """If roles change between the ends of both runs other groups are needed."""
    solver = {"type": "stepping", "relaxation": "auto", "memory": "auto"}
    given = BLOCK | {"solver": solver}
    whole, part = tmp_path / "whole.nc", tmp_path / "part.nc"
    record(Simulation.of_scene(scene_of(given | {"steps": 60})), NetcdfSink(whole))
    record(Simulation.of_scene(scene_of(given | {"steps": 9})), NetcdfSink(part))
    for steps in (30, 60):  # what was chosen is known of a run that was itself continued
        found = resumption(part, Watch(), steps=steps)
        assert found is not None
        found.record()
    assert_same(whole, part)
    given |= {"leaders": [BLOCK["leaders"][0], BLOCK["leaders"][1] | {"until": 20}]}
    record(Simulation.of_scene(scene_of(given | {"steps": 9})), NetcdfSink(part, True))
    with pytest.raises(
        pbdkit.ExperimentError, match=r": the completed steps used relaxation 1\.5782, .* uses 1\.8"
    ):
        resumption(part, Watch(), steps=60)
    found = resumption(part, Watch(), steps=60, anyway=True)
    assert found is not None
    assert found.record().outcome.status == "complete"
    given |= {"steps": 15, "record": {"every": 1}}
    record(
        Simulation.of_scene(scene_of(given), watch=stopping_after(5)),
        NetcdfSink(tmp_path / "left.nc"),
    )
    with pytest.raises(pbdkit.ExperimentError, match=r": the completed steps used .* uses 1\.8"):
        resumption(tmp_path / "left.nc", Watch(), steps=60)
    found = resumption(tmp_path / "left.nc", Watch())
    assert found is not None
    assert found.record().outcome.status == "complete"


def test_run_with_infinite_distance_can_be_resumed(tmp_path: Path) -> None:
    """A body that loads push and that no leader holds has no equilibrium."""
    given = BLOCK | {
        "rule": {"type": "springs"},
        "leaders": [],
        "loads": [{"select": {"edge": "right"}, "force": [0.01, -0.02]}],
        "steps": 60,
    }
    whole, part = tmp_path / "whole.nc", tmp_path / "part.nc"
    record(Simulation.of_scene(scene_of(given | {"steps": 90})), NetcdfSink(whole))
    run = Simulation.of_scene(scene_of(given))
    record(run, NetcdfSink(part))
    assert run.driver.state_dict()["pace"].bounded[1] == np.inf
    found = resumption(part, Watch(), steps=90)
    assert found is not None
    found.record()
    assert_same(whole, part)


def test_unsupported_continuations_are_refused(
    tensile: dict[str, Any], call: Call, tmp_path: Path
) -> None:
    for status, change in (("diverged", "diverges"), ("an equilibrium", "equilibrium")):
        record(
            Simulation.of_scene(scene_of(tensile | RUNS[change])),
            NetcdfSink(tmp_path / "out.nc", True),
        )
        refused = call("resume", str(tmp_path / "out.nc"), "--steps", "5000")
        assert (refused.code, status in refused.err) == (2, True), refused.err
    record(Simulation.of_scene(scene_of(tensile)), NetcdfSink(tmp_path / "short.nc"))
    refused = call("resume", str(tmp_path / "short.nc"), "--steps", "3")
    assert "steps are completed; --steps must be larger" in refused.err
