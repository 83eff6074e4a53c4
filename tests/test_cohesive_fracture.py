"""Fracture with energy: what a unit of crack takes, on which lattices, and what is refused."""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.interfaces import length
from pbdkit.scene.scene import build_scene
from pbdkit.scene.setting import setting_of

sys.path.append(str(Path(__file__).parent / "reliability"))

ENERGY, ONSET = 6e-5, 0.01
COHESIVE = {"type": "cohesive", "energy": ENERGY, "onset": ONSET}
HOLD = {"select": {"edge": "bottom"}, "motion": {"type": "hold"}}
SQUARE = {"neighbours": {"type": "chebyshev"}}
SPRINGS, ELASTIC = {"type": "springs"}, {"type": "elastic", "poisson_ratio": 0.3}


def body(a, rule=SPRINGS, lattice="square", **parts):
    return {
        "name": "torn",
        "lattice": {"type": lattice, "a": a},
        "body": {"type": "grid", "columns": 7, "rows": 2},
        "neighbours": {"type": "chebyshev" if lattice == "square" else "coordination"},
        "rule": rule,
        "frame": {"type": "natural"},
        "fracture": COHESIVE,
        "steps": 1,
    } | parts


def taken_up(scene, normal):
    """What the bonds across a unit of crack with a normal take up: of each ½ k l² onset failure."""
    slots, (a, b) = scene.neighbourhood.slots[0], scene.neighbourhood.cell.vectors
    sites = len(scene.neighbourhood.cell.sites)
    evaluator, total = scene.experiment.rule, 0.0
    for slot in slots:
        w, p, r = scene.constants.weights[slot], scene.constants.rule, slot.rest
        force = evaluator.force(evaluator.gather(r, r, w, p), None, p)
        squared = force.x * r.x + force.y * r.y  # k l², d being r
        c = scene.constants.limits[slot]
        crossing = abs(r.x * normal[0] + r.y * normal[1]) * sites / abs(a.x * b.y - a.y * b.x)
        total += crossing * squared * c.onset_strain * c.failure_strain / 2 / 2
    return total


def along(degrees):
    return np.cos(np.radians(degrees)), np.sin(np.radians(degrees))


@pytest.mark.parametrize("rule", [SPRINGS, ELASTIC], ids=["springs", "elastic"])
@pytest.mark.parametrize("a", [0.05, 0.1, 0.2, 0.4])
def test_a_unit_of_crack_takes_the_energy_on_any_spacing(rule, a):
    scene = build_scene(pbdkit.Experiment(**body(a, rule)))
    for degrees in (0, 45, 90, 135):
        assert taken_up(scene, along(degrees)) == pytest.approx(ENERGY, rel=1e-5)
    between = [taken_up(scene, along(degrees)) / ENERGY for degrees in range(46)]
    assert min(between) > 1 - 1e-5
    assert max(between) == pytest.approx(1.0824, abs=1e-4)


def test_on_the_hexagonal_lattice_no_crack_takes_less_than_one_along_a_row():
    scene = build_scene(pbdkit.Experiment(**body(0.1, lattice="hexagonal")))
    found = [taken_up(scene, along(degrees)) / ENERGY for degrees in range(181)]
    assert min(found) == pytest.approx(1.0, rel=1e-5) == found[90]
    assert max(found) == pytest.approx(2 / np.sqrt(3), rel=1e-3)


@pytest.mark.parametrize("a", [0.1, 0.4])
def test_the_work_of_tearing_two_rows_apart_is_the_energy_of_the_crack(a):
    """All particles lead, so that nothing but the crack takes up work."""
    fracture = {"type": "cohesive", "energy": 8e-7, "onset": 1e-3}
    scene = build_scene(pbdkit.Experiment(**body(a, fracture=fracture)))
    failure = max(c.failure_strain for c in scene.constants.limits.values())
    steps, way = 400, 2.2 * failure * a
    motion = {"type": "velocity", "velocity": [0.0, way / steps], "steps": steps}
    parts = {
        "fracture": fracture,
        "leaders": [HOLD, {"select": {"edge": "top"}, "motion": motion}],
        "steps": steps,
        "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0, "thickness": 1.0}],
    }
    ds = pbdkit.run(body(a, **parts), progress=False)
    assert (ds.broken_step.values > 0).sum() == 7 + 2 * 6
    force = ds.reaction.sel(leader_group=1, axis="y").values
    work = sum((f + g) / 2 * way / steps for f, g in pairwise(force))
    assert work == pytest.approx(8e-7 * 6 * a, rel=0.01)


def test_bonds_soften_as_under_damage():
    """One spacing, upright bonds alone: the strains are those that the energy stands for."""
    scene = build_scene(pbdkit.Experiment(**body(0.1)))
    lengths = {round(float(length(s.rest)), 3): c for s, c in scene.constants.limits.items()}
    upright, diagonal = lengths[0.1], lengths[0.141]
    assert upright.onset_strain == diagonal.onset_strain == ONSET
    c = ENERGY * 0.1 / (1 + np.sqrt(2))  # of a bond one spacing long
    assert upright.failure_strain == pytest.approx(2 * c / (0.75 * 0.01 * ONSET))
    assert diagonal.failure_strain == pytest.approx(upright.failure_strain / np.sqrt(2))


def test_kernels_soften_as_numpy_does():
    pytest.importorskip("numba")
    motion = {"type": "velocity", "velocity": [0.0, 2e-4], "steps": 100}
    parts = {
        "body": {"type": "grid", "columns": 7, "rows": 5},
        "cuts": [{"from": [-1.0, 0.15], "to": [0.22, 0.15], "at": 30}],
        "leaders": [HOLD, {"select": {"edge": "top"}, "motion": motion}],
        "steps": 120,
        "diagnostics": [{"type": "displacement"}],
    }
    found, known = (
        pbdkit.run(
            body(0.1, **parts, solver={"type": "stepping", "engine": engine}), progress=False
        )
        for engine in ("compiled", "numpy")
    )
    assert (known.broken_step.values > 30).any()
    for name in ("u", "damage", "broken_step"):
        assert np.array_equal(found[name].values, known[name].values)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (body(0.7), ["6e-05 is too little for this spacing", "make the spacing smaller than"]),
        (body(0.1, {"type": "barycentre"}) | {"frame": {"type": "mean"}},
         ["'cohesive' needs a rule that is calibrated to a material", "which 'barycentre'"]),
    ],
    ids=["spacing", "barycentre"],
)  # fmt: skip
def test_what_does_not_go_with_it_is_told(parts, words):
    with pytest.raises(pbdkit.ExperimentError) as error:
        build_scene(pbdkit.Experiment(**parts))
    for word in words:
        assert word in str(error.value)


def test_bonds_that_do_not_pull_along_themselves_are_refused():
    scene = build_scene(pbdkit.Experiment(**body(0.1)))
    setting, slots = setting_of(scene.raster, scene.neighbourhood), scene.neighbourhood.every
    with pytest.raises(pbdkit.ExperimentError, match="'cohesive' works on bonds that pull along"):
        scene.experiment.fracture.of_material(slots[0], dict.fromkeys(slots, 0.0), setting)


def test_the_remedies_for_a_large_spacing_are_true():
    with pytest.raises(pbdkit.ExperimentError) as error:
        build_scene(pbdkit.Experiment(**body(0.7)))
    words = str(error.value).split()
    share, onset = float(words[words.index("than") + 1]), float(words[words.index("below") + 1][:6])
    for size, more in ((0.7 * share * 0.99, {}), (0.7, {"onset": onset * 0.99})):
        build_scene(pbdkit.Experiment(**body(size, fracture=COHESIVE | more)))


def test_a_beam_tears_as_griffith_says():
    """A sample of `fracture_energy.py`; the whole is in docs/fracture.md."""
    import fracture_energy

    share = fracture_energy.beam(15, far=1.3, count=16)
    assert share.mean() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("last", [0, 5])
def test_a_condensed_body_carries_what_a_whole_one_does(last):
    """A cracked beam of `fracture_energy.py`, of which the bonds across the columns up to `last`
    are torn, and the same by pbdkit: both linear, so that they differ by rounding alone."""
    import fracture_energy

    h, columns, rows, lead, opening = 0.25, 13, 4, 2, 1e-3
    half, middle = fracture_energy.Half.of(h, columns, rows, [lead]), (rows - 0.5) * h
    force, _ = half.force(half.torn(0, last), opening)
    leaders = [
        {
            "select": {"nearest": [[0.0, middle + side * (lead + 0.5) * h]]},
            "motion": {"type": "displace", "displacement": [0.0, side * opening / 2]},
        }
        for side in (-1, 1)
    ]
    whole = body(h, {"type": "elastic", "poisson_ratio": 1 / 3}) | {
        "body": {"type": "grid", "columns": columns, "rows": 2 * rows},
        "fracture": {"type": "none"},
        "cuts": [{"from": [-1.0, middle], "to": [(last + 0.25) * h, middle]}],
        "leaders": leaders,
        "solver": {"type": "equilibrium", "tolerance": 1e-10},
        "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0}],
    }
    carried = pbdkit.run(whole, progress=False).reaction.sel(axis="y").values[-1]
    np.testing.assert_allclose(carried, [-force, force], rtol=1e-8)
