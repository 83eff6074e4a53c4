"""Fracture with energy: the law of a cell, and what is refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.components.fracture import LAWS, SofteningLaw
from pbdkit.plugin.lattice import signed_area
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.state import initial_state

sys.path.append(str(Path(__file__).parents[1] / "reliability"))

ENERGY, ONSET = 6e-4, 0.01
COHESIVE = {"type": "cohesive", "energy": ENERGY, "onset": ONSET}
HOLD = {"select": {"edge": "bottom"}, "motion": {"type": "hold"}}
SPRINGS, ELASTIC = {"type": "springs"}, {"type": "elastic", "poisson_ratio": 0.3}
ORTHOTROPIC = {"type": "orthotropic", "poisson_ratio": 0.0, "modulus_ratio": 0.4}
ORTHOTROPIC |= {"shear_ratio": 0.3}
NUMBERS = tuple(
    f"{name}_{side}" for name in ("damage", "normal_x", "normal_y") for side in ("left", "right")
)


def body(a, rule=SPRINGS, lattice="square", **parts):
    sides = {"a": a, "b": 0.6 * a} if lattice == "rectangular" else {"a": a}
    triangles = lattice == "hexagonal"
    return {
        "name": "torn",
        "lattice": {"type": lattice} | sides,
        "body": {"type": "grid", "columns": 7, "rows": 2},
        "neighbours": {"type": "coordination" if triangles else "chebyshev"},
        "rule": rule,
        "frame": {"type": "natural"},
        "fracture": COHESIVE,
        "steps": 1,
    } | parts


class Strained:
    """A body with the displacements of a gradient, from moment to moment."""

    def __init__(self, **parts):
        self.scene = build_scene(pbdkit.Experiment(**body(1.0, **parts)))
        self.state = initial_state(self.scene)
        raster = self.scene.raster
        self.X = raster.reference(raster.body_rows)
        self.X -= self.X.mean(axis=0)
        self._place = raster.place_of(raster.body_rows)
        self._fracturing = Fracturing.of(self.scene)
        self._followers = SlotFollowers(self.scene)
        self.area = self.scene.cells.share.sum() * abs(
            float(signed_area(self.scene.neighbourhood.tiling.polygons[0].rest))
        )

    def forces(self, u):
        """On the particles, (particle, axis)."""
        self.state.u.reshape(2, -1)[:, self._place] = np.asarray(u).T
        return self._followers.forces(self.state.u, self.state).reshape(2, -1)[:, self._place].T

    def put(self, u, *, in_turn=False):
        """Displacements by which the bonds are judged."""
        self.state.u.reshape(2, -1)[:, self._place] = np.asarray(u).T
        return self._fracturing.break_bonds(self.state.u, self.state, 1, in_turn=in_turn)

    def stress(self, gradient):
        """The mean stress over Young's modulus under a gradient, by which the bonds are judged."""
        u = self.X @ np.asarray(gradient).T
        self.put(u)
        return -self.forces(u).T @ self.X / self.area

    @property
    def broken(self):
        """Return the number of broken bonds."""
        return int((self.state.broken_step >= 0).sum())


def along(degrees):
    return np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


def strain_of_uniaxial(rule, normal):
    """The strain under a uniaxial stress of Young's modulus along x."""
    (xx, yy, xy, shear, *_), nu = rule.elasticity(), rule.through_thickness()
    C = np.array([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, shear]])
    modulus = (xx - xy**2 / yy) * (1 - nu**2)
    x, y, shear = np.linalg.solve(
        C, modulus * np.array([n := normal[0] ** 2, 1 - n, np.prod(normal)])
    )
    return np.array([[x, shear / 2], [shear / 2, y]]), modulus


LATTICES = {
    "square": (0, 90),
    "rectangular": (0, 90),
    "hexagonal": (30, 90),
}
"""Directions of the strain in degrees, for which the bonds that cross the crack are equally long
across it. For other directions, `cohesive_strength.py` measures bars."""
RULES = {
    "springs": SPRINGS,
    "elastic": ELASTIC,
    "plane strain": ELASTIC | {"plane": "strain"},
    "stiffer": ELASTIC | {"stiffness": 3.0},
    "orthotropic": ORTHOTROPIC,
}
CELLS = [
    (lattice, rule)
    for lattice in LATTICES
    for rule in RULES
    if (lattice, rule) not in {("rectangular", "springs"), ("hexagonal", "orthotropic")}
]


@pytest.mark.parametrize(("lattice", "rule"), in_turn(CELLS, 4))
def test_cell_has_onset_strength_and_fracture_energy(lattice, rule):
    """Strained across the crack alone, as a band between cells that stay elastic: the stress peaks
    at onset times the modulus along its normal, and its work on the band is energy · E."""
    onset, energy = 1e-3, 6e-6
    fracture = {"type": "cohesive", "energy": energy, "onset": onset}
    for degrees in (0, 90) if rule == "orthotropic" else LATTICES[lattice]:
        given = Strained(rule=RULES[rule], lattice=lattice, fracture=fracture)
        normal = along(degrees)
        uniaxial, modulus = strain_of_uniaxial(given.scene.experiment.rule, normal)
        polygon = given.scene.neighbourhood.tiling.polygons[0]
        width = np.ptp(np.array(polygon.rest) @ normal)
        along_normal = 1.0 if rule == "plane strain" else float(normal @ uniaxial @ normal)
        strength, strain = onset * modulus / along_normal, np.outer(normal, normal)
        ways = np.linspace(0.0, 2.1 * energy / (strength * width), 80)
        pulls = [float(normal @ given.stress(way * strain) @ normal) for way in ways]
        assert max(pulls) == pytest.approx(strength, rel=0.02)
        assert np.trapezoid(pulls, ways) * width == pytest.approx(energy, rel=0.02)
        assert abs(pulls[-1]) < 1e-3 * onset
        assert given.broken > 0


TABLE = [[0.0, 3.9], [0.01, 3.9], [0.02, 1.0], [0.05, 0.0]]
"""Points of a law with a plateau, which is not convex, in MPa and mm."""


@pytest.mark.parametrize("law", [*LAWS, TABLE], ids=[*LAWS, "table"])
def test_cell_follows_its_softening_law(law):
    """The traction at the opening w, the cracking strain times the width of the band, is that of
    the law; the damage increases to 1, and the work is the energy."""
    onset, energy = 1e-3, 6e-5
    fracture = {"type": "cohesive", "energy": energy, "onset": onset, "law": law}
    softening = LAWS[law] if isinstance(law, str) else SofteningLaw.of(law)
    x, s = softening.opening, softening.stress
    given = Strained(rule=ELASTIC | {"poisson_ratio": 0.0}, fracture=fracture)
    openings = np.linspace(0.0, x[-1] * 1.01, 60)
    expected = np.interp(openings, x, s)
    strains = onset * expected + openings * energy / onset
    tractions, damages = [], []
    for strain in strains:
        tractions.append(given.stress([[0.0, 0.0], [0.0, strain]])[1, 1])
        damages.append(max(value.max() for value in given.state.bond_values[:2]))
    np.testing.assert_allclose(tractions, onset * expected, atol=1e-12)
    assert (np.diff(damages) >= 0.0).all()
    assert damages[-1] == 1.0
    assert given.broken > 0
    assert np.trapezoid(s, x) == pytest.approx(1.0, abs=1e-14)


def test_exponential_law_deviates_from_its_lines_by_one_per_cent():
    x = np.linspace(0.0, np.log(64.0), 1000)
    lines = np.interp(x, *LAWS["exponential"])
    assert abs(lines - np.exp(-x)).max() < 0.01


def test_bilinear_law_is_that_of_petersson():
    np.testing.assert_allclose(LAWS["bilinear"], [[0.0, 0.8, 3.6], [1.0, 1 / 3, 0.0]], rtol=1e-15)


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_law_of_two_points_is_linear(lattice):
    """Its damage is computed by the same function. Three points on the line are another path of
    the computation, with the same damage except for rounding errors."""
    cells = [
        Strained(rule=ELASTIC, lattice=lattice, body=GRID, fracture=COHESIVE | {"law": law})
        for law in ("linear", [[0, 7], [3, 0]], [[0, 7], [1, 14 / 3], [3, 0]])
    ]
    for gradient in random_gradients(3):
        linear, two, three = (given.stress(gradient) for given in cells)
        assert np.array_equal(linear, two)
        np.testing.assert_allclose(three, linear, atol=1e-15)
    assert any((value > 0.0).any() for value in cells[0].state.bond_values)


UNITS = {"length": "2 mm", "youngs_modulus": "30 GPa"}


def test_strength_is_the_onset_with_a_unit():
    for name in ("onset", "strength"):
        fracture = {"type": "cohesive", name: "3.9 MPa", "energy": "143 N/m", "law": "bilinear"}
        read = pbdkit.Experiment(**body(1.0, ELASTIC, fracture=fracture, units=UNITS)).fracture
        assert read.law == "bilinear"
        assert (read.onset, read.energy) == pytest.approx((1.3e-4, 143 / 30e9 / 2e-3), rel=1e-12)


def refused(**fracture):
    with pytest.raises(pbdkit.ExperimentError) as error:
        pbdkit.Experiment(**body(1.0, fracture={"type": "cohesive", "energy": 0.1} | fracture))
    return str(error.value)


@pytest.mark.parametrize(
    ("fracture", "words"),
    [
        ({"strength": "1 MPa", "onset": 0.1}, "are the same parameter; remove one of them"),
        ({"strength": 0.1}, "a strength has a unit, as in 3.9 MPa"),
        ({"onset": 0.1, "law": [[0, 1], [1, 2], [2, 0]]}, "stresses should decrease"),
        ({"onset": 0.1, "law": [[0, 1], [1, 0], [2, 0]]}, "and be 0 once"),
        ({"onset": 0.1, "law": [[0.1, 1], [1, 0]]}, "openings should increase from 0"),
        ({"onset": 0.1, "law": "concave"}, "should be 'linear', 'bilinear' or 'exponential'"),
    ],
)
def test_wrong_laws_and_strengths_are_refused(fracture, words):
    assert words in refused(**fracture)


@pytest.mark.parametrize("law", LAWS)
def test_spacing_limits_are_those_of_the_refusal(law):
    """The largest lattice constant in the worst direction is accepted, a larger one is refused."""
    fracture = COHESIVE | {"law": law}
    scene = build_scene(pbdkit.Experiment(**body(1.0, ELASTIC, fracture=fracture)))
    limits = scene.experiment.fracture.spacing_limits(scene.experiment.rule, scene.setting)
    assert limits.process_zone == pytest.approx(ENERGY / ONSET**2)
    largest = min(limits.factors.values())
    build_scene(pbdkit.Experiment(**body(0.999 * largest, ELASTIC, fracture=fracture)))
    with pytest.raises(pbdkit.ExperimentError, match="too small for this spacing"):
        build_scene(pbdkit.Experiment(**body(1.001 * largest, ELASTIC, fracture=fracture)))


def random_gradients(seed, count=6, size=0.03):
    return size * np.random.default_rng(seed).normal(size=(count, 2, 2))


TURNS = {
    "turned": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "mirrored": np.array([[-1.0, 0.0], [0.0, 1.0]]),
    "mirrored on the diagonal": np.array([[0.0, 1.0], [1.0, 0.0]]),
}
GRID = {"type": "grid", "columns": 5, "rows": 5}


@pytest.mark.parametrize("turn", in_turn(TURNS, 2))
@pytest.mark.parametrize("rule", [SPRINGS, ELASTIC], ids=["springs", "elastic"])
def test_law_is_invariant_under_rotation_and_reflection(turn, rule):
    Q = TURNS[turn]
    for seed in range(5):
        one, other = Strained(rule=rule, body=GRID), Strained(rule=rule, body=GRID)
        for gradient in random_gradients(seed):
            expected = Q @ one.stress(gradient) @ Q.T
            np.testing.assert_allclose(other.stress(Q @ gradient @ Q.T), expected, atol=1e-12)
        assert one.broken == other.broken
        assert any((value != 0.0).any() for value in one.state.bond_values)


def test_law_is_independent_of_units():
    known = None
    for a in (0.25, 1.0, 4.0):
        fracture = COHESIVE | {"energy": 6e-4 * a}
        experiment = body(a, ELASTIC, body=GRID, fracture=fracture)
        limits = build_scene(pbdkit.Experiment(**experiment)).constants.limits
        slot = next(s for s in limits if s.rest.y == 0.0)
        c = limits[slot]._asdict()
        found = {name: value / (a if name[0] in "rxy" else 1.0) for name, value in c.items()}
        known = known or found
        assert found == pytest.approx(known, rel=1e-12)


@pytest.mark.parametrize("lattice", LATTICES)
def test_stiffness_never_increases_and_forces_balance(lattice):
    """Whatever the body has been through: no probe of its energy rises, a rigid turn costs
    nothing, and the stiffness is symmetric."""
    generator = np.random.default_rng(3)
    given = Strained(rule=ELASTIC, lattice=lattice, body=GRID)
    probes = generator.normal(size=(20, *given.X.shape))
    turned = given.X @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    before = np.full(len(probes), np.inf)
    for n in range(12):
        u = given.X @ random_gradients(n, 1)[0].T + 0.05 * generator.normal(size=given.X.shape)
        given.put(u)
        forces = [given.forces(probe) for probe in probes]
        energies = np.array([-(f * u).sum() / 2 for f, u in zip(forces, probes, strict=True)])
        assert (energies <= before * (1 + 1e-12)).all()
        assert (energies >= -1e-12).all()
        assert (forces[0] * probes[1]).sum() == pytest.approx((forces[1] * probes[0]).sum())
        assert abs(given.forces(turned)).max() < 1e-12
        assert max(abs(f.sum(axis=0)).max() for f in forces) < 1e-12
        before = energies
    assert given.broken > 0


def test_unloading_follows_the_secant_without_healing():
    given = Strained(rule=ELASTIC, body=GRID)
    gradient = np.array([[0.0, 0.0], [0.0, 2.0 * ONSET]])
    pulled = given.stress(gradient)
    kept = [value.copy() for value in given.state.bond_values]
    assert 0.0 < pulled[1, 1] < ONSET
    for share in (0.7, 0.0, -3.0, 1.0):
        np.testing.assert_allclose(given.stress(share * gradient), share * pulled, atol=1e-15)
        for value, old in zip(given.state.bond_values, kept, strict=True):
            assert np.array_equal(value, old)


def test_crack_softens_only_the_bonds_that_cross_it():
    """Pulled upwards, then sideways: bonds along the first crack are intact, until a second crack
    crosses them. The first crack keeps its direction."""
    given = Strained(rule=ELASTIC, body=GRID)
    planes = given.scene.neighbourhood.planes
    level = next(n for n, plane in enumerate(planes) if plane.slot.rest.y == 0.0)
    upright = next(n for n, plane in enumerate(planes) if plane.slot.rest.x == 0.0)
    values = dict(zip(NUMBERS, given.state.bond_values, strict=True))
    given.stress([[0.0, 0.0], [0.0, 3.0 * ONSET]])
    assert values["damage_left"][upright].max() > 0.1
    assert values["damage_left"][level].max() == 0.0
    given.stress([[5.0 * ONSET, 0.0], [0.0, 0.0]])
    assert values["damage_left"][level].max() > 0.1
    assert values["normal_x_left"][level].max() == values["normal_y_left"][upright].max() == 1.0
    assert (values["normal_x_left"][upright] == 0.0).all()


def test_bond_breaks_if_its_damage_is_complete_in_both_cells():
    halves, generator = 0, np.random.default_rng(5)
    for _ in range(20):
        given = Strained(rule=ELASTIC, body={"type": "grid", "columns": 3, "rows": 2})
        given.put(0.3 * generator.normal(size=given.X.shape))
        left, right = given.state.bond_values[:2]
        broken = given.state.broken_step >= 0
        halves += np.count_nonzero((left >= 1.0) != (right >= 1.0))
        assert np.array_equal(broken, (left >= 1.0) & (right >= 1.0))
    assert halves > 0


def test_bonds_of_a_bent_cell_soften_by_their_own_openings():
    """The crack of a cell opens at its left edge only: the edge breaks, the diagonals have half of
    its opening, and the right edge remains intact."""
    given = Strained(rule=ELASTIC, body={"type": "grid", "columns": 2, "rows": 2})
    opening = 1.25 * 2.0 * ENERGY / ONSET
    bent = np.where(given.X[:, :1] < 0.0, np.sign(given.X[:, 1:]) * opening / 2, 0.0)
    given.put(np.hstack([np.zeros_like(bent), bent]))
    planes = given.scene.neighbourhood.planes
    damage = {
        (plane.slot.rest.x, plane.slot.rest.y): sorted(np.unique(values))[1:]
        for plane, values in zip(planes, given.state.bond_values[0], strict=True)
    }
    assert given.broken == 1
    assert damage[0.0, 1.0] == [1.0]
    assert damage[1.0, 0.0] == []
    diagonals = [values for (x, y), values in damage.items() if x and y]
    assert len(diagonals) == 2
    assert all(len(values) == 1 and 0.0 < values[0] < 1.0 for values in diagonals)


def test_softened_cell_changes_the_forces_on_its_corners_only():
    """The upper corners of the middle cell move up, so that only this cell softens."""
    grid = {"type": "grid", "columns": 4, "rows": 4}
    given, intact = (Strained(rule=ELASTIC, body=grid) for _ in range(2))
    corners = (np.abs(given.X) < 1.0).all(axis=1)
    u = np.zeros_like(given.X)
    u[corners & (given.X[:, 1] > 0.0), 1] = 0.95 * ONSET
    given.put(u)
    assert 0.0 < given.state.bond_values[0].max() < 1.0
    u = np.random.default_rng(3).normal(size=u.shape)
    changes = (np.abs(given.forces(u) - intact.forces(u)) > 1e-9).any(axis=1)
    assert np.array_equal(changes, corners)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("bending", [0.15, 0.25, 0.5, 0.9])
def test_bent_cell_under_compression_does_not_soften(axis, bending):
    """Both edges of a cell are compressed, one more than the other: nothing softens, in particular
    not as by a crack along an edge. Where an edge is stretched, it softens and the other does not.
    """
    for bending_, softens in ((bending, 0), (1.0 + 3.0 * bending, 1)):
        given = Strained(rule=SPRINGS, body={"type": "grid", "columns": 2, "rows": 2})
        along, across = given.X[:, axis], given.X[:, 1 - axis]
        u = np.zeros_like(given.X)
        u[:, axis] = 10.0 * ONSET * along * (2.0 * bending_ * across - 1.0)
        given.put(u)
        edge = np.eye(2)[axis]
        damaged = [
            np.count_nonzero(values)
            for plane, values in zip(
                given.scene.neighbourhood.planes, given.state.bond_values[0], strict=True
            )
            if bending_ < 1.0 or np.array_equal(np.abs(tuple(plane.slot.rest)), edge)
        ]
        assert sum(damaged) == softens


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_cell_that_softened_across_one_axis_is_torn_across_the_other(lattice):
    """The bonds that cross the second crack transmit no force."""
    given = Strained(rule=ELASTIC, lattice=lattice, body=GRID)
    first = given.stress([[0.0, 0.0], [0.0, 1.5 * ONSET]])
    assert 0.0 < first[1, 1] < ONSET
    torn = given.stress([[5.0 * ENERGY / ONSET, 0.0], [0.0, 0.0]])
    assert given.broken > 0
    np.testing.assert_allclose(torn[0], 0.0, atol=1e-12)


def test_cells_begin_to_soften_one_after_the_other():
    """The strain increases with x. A second cell waits until the damage of the first is constant;
    under a larger strain all others wait."""
    given = Strained(rule=ELASTIC, body={"type": "grid", "columns": 6, "rows": 2})
    strain = ONSET * (1.5 + 0.05 * given.X[:, 0])
    u = np.stack([0.0 * strain, strain * given.X[:, 1]], axis=1)
    counts = [0]
    for scale, must_wait in ((1.0, False), (1.0, False), (1.5, True), (1.5, False)):
        assert given.put(scale * u, in_turn=True) == must_wait
        counts.append(sum(np.count_nonzero(value) for value in given.state.bond_values[:2]))
    assert counts[0] < counts[1] < counts[2] == counts[3] < counts[4]


def test_cells_that_do_not_begin_to_soften_need_not_wait():
    """Only the last cell is strained, and its damage increases."""
    given = Strained(rule=ELASTIC, body={"type": "grid", "columns": 6, "rows": 2})
    u = given.X * (given.X[:, :1] == given.X[:, 0].max()) * [0.0, 1.0]
    damage = [0.0]
    for strain in (3.0 * ONSET, 4.0 * ONSET):
        assert not given.put(strain * u, in_turn=True)
        damage.append(sum(value.sum() for value in given.state.bond_values[:2]))
    assert damage[0] < damage[1] < damage[2]


def test_further_bonds_of_a_softening_cell_do_not_wait():
    """The crack of a cell opens at the left edge, and then at both edges."""
    given = Strained(rule=ELASTIC, body={"type": "grid", "columns": 2, "rows": 2})
    shares, counts = np.where(given.X[:, 0] < 0.0, 0.5, 0.0), []
    for share in (shares, 0.5 + 0.0 * shares):
        opening = share * 2.0 * ENERGY / ONSET
        u = np.stack([0.0 * opening, opening * given.X[:, 1]], axis=1)
        assert not given.put(u, in_turn=True)
        counts.append(np.count_nonzero(given.state.bond_values[0]))
    assert 0 < counts[0] < counts[1]


TORN = {
    "body": {"type": "grid", "columns": 6, "rows": 6},
    "cuts": [{"from": [-1.0, 2.5], "to": [2.2, 2.5], "at": 5}],
    "leaders": [
        HOLD,
        {
            "select": {"edge": "top"},
            "motion": {"type": "velocity", "velocity": [2.4e-3, 6e-3], "steps": 25},
        },
    ],
    "steps": 27,
    "diagnostics": [{"type": "displacement"}],
}


@pytest.mark.parametrize("law", ["linear", "bilinear", "exponential"])
def test_kernels_soften_like_numpy(interpreted, law):
    """One that softens is compiled in `testing/test_conformance`, which takes half a minute."""
    pytest.importorskip("numba")
    fracture = {"type": "cohesive", "energy": 2e-3, "onset": 0.01, "law": law}
    found, known = (
        pbdkit.run(
            body(
                1.0, ELASTIC, "square", fracture=fracture, **TORN,
                solver={"type": "stepping", "engine": engine, "relaxation": 0.6} | more,
            ),
            progress=False,
        )
        for engine, more in (("compiled", {"threads": 1}), ("numpy", {}))
    )  # fmt: skip
    damage = known.damage_left.values[-1]
    assert ((damage > 0.0) & (damage < 1.0)).sum() > 3
    assert (known.broken_step.values > 0).any()
    for name in ("u", *NUMBERS, "broken_step"):
        assert np.array_equal(found[name].values, known[name].values), name


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (body(14.0), ["0.0006 is too small for this spacing", "multiply the spacing by less than"]),
        (body(0.1, {"type": "barycentre"}) | {"frame": {"type": "mean"}},
         ["'cohesive' requires a rule that is calibrated to a material",
          "'barycentre' with these parameters is not",
          "or fracture: {type: damage}"]),
        (body(0.1) | {"frame": {"type": "none"}},
         ["'cohesive' softens the cells of the body", "frame 'none'", "{type: natural}"]),
    ],
    ids=["spacing", "barycentre", "frame"],
)  # fmt: skip
def test_incompatible_parts_are_refused(parts, words):
    with pytest.raises(pbdkit.ExperimentError) as error:
        build_scene(pbdkit.Experiment(**parts))
    for word in words:
        assert word in str(error.value)


def test_remedies_for_a_large_spacing_are_effective():
    with pytest.raises(pbdkit.ExperimentError) as error:
        build_scene(pbdkit.Experiment(**body(14.0)))
    words = str(error.value).split()
    share, onset = (
        float(words[words.index("than") + 1].strip(",;")),
        float(words[words.index("below") + 1][:6]),
    )
    for size, more in ((14.0 * share * 0.99, {}), (14.0, {"onset": onset * 0.99})):
        build_scene(pbdkit.Experiment(**body(size, fracture=COHESIVE | more)))


def test_bar_has_its_strength_and_fracture_energy():
    """A sample of `cohesive_strength.py`: the onset is 1.5 % lower in a zone."""
    import cohesive_strength

    rule = cohesive_strength.RULES["elastic, ν = .2"]
    strength, energy, left = cohesive_strength.measured(
        "square", rule, 30, height=2.0, length=5.0, increments=20
    )
    assert strength == pytest.approx(0.985, abs=0.01)
    assert energy == pytest.approx(1.0, abs=0.02)
    assert left < 1e-9


def test_beam_cleaves_at_griffith_load():
    """A sample of `fracture_energy.py`; the whole is in docs/validation/fracture.md."""
    import fracture_energy

    share = fracture_energy.beam(29, far=1.3, count=8)
    assert share.mean() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("last", [0, 5])
def test_condensed_body_matches_the_whole_body(last):
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
