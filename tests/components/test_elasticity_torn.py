"""Bodies with broken and softened bonds under calibrated rules obey mechanics."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scene_strategies import samples

import pbdkit
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.rule_evaluation import Surroundings, blocks
from pbdkit.stepping.state import initial_state

SQUARES = {"type": "chebyshev", "shells": 1}
TRIANGLES = {"type": "coordination", "shells": 1}
SOFTENING = {"type": "damage", "onset": 0.1, "failure": 0.5}
REGIONS = {"part": {"type": "disc", "radius": 1.7, "centre": [1.3, 2.1]}}
LATTICES = [
    {"type": "square", "a": 1.0},
    {"type": "rectangular", "a": 1.0, "b": 0.55},
    {"type": "hexagonal", "a": 1.0},
]


def elastic(nu, **more):
    return {"type": "elastic", "poisson_ratio": nu} | more


RULES = [elastic(nu) for nu in (-0.7, 0.0, 0.2, 1 / 3, 0.45)]
RULES += [
    elastic(0.3, plane="strain"),
    elastic(0.2, stiffness={"otherwise": 1.0, "part": 20.0}),
    elastic({"otherwise": 0.4, "part": 0.0}, stiffness=3.0),
]
ORTHOTROPIC = {
    "type": "orthotropic",
    "poisson_ratio": 0.3,
    "modulus_ratio": 0.2,
    "shear_ratio": 0.1,
}


@st.composite
def torn_bodies(draw):
    """A scene of cut cells with the state of bonds broken and softened at random."""
    lattice = draw(st.sampled_from(LATTICES))
    triangles = lattice["type"] == "hexagonal"
    rule = draw(st.sampled_from(RULES if triangles else [*RULES, ORTHOTROPIC]))
    scene = torn_scene(lattice, rule, draw(st.sampled_from(["natural", "natural", "none"])))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return scene, torn_state(scene, generator), generator


def torn_scene(lattice, rule, frame):
    triangles = lattice["type"] == "hexagonal"
    experiment = pbdkit.Experiment(
        name="torn",
        lattice=lattice,
        body={"type": "rectangle", "width": 4.3, "height": 3.2, "origin": [0.1, 0.2]},
        neighbours=TRIANGLES if triangles else SQUARES,
        rule=rule,
        regions=REGIONS,
        frame={"type": frame},
        fracture=SOFTENING,
        steps=1,
    )
    return build_scene(experiment)


def torn_state(scene, generator, broken=0.25, softened=0.25):
    state = initial_state(scene)
    state.broken_step[generator.random(state.broken_step.shape) < broken] = 0
    some = generator.random(state.broken_step.shape) < softened
    if state.bond_values:
        state.bond_values[0][some] = generator.random(np.count_nonzero(some))
    return state


def forces(scene, state, u):
    """(particle, axis) at displacements (particle, axis) of the body."""
    place = scene.raster.place_of(scene.raster.body_rows)
    planes = np.zeros_like(state.u)
    planes.reshape(2, -1)[:, place] = u.T
    found = SlotFollowers(scene).forces(planes, state)
    return found.reshape(2, -1)[:, place].T


def stiffness(scene, state):
    count = len(scene.raster.body_rows)
    columns = []
    for n in range(2 * count):
        u = np.zeros((count, 2))
        u.flat[n] = 1.0
        columns.append(-forces(scene, state, u).ravel())
    return np.array(columns).T


@samples(12)
@given(torn_bodies())
def test_forces_derive_from_a_stiffness_without_rigid_motions(torn):
    scene, state, generator = torn
    K, X = stiffness(scene, state), scene.raster.reference(scene.raster.body_rows)
    size = np.abs(K).max()
    np.testing.assert_allclose(K, K.T, rtol=0.0, atol=1e-13 * size)
    assert np.linalg.eigvalsh((K + K.T) / 2)[0] > -1e-13 * size
    turned, shifted = np.stack([-X[:, 1], X[:, 0]], axis=1), np.ones_like(X)
    for motion in (turned, shifted):
        assert np.abs(forces(scene, state, motion)).max() < 1e-13 * size * np.abs(motion).max()
    intact = np.argwhere(state.broken_step < 0)
    state.broken_step[tuple(intact[generator.integers(len(intact))])] = 0
    softer = stiffness(scene, state)
    assert np.linalg.eigvalsh((K - softer + (K - softer).T) / 2)[0] > -1e-13 * size


CRACKED = {
    "name": "cracked",
    "lattice": {"type": "square", "a": 1.0},
    "neighbours": SQUARES,
    "frame": {"type": "natural"},
    "fracture": {"type": "none"},
    "solver": {"type": "equilibrium"},
    "steps": 1,
}


def test_damage_is_computed_once_for_each_bond_and_only_in_damaged_bodies(monkeypatch):
    torn = {"type": "strain", "failure": 0.1}
    parts = {"body": {"type": "grid", "columns": 5, "rows": 4}, "rule": RULES[1], "fracture": torn}
    scene = build_scene(pbdkit.Experiment(**CRACKED | parts))
    state, computed, damage_of = initial_state(scene), [], Surroundings._damage

    def damage(self, bond, owner, state):
        computed.append((bond.plane, bond.owner))
        return damage_of(self, bond, owner, state)

    monkeypatch.setattr(Surroundings, "_damage", damage)
    (surroundings,) = blocks(scene)
    assert all(to.torn is None for to in surroundings.neighbours(state))
    assert computed == []
    state.broken_step[0] = np.where(state.broken_step[0] < 0, 0, state.broken_step[0])
    assert all(to.torn for to in surroundings.neighbours(state))
    assert len(computed) == len(set(computed)) > 4


@pytest.mark.parametrize("rule", [*RULES[1:5], ORTHOTROPIC], ids=lambda rule: str(rule)[:45])
@pytest.mark.parametrize("through", [True, False])
def test_stress_parallel_to_a_cut_is_undisturbed(rule, through):
    """Exactly beside a cut through the body; the two cells at the tips of a shorter one, of which
    one edge across the cut is whole, disturb it by less than their size times the strain."""
    ends, largest = ((-1.0, 11.0), 1e-11) if through else ((2.4, 7.6), 0.7)
    corners = [[0, 0], [0, 7]] if through else [[0, 0]]
    strain = 1e-6
    moved = {"type": "displace", "displacement": [10 * strain, 0.0]}
    held = {"type": "hold"}
    ds = pbdkit.run(
        CRACKED
        | {
            "body": {"type": "grid", "columns": 11, "rows": 8},
            "rule": rule,
            "cuts": [{"from": [ends[0], 3.5], "to": [ends[1], 3.5]}],
            "leaders": [
                {"select": {"edge": "left"}, "motion": held, "axes": ["x"]},
                {"select": {"nearest": corners}, "motion": held, "axes": ["y"]},
                {"select": {"edge": "right"}, "motion": moved, "axes": ["x"]},
            ],
            "diagnostics": [{"type": "displacement"}],
        },
        progress=False,
    )
    disturbance = ds.u.values[-1, :, 0] / strain - ds.reference.values[:, 0]
    assert np.abs(disturbance).max() < largest


@pytest.mark.parametrize("rule", [*RULES[:5], ORTHOTROPIC], ids=lambda rule: str(rule)[:45])
def test_notched_plate_rotates_rigidly(rule):
    """So little that the strain which a linear rule sees in a rotation is below rounding."""
    angle = 1e-7
    turn = {"type": "rotation", "centre": [10.0, 5.0], "angle": np.degrees(angle), "steps": 1}
    ds = pbdkit.run(
        CRACKED
        | {
            "body": {"type": "grid", "columns": 21, "rows": 11},
            "rule": rule,
            "cuts": [{"from": [9.5, -1.0], "to": [9.5, 5.2]}],
            "leaders": [{"select": {"edge": edge}, "motion": turn} for edge in ("left", "right")],
            "diagnostics": [
                {"type": "displacement"},
                {"type": "strain-energy", "youngs_modulus": 1.0},
            ],
        },
        progress=False,
    )
    x, y = (ds.reference.values - [10.0, 5.0]).T
    turned = angle * np.stack([-y, x], axis=1)
    np.testing.assert_allclose(ds.u.values[-1], turned, rtol=0.0, atol=1e-5 * angle)
    assert abs(ds.strain_energy.values[-1]) < 1e-12 * angle**2 * 200


MOMENTS = {0.0: 19.3682, 0.2: 19.3992, 1 / 3: 19.4726, 0.45: 19.5685}
"""A plate 41 × 20 with a crack to half its height, 9.5 + .5 of a cell, is bent between ends that
turn by a radian and do not contract. The reference are quadratic elements with a true crack, graded
at its tip."""


@pytest.mark.parametrize("nu", MOMENTS)
def test_moment_of_a_cracked_plate_matches_fine_elements(nu):
    def bent(edge, centre, angle):
        motion = {"type": "rotation", "centre": [centre, 10.0], "angle": angle, "steps": 1}
        return {"select": {"edge": edge}, "motion": motion}

    ds = pbdkit.run(
        CRACKED
        | {
            "body": {"type": "grid", "columns": 42, "rows": 21},
            "rule": elastic(nu),
            "cuts": [{"from": [20.5, -1.0], "to": [20.5, 9.9]}],
            "leaders": [bent("left", 0.0, -1e-4), bent("right", 41.0, 1e-4)],
            "diagnostics": [{"type": "strain-energy", "youngs_modulus": 1.0}],
        },
        progress=False,
    )
    moment = ds.strain_energy.values[-1] / np.radians(1e-4) ** 2
    assert moment == pytest.approx(MOMENTS[nu], rel=0.015)


@pytest.mark.parametrize(
    "fracture",
    [
        {"type": "threshold", "thresholds": [1.6], "placement": 1.2},
        {"type": "strain", "failure": 0.1, "fictitious": "reference"},
    ],
)
@pytest.mark.parametrize("rule", [elastic(0.3), {"type": "springs"}], ids=["elastic", "springs"])
def test_fictitious_points_that_exert_forces_are_refused(rule, fracture):
    experiment = pbdkit.Experiment(
        **CRACKED
        | {
            "body": {"type": "grid", "columns": 4, "rows": 4},
            "rule": rule,
            "fracture": fracture,
            "solver": {"type": "stepping"},
        }
    )
    with pytest.raises(pbdkit.ExperimentError, match=r"would not balance; use placement: 1"):
        build_scene(experiment)


def test_energy_of_softened_springs_is_the_work_of_stretching():
    """Every bond has lost half of its pull, in a strip pulled within what is elastic."""
    experiment = pbdkit.Experiment(
        **CRACKED
        | {
            "body": {"type": "grid", "columns": 5, "rows": 4},
            "rule": {"type": "springs"},
            "fracture": SOFTENING,
            "solver": {"type": "stepping"},
        }
    )
    scene = build_scene(experiment)
    state = initial_state(scene)
    state.bond_values[0][...] = 0.5
    X = scene.raster.reference(scene.raster.body_rows)
    u = 1e-6 * np.stack([X[:, 0] + 0.3 * X[:, 1], -0.2 * X[:, 1]], axis=1)
    place = scene.raster.place_of(scene.raster.body_rows)
    state.u.reshape(2, -1)[:, place] = u.T
    work = -0.5 * (u * forces(scene, state, u)).sum()
    energy = SlotFollowers(scene).energy(state.u, state)
    assert energy == pytest.approx(work, rel=1e-5)
    state.bond_values[0][...] = 0.0
    assert energy == pytest.approx(SlotFollowers(scene).energy(state.u, state) / 2, rel=1e-12)


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda lattice: lattice["type"])
@pytest.mark.parametrize("rule", [elastic(0.0), elastic(0.3), {"type": "springs"}], ids=str)
def test_stress_of_softened_cells_is_the_transmitted_stress(lattice, rule):
    """If all bonds have lost half of their force, the stress is halved."""
    if rule["type"] == "springs" and lattice["type"] == "rectangular":
        rule = ORTHOTROPIC
    experiment = pbdkit.Experiment(
        **CRACKED
        | {
            "lattice": lattice,
            "neighbours": TRIANGLES if lattice["type"] == "hexagonal" else SQUARES,
            "body": {"type": "disc", "radius": 2.8, "centre": [3.0, 3.0]},  # with cut cells
            "rule": rule,
            "fracture": SOFTENING,
            "initial": {"type": "affine", "gradient": [[1e-6, 3e-7], [2e-7, -4e-7]]},
            "solver": {"type": "stepping"},
            "diagnostics": [{"type": "stress", "youngs_modulus": 1.0}],
        }
    )
    scene = build_scene(experiment)
    state, tables = initial_state(scene), Tables(scene)
    (diagnostic,) = experiment.diagnostics
    whole = diagnostic.measure(StateMoment(state, tables))[:3]
    state.bond_values[0][...] = 0.5
    softened = diagnostic.measure(StateMoment(state, tables))[:3]
    assert (scene.cells.share[scene.cells.share > 0.0] < 1.0).any()
    for half, full in zip(softened, whole, strict=True):
        np.testing.assert_allclose(half, full / 2, rtol=1e-5, atol=1e-12)
