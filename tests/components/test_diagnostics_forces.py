"""Reactions, strain energy and tensile tests, against mechanics and finite elements."""

import itertools
import json
from pathlib import Path
from typing import Literal

import jsonschema
import numpy as np
import pytest
from finite_elements.errors import load

import pbdkit
from pbdkit.components.elasticity import rectangle_matrix
from pbdkit.plugin import Stiffness
from pbdkit.scene.scene import build_scene
from tests.components.test_elasticity import (
    AUXETIC,
    GRID,
    HEXAGONAL,
    MATERIALS,
    NATURAL,
    RECTANGULAR,
    SMALL_GRID,
    SPRINGS,
    SQUARE,
    STRESS,
    springs_of,
)

# Forces are those of given starts, and of any frame.
pytestmark = [
    pytest.mark.filterwarnings("ignore:leaders. the experiment has neither"),
    pytest.mark.filterwarnings("ignore:diagnostics.. .* includes forces of frame points"),
    pytest.mark.filterwarnings("ignore:frame. under 'none' edges"),
]

E, T = 7.0, 2.0
REACTION = {"type": "reaction", "youngs_modulus": E, "thickness": T}
ENERGY = {"type": "strain-energy", "youngs_modulus": E, "thickness": T}
HOLD = {"type": "hold"}
DISC = {"type": "disc", "radius": 1.5, "centre": [2.0, 2.0]}
GRADIENT = {"type": "strain-gradient", "length": 0.4, "poisson_ratio": 0.3}
LATTICES = {"square": SQUARE, "rectangular": RECTANGULAR, "hexagonal": HEXAGONAL}


def moved(by):
    return {"type": "displace", "displacement": list(by)}


def pulled(parts, by=(0.3, 0.2), **more):
    """The left edge held, the right edge moved, in equilibrium."""
    base = {
        "name": "pulled",
        "body": GRID,
        "frame": NATURAL,
        "leaders": [
            {"select": {"edge": "left"}, "motion": HOLD},
            {"select": {"edge": "right"}, "motion": moved(by)},
        ],
        "steps": 1,
        "solver": {"type": "equilibrium"},
        "diagnostics": [REACTION, ENERGY],
    }
    return base | parts | more


def ran(given):
    return pbdkit.run(given, progress=False)


LINEAR = {
    f"{lattice}, {name}, natural": LATTICES[lattice] | {"rule": rule, "frame": NATURAL}
    for lattice, (name, rule) in itertools.product(
        LATTICES, (MATERIALS | {"gradient": GRADIENT}).items()
    )
    if (lattice, name) not in (("hexagonal", "orthotropic"), ("rectangular", "gradient"))
}


@pytest.mark.parametrize("name", LINEAR)
def test_work_of_the_leaders_equals_the_strain_energy(name):
    """Clapeyron: ½ reaction · displacement."""
    by = (0.3, 0.2)
    ds = ran(pulled(LINEAR[name], by))
    work = 0.5 * float(ds.reaction.values[-1, 1] @ by)
    assert work > 0.1
    assert not ds.reaction[0].any()
    assert float(ds.strain_energy[0]) == 0.0
    assert float(ds.strain_energy[-1]) == pytest.approx(work, rel=1e-10)


@pytest.mark.parametrize("body", [GRID, DISC], ids=["grid", "disc"])
@pytest.mark.parametrize("lattice", LATTICES)
def test_reactions_of_all_leader_groups_sum_to_zero(lattice, body):
    """Test forces and torques of three bodies that share particles; no other particle is in
    equilibrium yet."""
    box = {"box": [1.0, 1.0, 2.5, 2.2]}
    leaders = [
        {"select": {"edge": "left"}, "motion": HOLD},
        {"select": {"edge": "bottom"}, "motion": HOLD},
        {"select": box, "motion": moved((0.2, -0.1))},
    ]
    given = pulled(LATTICES[lattice] | {"rule": STRESS}, body=body, leaders=leaders)
    reaction = ran(given).reaction
    assert reaction.dims == ("time", "leader_group", "axis")
    np.testing.assert_array_equal(reaction.leader_group, [0, 1, 2])
    assert np.abs(reaction[-1]).max() > 0.1
    np.testing.assert_allclose(reaction[-1].sum("leader_group"), 0.0, rtol=0, atol=1e-12)


def random_state(parts, seed=3):
    """An experiment that starts at random displacements, and what they are by body particle."""
    given = pulled(parts, solver={"type": "stepping"}, seed=seed)
    given["leaders"] = []
    given |= {"initial": {"type": "noise", "amplitude": 0.3}, "diagnostics": [ENERGY]}
    given["diagnostics"].append({"type": "displacement"})
    ds = ran(given)
    return build_scene(pbdkit.Experiment(**given)), ds.u.values[0], float(ds.strain_energy[0])


@pytest.mark.parametrize("body", [GRID, DISC], ids=["grid", "disc"])
@pytest.mark.parametrize("lattice", ["square", "rectangular"])
def test_energy_of_any_state_is_the_sum_over_its_cells(lattice, body):
    """Σ share ½ uᵀK u with the cells' own matrices, cut cells too."""
    parts = LATTICES[lattice] | {"rule": AUXETIC, "body": body}
    scene, u, energy = random_state(parts)
    stiffness, expected = scene.experiment.rule.elasticity(), 0.0
    lattice = scene.experiment.lattice
    K = rectangle_matrix(stiffness, lattice.a, getattr(lattice, "b", lattice.a))
    K = K.reshape(8, 8)
    for patch in scene.patches:
        share = scene.cells.of(patch)
        for place in np.flatnonzero(share):
            corners = u[patch.rows(scene.raster, place)].ravel()
            expected += share.flat[place] * 0.5 * corners @ K @ corners
    assert energy == pytest.approx(E * T * expected, rel=1e-12)


@pytest.mark.parametrize("lattice", SPRINGS)
def test_energy_of_springs_matches_its_definition(lattice):
    _, u, energy = random_state(
        SPRINGS[lattice] | {"rule": {"type": "springs"}, "body": SMALL_GRID}
    )
    parts = pulled(SPRINGS[lattice] | {"rule": {"type": "springs"}}, body=SMALL_GRID)
    i, j, k, rest = springs_of(lattice)
    x = build_scene(pbdkit.Experiment(**parts)).raster.reference() + u
    expected = (0.5 * k * (np.linalg.norm(x[i] - x[j], axis=1) - rest) ** 2).sum()
    assert energy == pytest.approx(E * T * expected, rel=1e-12)


@pytest.mark.parametrize("lattice", SPRINGS)
def test_reaction_of_springs_is_the_derivative_of_their_energy(lattice):
    """Test by central differences, far from rest: a stretch of a third and a turn."""
    given = SPRINGS[lattice] | {"rule": {"type": "springs"}}

    def energy(x):
        return float(ran(pulled(given, (x, 0.4))).strain_energy[-1])

    ds = ran(pulled(given, (1.2, 0.4)))
    slope = (energy(1.2 + 1e-4) - energy(1.2 - 1e-4)) / 2e-4
    assert float(ds.reaction[-1, 1, 0]) == pytest.approx(slope, rel=1e-6)
    np.testing.assert_allclose(ds.reaction[-1].sum("leader_group"), 0.0, rtol=0, atol=1e-6)


def problem(name, n):
    """A problem of the finite-element references on a square lattice, and its reference."""
    reference = load(name, n)
    p = reference.problem
    body = {"type": "rectangle", "width": p.length, "height": p.height}
    if p.radius:
        hole = {"type": "disc", "radius": p.radius, "centre": [p.length / 2, p.height / 2]}
        body = {"type": "difference", "of": [body, hole]}
    ends = [{"box": [x - 1e-6, -1.0, x + 1e-6, 9.0]} for x in (0.0, p.length)]
    motions = [HOLD, moved(np.eye(2)[p.pulled].tolist())]
    leaders = [{"select": s, "motion": m} for s, m in zip(ends, motions, strict=True)]
    given = SQUARE | {"lattice": {"type": "square", "a": 1 / n}, "rule": STRESS, "body": body}
    asked = [each | {"youngs_modulus": 1.0, "thickness": 1.0} for each in (REACTION, ENERGY)]
    return pulled(given, leaders=leaders, diagnostics=asked), reference


@pytest.mark.parametrize(
    ("name", "n", "within"),
    [
        ("bar", 10, 1.4e-3),
        ("bar", 20, 5.3e-4),
        ("cantilever", 10, 1.6e-2),
        ("cantilever", 20, 4.5e-3),
        ("hole", 10, 1.1e-2),
        ("hole", 20, 9e-4),
    ],
)
def test_reaction_and_energy_match_finite_elements(name, n, within):
    given, reference = problem(name, n)
    ds = ran(given)
    reaction = float(ds.reaction[-1, 1, reference.problem.pulled])
    assert reaction == pytest.approx(reference.reaction, rel=within)
    assert reaction > reference.reaction  # a displacement method is too stiff
    assert float(ds.strain_energy[-1]) == pytest.approx(reference.energy, rel=within)


def test_energy_is_independent_of_rigid_translation():
    given = pulled(SQUARE | {"rule": STRESS})
    far = json.loads(json.dumps(given))
    far["leaders"][0]["motion"], far["leaders"][1]["motion"] = (
        moved((1e4, 0)),
        moved((1.00003e4, 0.2)),
    )
    energies = [float(ran(each).strain_energy[-1]) for each in (given, far)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-9)


def test_group_without_leading_exerts_no_force():
    given = pulled(SQUARE | {"rule": STRESS}, steps=4, solver={"type": "stepping"})
    given["leaders"][1]["until"] = 2
    reaction = ran(given).reaction[:, 1, 0].values
    assert (reaction[1:3] > 0.1).all()
    assert (reaction[3:] == 0).all()


def test_forces_of_broken_bonds_match_the_rule():
    """The right half, cracked off and moved away, is at rest."""
    crack = {"type": "threshold", "thresholds": [9.0], "cracks": [[[1.8, -9.0], [1.8, 9.0]]]}
    solver = {"type": "stepping", "memory": 0.8}
    more = {"solver": solver, "steps": 600, "record": {"every": 600}}
    for fracture, torn in (({"type": "none"}, False), (crack, True)):
        ds = ran(pulled(SQUARE | {"rule": STRESS}, fracture=fracture) | more)
        assert (abs(float(ds.strain_energy[-1])) < 1e-12) == torn
        assert (np.abs(ds.reaction[-1]).max() < 1e-10) == torn


def test_the_dataset_is_described_and_stored(tmp_path):
    given = pulled(SQUARE | {"rule": STRESS})
    curve = {"type": "stress-strain", "youngs_modulus": E, "width": 2.5}
    more = [{"type": "strain"}, {"type": "rotation"}, {"type": "stress", "youngs_modulus": E}]
    (tmp_path / "e.json").write_text(
        json.dumps(given | {"diagnostics": [REACTION, ENERGY, curve, *more]})
    )
    ds = ran(json.loads((tmp_path / "e.json").read_text()))
    schema = json.loads((Path(__file__).parents[2] / "schemas/dataset.schema.json").read_text())
    made = ds.to_dict(data=False)
    jsonschema.validate(json.loads(json.dumps(made, default=lambda a: a.tolist())), schema)
    assert ds.reaction.attrs["units"].startswith("stress unit * thickness unit * ")


def test_reactions_without_leaders_are_refused():
    with pytest.raises(pbdkit.ExperimentError) as caught:
        ran(pulled(SQUARE | {"rule": STRESS}, leaders=[], solver={"type": "stepping"}))
    expected = "diagnostics.0: 'reaction' requires leader groups; the experiment has none"
    assert str(caught.value) == expected


class Loose(pbdkit.plugin.Calibrated, pbdkit.FollowerRule):
    """A calibrated rule without weights, for neighbours that come and go."""

    type: Literal["loose"] = "loose"

    def elasticity(self):
        return Stiffness(1.0, 1.0, 0.0, 0.5)

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]

    @staticmethod
    def force(total, here, p):
        return total[0]


def test_forces_with_changing_neighbours_are_refused():
    near = {"type": "euclidean", "radius": 0.6, "reevaluate": True}
    parts = SQUARE | {"rule": {"type": "loose"}, "neighbours": near, "frame": {"type": "none"}}
    given = pulled(parts, solver={"type": "stepping"})
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.run(given, components=[Loose], progress=False)
    assert str(caught.value) == (
        "diagnostics.0: 'reaction' requires fixed neighbours; set neighbours.reevaluate: false"
    )


class Forceless(pbdkit.plugin.Calibrated, pbdkit.FollowerRule):
    """A calibrated rule that does not define its forces."""

    type: Literal["forceless"] = "forceless"
    elasticity, gather, apply = Loose.elasticity, Loose.gather, Loose.apply


def test_a_calibrated_rule_without_forces_is_named():
    parts = SQUARE | {"rule": {"type": "forceless"}, "frame": {"type": "none"}}
    with pytest.raises(pbdkit.ExperimentError, match="components: Forceless does not define force"):
        pbdkit.run(pulled(parts), components=[Forceless], progress=False)


@pytest.mark.parametrize(("name", "off"), [("bar", 0.194), ("cantilever", 7.0)])
def test_frame_points_at_held_corners_give_a_warning(name, off):
    given, reference = problem(name, 10)
    columns = round(reference.problem.length * 10) + 1
    body = {"type": "grid", "columns": columns, "rows": 11}
    given |= {"frame": {"type": "mean"}, "body": body}
    for leader, edge in zip(given["leaders"], ("left", "right"), strict=True):
        leader["select"] = {"edge": edge}
    reaction = float(ran(given).reaction[-1, 1, reference.problem.pulled])
    assert reaction / reference.reaction - 1 == pytest.approx(off, abs=0.005)
    warnings = build_scene(pbdkit.Experiment(**given)).warnings
    of_frames, *of_diagnostics = warnings
    assert of_frames.startswith("frame: under 'mean' edges are not free of stress")
    assert [w[:25] for w in of_diagnostics] == [
        "diagnostics.0: 'reaction'",
        "diagnostics.1: 'strain-en",
    ]
    assert "forces of frame points on leaders, which at the corners of" in of_diagnostics[0]
    assert build_scene(pbdkit.Experiment(**given | {"diagnostics": []})).warnings == (of_frames,)
