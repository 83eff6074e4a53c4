"""Cuts in time: which bonds they break, when, and what follows in steps and in equilibrium."""

import json

import numpy as np
import pytest
from interpreted_kernels import interpreting
from scene_strategies import in_turn

import pbdkit

HEIGHT = 8
CUT = {"from": [-1.0, 3.5], "to": [3.2, 3.5]}


def moved(edge, way, steps=10):
    motion = {"type": "velocity", "velocity": [0.0, way / steps], "steps": steps}
    return {"select": {"edge": edge}, "motion": motion}


PLATE = {
    "name": "plate",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 9, "rows": HEIGHT},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "springs"},
    "frame": {"type": "natural"},
    "leaders": [moved("bottom", -0.02), moved("top", 0.02)],
    "steps": 40,
    "diagnostics": [{"type": "displacement"}, {"type": "broken"}],
}
ELASTIC = {"type": "elastic", "poisson_ratio": 1 / 3}
SLOWLY = [moved("bottom", -0.02, 150), moved("top", 0.02, 150)]
STRAIGHT = {"type": "equilibrium", "tolerance": 1e-10}
MOMENTUM = {"type": "stepping", "relaxation": 0.8, "memory": 0.8}
"""Steps that converge in a few hundred."""


def run(**parts):
    return pbdkit.run(PLATE | parts, progress=False)


def cut(at):
    return [CUT | {"at": at}]


def crossed(ds):
    """Return whether each bond crosses the cut, by its ends."""
    a, b = (ds.reference.values[ds.bond_ends.values[:, end] - 1] for end in (0, 1))
    parted = (a[:, 1] > 3.5) != (b[:, 1] > 3.5)
    return parted & ((a + b)[:, 0] / 2 <= 3.2)


def test_only_crossing_bonds_are_cut_in_their_step():
    ds = run(cuts=cut(20))
    assert np.array_equal(ds.broken_step.values, np.where(crossed(ds), 20, -1))
    assert np.isnan(ds.broken_strain.values).all()
    assert ds.broken_bonds.values.tolist() == [0] * 20 + [int(crossed(ds).sum())] * 21
    until = ds.u.values[:20]
    assert np.array_equal(until, run(steps=19).u.values)
    assert not np.array_equal(ds.u.values[20], run().u.values[20])


@pytest.mark.parametrize(
    "fracture",
    [{"type": "strain", "failure": 9.0}, {"type": "damage", "onset": 8.0, "failure": 9.0}],
)
def test_a_cut_before_the_first_step_is_a_crack(fracture):
    crack = fracture | {"cracks": [[CUT["from"], CUT["to"]]]}
    one, other, alone = run(fracture=crack), run(fracture=fracture, cuts=cut(0)), run(cuts=cut(0))
    assert (one.broken_step.values == 0).any()
    for ds in (other, alone):
        assert np.array_equal(one.u.values, ds.u.values)
        assert np.array_equal(one.broken_step.values, ds.broken_step.values)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_kernels_cut_like_numpy(precision, compiled_at_length):
    pytest.importorskip("numba")
    some = {"engine": "compiled", "precision": precision, "threads": 2}
    pulled = [moved("bottom", -0.9), moved("top", 0.9)]
    parts = {"cuts": [*cut(20), CUT | {"to": [5.0, 3.5], "at": 26}], "leaders": pulled}
    parts["fracture"] = {"type": "strain", "failure": 0.25}
    parts |= {"rule": {"type": "barycentre"}, "frame": {"type": "mean"}}
    found = run(**parts, solver={"type": "stepping"} | some)
    known = run(**parts, solver={"type": "stepping", "precision": precision, "engine": "numpy"})
    off = np.abs(found.u.values - known.u.values).max()
    assert off == 0.0 if precision == "float64" else off < 1e-6
    assert np.array_equal(found.broken_step.values, known.broken_step.values)
    assert np.isfinite(known.broken_strain.values).any()


def test_kernels_cut_without_a_fracture_model():
    pytest.importorskip("numba")
    rule = {"type": "barycentre"}
    parts = {"rule": rule, "frame": {"type": "mean"}, "cuts": cut(20)}
    with interpreting():
        found, known = (
            run(**parts, solver={"type": "stepping", "engine": e}) for e in ("compiled", "numpy")
        )
    assert np.array_equal(found.u.values, known.u.values)
    assert np.array_equal(found.broken_step.values, known.broken_step.values)


@pytest.mark.parametrize(
    ("rule", "at"),
    in_turn([(ELASTIC, 1), (ELASTIC, 11), ({"type": "springs"}, 40), ({"type": "springs"}, 5)], 2),
)
def test_equilibrium_of_an_elastic_body_is_independent_of_the_cut_time(rule, at):
    before, later = (run(rule=rule, cuts=cut(n), solver=STRAIGHT) for n in (0, at))
    assert later.status == "complete"
    assert set(later.broken_step.values) == {-1, at}
    assert np.abs(before.u.values[-1] - later.u.values[-1]).max() < 1e-9
    steps = run(rule=rule, cuts=cut(at), steps=300, record={"every": 300}, solver=MOMENTUM)
    assert np.abs(steps.u.values[-1] - later.u.values[-1]).max() < 1e-9


def test_fracture_of_a_loaded_body_continues_from_its_cut():
    """Under a load that the whole plate bears, and the cut one does not."""
    parts = {"fracture": {"type": "strain", "failure": 0.007}, "rule": ELASTIC}
    parts["leaders"] = SLOWLY
    assert not (run(**parts, solver=STRAIGHT, steps=300).broken_step.values >= 0).any()
    for solver, steps in ((STRAIGHT, 300), (MOMENTUM, 400)):
        ds = run(**parts, cuts=cut(200), solver=solver, steps=steps, record={"every": steps})
        was_cut, steps_of = crossed(ds), ds.broken_step.values
        assert (steps_of[was_cut] == 200).all()
        assert np.isnan(ds.broken_strain.values[was_cut]).all()
        torn = (steps_of >= 0) & ~was_cut
        assert torn.any()
        assert (steps_of[torn] >= 200).all()
        assert (ds.broken_strain.values[torn] > 0.007).all()


def test_detached_part_stays_in_place():
    """Nothing holds it from then on; the rest relaxes."""
    off = [{"from": [-1.0, 3.5], "to": [9.0, 3.5], "at": 30}]
    held = [PLATE["leaders"][0] | {"motion": {"type": "hold"}},
            PLATE["leaders"][1] | {"until": 29}]  # fmt: skip
    straight = run(cuts=off, leaders=held, rule=ELASTIC, solver=STRAIGHT)
    steps = run(cuts=off, leaders=held, rule=ELASTIC, steps=500, record={"every": 500},
                solver=MOMENTUM)  # fmt: skip
    lower = straight.reference.values[:, 1] < 3.5
    for ds in (straight, steps):
        assert np.abs(ds.u.values[-1, lower]).max() < 1e-9
        assert np.ptp(ds.u.values[-1, ~lower, 1]) < 1e-9
        assert ds.u.values[-1, ~lower, 1].mean() > 0.005


def test_runs_converge_after_their_last_cut():
    solver = MOMENTUM | {"settle": {"tolerance": 1e-6}}
    ds = run(cuts=cut(300), steps=1000, solver=solver, record={"every": 1000})
    assert ds.status == "settled"
    assert ds.time.values[-1] > 300
    assert run(steps=1000, solver=solver, record={"every": 1000}).time.values[-1] < 300


def test_explain_distinguishes_cut_from_broken_bonds(call, tmp_path):
    file = tmp_path / "plate.json"
    parts = {"fracture": {"type": "strain", "failure": 0.007}, "cuts": [*cut(200)], "steps": 400,
             "leaders": SLOWLY, "solver": MOMENTUM}  # fmt: skip
    file.write_text(json.dumps(PLATE | parts))
    assert call("run", str(file), "-o", "out.nc", "--quiet").code == 0
    told = json.loads(call("explain", "out.nc", "--json").out)
    cuts = [s for s in told["in_order"] if s["state"] == "cut"]
    assert told["cut"] == len(cuts) == 10
    assert told["broken"] == len(told["in_order"]) - 10 > 0
    assert {(s["step"], s["strain_at_break"]) for s in cuts} == {(200, None)}
    assert told["in_order"][:10] == cuts
    assert "10 cut" in call("explain", "out.nc").out.splitlines()[0]
    ends = map(str, cuts[0]["bond"])
    assert "cut at the beginning of step 200" in call("explain", "out.nc", "--bond", *ends).out


def test_run_resumes_before_and_after_its_cut(call, tmp_path):
    file = tmp_path / "plate.json"
    file.write_text(json.dumps(PLATE | {"cuts": cut(20), "steps": 19}))
    whole = run(cuts=cut(20))
    with pytest.raises(pbdkit.ExperimentError, match="step 20 exceeds the number of steps, 19"):
        pbdkit.load(str(file))
    for steps in (20, 25):
        file.write_text(json.dumps(PLATE | {"cuts": cut(20), "steps": steps}))
        assert call("run", str(file), "-o", "part.nc", "--quiet", "--force").code == 0
        assert call("resume", "part.nc", "--steps", "40").code == 0
        with pbdkit.open("part.nc") as ds:
            assert np.array_equal(ds.u.values, whole.u.values)
            assert np.array_equal(ds.broken_step.values, whole.broken_step.values)


def test_run_with_a_cut_reruns_from_its_dataset():
    ds = run(cuts=cut(20))
    again = pbdkit.rerun(ds, progress=False)
    assert np.array_equal(again.u.values, ds.u.values)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"cuts": [{"from": [1.0, 1.0], "to": [1.0, 1.0]}]},
         "cuts.0.to: both ends of the cut are the same point; move one of them"),
        ({"cuts": cut(41)}, "cuts: step 41 exceeds the number of steps, 40"),
        ({"cuts": cut(-1)}, "cuts.0.at: "),
        ({"cuts": [{"from": [0.0, 0.0]}]}, "cuts.0"),
        ({"cuts": cut(3), "frame": {"type": "none"}, "rule": {"type": "barycentre"},
          "neighbours": {"type": "euclidean", "radius": 1.5, "reevaluate": True}},
         "bonds cannot be cut if neighbours are re-evaluated"),
        ({"cuts": cut(3), "rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 1.0}},
         "which is incompatible with this setting of cuts; use cuts: "),
    ],
)  # fmt: skip
def test_invalid_cuts_are_refused(parts, words):
    with pytest.raises(pbdkit.ExperimentError) as error:
        run(**parts)
    assert words in str(error.value)


def test_cut_that_misses_the_body_gives_a_warning():
    with pytest.warns(pbdkit.PbdkitWarning, match=r"cuts\.0: it crosses no bond of the body"):
        run(cuts=[{"from": [20.0, 0.0], "to": [21.0, 0.0]}], steps=1)
