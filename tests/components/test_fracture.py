"""Fracture by strain and by damage: bars of one row of bonds, where every answer is known."""

from contextlib import nullcontext

import numpy as np
import pytest
from interpreted_kernels import interpreting
from property_cases import pull_right
from scene_strategies import in_turn

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

LEFT = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
RATE = 0.03125  # exact in binary, so that strains are
DAMAGE = {"type": "damage", "onset": 0.125, "failure": 0.5}


def bar(columns, motion, fracture, **parts):
    return {
        "name": "bar",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": 1},
        "rule": {"type": "barycentre"},
        "frame": {"type": "none"},
        "fracture": fracture,
        "leaders": [LEFT, {"select": {"edge": "right"}, "motion": motion}],
        "steps": 40,
        "diagnostics": [{"type": "displacement"}, {"type": "crack-path"}],
    } | parts


def run(given, **more):
    return pbdkit.run(given, progress=False, **more)


def pulled(velocity, steps=40):
    return {"type": "velocity", "velocity": [velocity, 0.0], "steps": steps}


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("a", [1.0, 0.25])
def test_bond_breaks_if_its_strain_exceeds_failure(precision, a):
    """Both ends led: the strain in step n is n RATE, exactly, and 0.5 does not exceed 0.5."""
    given = bar(2, pulled(RATE * a), {"type": "strain", "failure": 0.5},
                lattice={"type": "square", "a": a},
                solver={"type": "stepping", "precision": precision})  # fmt: skip
    ds = run(given)
    assert ds.broken_step.values.tolist() == [17]
    assert ds.broken_strain.values.tolist() == [17 * RATE]
    assert (ds.crack_bond.values.tolist(), ds.crack_step.values.tolist()) == ([1], [17])
    assert ds.crack_midpoint.values.tolist() == [[0.5 * a, 0.0]]


@pytest.mark.parametrize("fracture", [{"type": "strain", "failure": 0.01}, DAMAGE])
def test_compression_causes_no_damage(fracture):
    ds = run(bar(2, pulled(-RATE, 30), fracture))
    assert ds.broken_step.values.tolist() == [-1]
    assert np.isnan(ds.broken_strain).all()
    assert ds.sizes["crack"] == 0
    assert not ds.get("damage", ds.u * 0).any()


@pytest.mark.parametrize("length", [1.0, 2.0])
def test_all_shells_break_at_the_same_strain(length):
    """Chebyshev's second shell lies along the row, twice as long as the first."""
    near = {"type": "chebyshev", "shells": 2}
    given = bar(1 + int(length), pulled(RATE * length), {"type": "strain", "failure": 0.5},
                neighbours=near)  # fmt: skip
    given["leaders"][0] = {"select": {"box": [-1, -1, length - 0.5, 1]}, "motion": {"type": "hold"}}
    ds = run(given)
    assert ds.broken_step.values[ds.shell.values == length].tolist() == [17]
    assert ds.broken_strain.values[ds.shell.values == length].tolist() == [17 * RATE]


def test_the_softening_curve_is_exact():
    """Both ends led, to and fro: D is that of the largest strain so far."""
    motion = {"type": "path", "steps": [10, 14, 30], "displacements":
              [[10 * RATE, 0.0], [2 * RATE, 0.0], [18 * RATE, 0.0]]}  # fmt: skip
    ds = run(bar(2, motion, DAMAGE))
    strain = ds.u.sel(axis="x").values[:, 1]
    largest = np.maximum.accumulate(strain)
    onset, failure = DAMAGE["onset"], DAMAGE["failure"]
    law = failure / (failure - onset) * (1 - onset / np.where(largest > onset, largest, onset))
    broken = int(ds.broken_step[0])
    assert strain[broken] >= failure > strain[broken - 1]
    expected = np.where(np.arange(len(law)) < broken, law, 1.0)
    np.testing.assert_allclose(ds.damage[:, 0], expected, rtol=0, atol=1e-15)
    np.testing.assert_allclose(ds.damage[10:17, 0], 0.8, rtol=1e-15)  # unloading heals nothing
    assert broken == 28
    np.testing.assert_allclose(ds.broken_strain, strain[broken], rtol=0, atol=1e-15)


@pytest.mark.parametrize("placement", [1.0, 1.2])
def test_damaged_bond_is_weighted_by_its_damage(placement):
    """One follower between two leaders: its move is the mean of (1 - D) d + D lost."""
    fracture = DAMAGE | {"placement": placement}
    given = bar(3, {"type": "displace", "displacement": [0.3, 0.0]}, fracture, steps=2)
    ds = run(given)
    one = 0.3  # the right bond's strain in step 1
    D = 0.5 / 0.375 * (1 - 0.125 / one)
    lost = placement - 1
    first = ((1 - D) * one + D * lost) / 2
    np.testing.assert_allclose(ds.u[1, 1, 0], first, rtol=0, atol=1e-15)
    left = max(0.0, 0.5 / 0.375 * (1 - 0.125 / first)) if first > 0.125 else 0.0
    assert left == ds.damage[2, 0]
    second = ((1 - D) * (0.3 - first) + D * lost - (1 - left) * first - left * lost) / 2
    np.testing.assert_allclose(ds.u[2, 1, 0] - first, second, rtol=0, atol=1e-15)


@pytest.mark.parametrize("extension", in_turn([0.3, 0.6, 0.8], 2))
@pytest.mark.parametrize("way", ["steps", "equilibrium"])
def test_a_bar_softens_at_its_weakest_bond(extension, way):
    """In series the forces are the same: F = (1 - D) ε = o (f - ε) / (f - o) in the weakest bond
    once it softens, and F = ε in the others."""
    bonds, steps = 4, 600
    fracture = {"type": "damage", "onset": 0.15, "failure": 1.2, "scatter": 0.2}
    straight = {"type": "equilibrium", "tolerance": 1e-10, "increments": 10}
    solver = straight if way == "equilibrium" else {"type": "stepping", "engine": "numpy"}
    ds = run(bar(bonds + 1, pulled(extension / 300, 300), fracture, steps=steps, solver=solver,
                 record={"every": steps}, seed=8))  # fmt: skip
    o, f = (ds[f"{name}_strain"].values for name in ("onset", "failure"))
    np.testing.assert_allclose(f / o, 8.0)
    assert ((o > 0.15 * 0.8) & (o < 0.15 * 1.2)).all()
    assert len(set(o)) == bonds
    weak = int(np.argmin(o))
    strain = np.diff(ds.u.isel(time=-1, axis=0))
    force = extension / bonds
    if force > o[weak]:
        slope = o[weak] / (f[weak] - o[weak])
        force = slope * (f[weak] - extension) / (1 - (bonds - 1) * slope)
    damage = ds.damage.isel(time=-1).values
    assert np.flatnonzero(damage > 1e-9).tolist() == ([weak] if extension / bonds > o[weak] else [])
    np.testing.assert_allclose((1 - damage) * strain, force, rtol=0, atol=1e-6)


@pytest.mark.parametrize("fracture", [{"type": "strain", "failure": 0.1}, DAMAGE | {"onset": 0.1}])
def test_scattered_strengths_depend_on_the_seed(fracture):
    given = bar(30, pulled(0.05), fracture | {"scatter": 0.5})
    one, same, other = run(given), run(given), run(given | {"seed": 1})
    assert one.drop_attrs().identical(same.drop_attrs())
    assert (one.failure_strain != other.failure_strain).all()
    limits = one.failure_strain / fracture["failure"]
    assert (limits.min() < 0.6, limits.max() > 1.4) == (True, True)
    broken = one.broken_step.values > 0
    assert broken.any()
    assert (one.broken_strain.values[broken] > one.failure_strain.values[broken] * 0.999999).all()


SHEET = {
    "body": {"type": "grid", "columns": 9, "rows": 7},
    "frame": {"type": "mean"},
    "leaders": [LEFT, pull_right(0.3, 0.1) | {"until": 9}],
}
CUT = {"placement": 0.9, "cracks": [[[2.31, -1.7], [2.37, 1.2]]]}
STRAIN = {"type": "strain", "failure": 0.4371, **CUT}


@pytest.mark.parametrize(
    ("lattice", "precision"),
    [("square", "float64"), ("square", "float32"), ("hexagonal", "float64")],
)
def test_compiled_engine_breaks_by_strain_bit_for_bit(lattice, precision):
    """Single precision is compiled, with a leader group on rollers; for the others
    `stepping/numba_engine/test_engine` does."""
    solver = {"type": "stepping", "precision": precision}
    rollers = {"axes": ["x"]} if precision == "float32" else {}
    leaders = [LEFT | rollers, SHEET["leaders"][1]]
    parts = SHEET | {"lattice": {"type": lattice, "a": 1.0}, "leaders": leaders, "solver": solver}
    scene = build_scene(pbdkit.Experiment(**bar(9, pulled(0.1), STRAIN, **parts)))
    with interpreting() if precision == "float64" else nullcontext():
        states = [engine.advance(initial_state(scene), 30)
                  for engine in (Stepper(scene), CompiledStepper(scene))]  # fmt: skip
    for name in ("u", "previous", "broken_step", "broken_length"):
        np.testing.assert_array_equal(*(getattr(state, name) for state in states))
    assert (states[0].broken_step > 1).any()


def test_onset_above_failure_is_refused():
    with pytest.raises(pbdkit.ExperimentError, match=r"onset.*0\.5 is not below failure 0\.5"):
        pbdkit.Experiment(**bar(3, pulled(0.1), DAMAGE | {"onset": 0.5}))


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_crack_path_lists_broken_bonds_in_order(lattice, tmp_path):
    from pbdkit.io.netcdf import NetcdfSink
    from pbdkit.simulation import Simulation, record

    given = bar(9, pulled(0.1), STRAIN, lattice={"type": lattice, "a": 1.0}, **SHEET)
    record(
        Simulation.of_scene(build_scene(pbdkit.Experiment(**given))), NetcdfSink(tmp_path / "o.nc")
    )
    with pbdkit.open(tmp_path / "o.nc") as ds:
        rows, steps = ds.crack_bond.values - 1, ds.crack_step.values
        assert sorted(rows) == np.flatnonzero(ds.broken_step >= 0).tolist()
        assert (np.diff(steps) >= 0).all()
        assert steps[0] == 0 < steps[-1]
        np.testing.assert_array_equal(steps, ds.broken_step[rows])
        np.testing.assert_array_equal(ds.crack_strain, ds.broken_strain[rows])
        same = np.diff(steps) == 0
        assert (np.diff(ds.crack_strain)[same & (steps[1:] > 0)] <= 0).all()
        assert np.isnan(ds.crack_strain[steps == 0]).all()
        X = ds.reference.values
        middle = X[ds.bond_ends.values[rows] - 1].mean(axis=1)
        np.testing.assert_allclose(ds.crack_midpoint, middle, rtol=0, atol=1e-14)


def test_the_strain_at_break_is_that_of_the_intermediate_configuration():
    """Leaders of the step itself, all else of the step before."""
    given = bar(9, pulled(0.1), STRAIN, **SHEET)
    ds = run(given)
    broken = np.flatnonzero(ds.broken_step > 0)
    assert len(broken) > 5
    for row in broken:
        step, (a, b) = int(ds.broken_step[row]), ds.bond_ends.values[row] - 1
        m = np.where((ds.kind[step] == 0).values[:, None], ds.u[step], ds.u[step - 1])
        rest = ds.reference.values[b] - ds.reference.values[a]
        expected = np.hypot(*(rest + m[b] - m[a])) / np.hypot(*rest) - 1
        np.testing.assert_allclose(ds.broken_strain[row], expected, rtol=0, atol=1e-14)
