"""Crack tips: exact fields, laws, what limits a domain, and cracks that grow."""

import json
import math

import numpy as np
import pytest

import pbdkit
from pbdkit.components.stress_intensity import IsotropicPlane, auxiliary
from pbdkit.errors import AccuracyWarning, ExperimentError
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.plugin import Stiffness
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

TIP = {"type": "stress-intensity", "youngs_modulus": 1.0}
STEPPING = {"type": "stepping", "engine": "numpy"}
EXTENDED = {"type": "affine", "gradient": [[0.0, 0.0], [0.0, 1e-3]]}
LATTICES = {
    "square": {"type": "square", "a": 1.0},
    "rectangular": {"type": "rectangular", "a": 1.0, "b": 0.8},
    "hexagonal": {"type": "hexagonal", "a": 1.0},
}


def cracked(half, angle=0.0, lattice="square", at=(0.0, 0.25), **parts):
    """A square with a crack from far outside to `at`, along a direction."""
    along, away = np.round([math.cos(angle), math.sin(angle)], 12), 3.0 * half
    start = (np.array(at) - away * along).tolist()
    return {
        "name": "tip",
        "lattice": LATTICES[lattice],
        "body": {"type": "rectangle", "width": 2 * half, "height": 2 * half}
        | {"origin": [-half, -half]},
        "neighbours": {"type": "coordination" if lattice == "hexagonal" else "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": 0.0},
        "frame": {"type": "natural"},
        "cuts": [{"from": start, "to": list(at)}],
        "steps": 1,
        "solver": {"type": "equilibrium"},
        "diagnostics": [TIP],
    } | parts


class Prescribed:
    """A cracked body of which the displacements are given."""

    def __init__(self, parts):
        self._scene = build_scene(pbdkit.Experiment(**parts))
        self._state = initial_state(self._scene)
        (self._diagnostic,) = self._scene.diagnostics
        raster = self._scene.raster
        self.x = raster.reference()
        self._place = raster.place_of(np.arange(raster.count))
        rest = self.measure(0.0 * self.x)
        self.position, self.direction = rest["crack_tip_position"], rest["crack_tip_direction"]

    def measure(self, u):
        """The quantities of the first tip under displacements (particle, axis)."""
        self._state.u.reshape(2, -1)[:, self._place] = u.T
        moment = StateMoment(self._state, Tables(self._scene))
        names = [variable.name for variable in self._diagnostic.variables()]
        return {n: v[0] for n, v in zip(names, self._diagnostic.measure(moment), strict=True)}

    def field(self, K_I=0.0, K_II=0.0, T=0.0, nu=0.0, plane="stress"):
        """The displacements of Williams' expansion about the tip, of Young's modulus 1."""
        kappa = 3 - 4 * nu if plane == "strain" else (3 - nu) / (1 + nu)
        x, y = self.direction
        axes = np.array([[x, y], [-y, x]])
        local = (self.x - self.position) @ axes.T
        local[abs(local) < 1e-9] = 0.0
        u = auxiliary(local, IsotropicPlane(1 / (2 * (1 + nu)), kappa))[0]
        along = (1 - nu**2, -nu * (1 + nu)) if plane == "strain" else (1.0, -nu)
        return (K_I * u[0] + K_II * u[1] + T * local * along) @ axes


def errors(found, K_I, K_II, T):
    return np.array([found["K_I"] - K_I, found["K_II"] - K_II, found["T_stress"] - T])


@pytest.mark.parametrize(
    ("lattice", "angle", "field"),
    [
        ("square", 0.0, (1.0, 0.6, 0.1)),
        ("square", math.pi / 2, (1.0, 0.6, 0.1)),
        ("rectangular", 0.0, (1.0, 0.6, 0.1)),
        ("hexagonal", 0.0, (1.0, 0.0, 0.0)),
    ],
)
def test_exact_field_has_its_intensities_with_the_square_of_the_spacing(lattice, angle, field):
    # The lips of the hexagonal lattice carry less than half cells, in proportion to the spacing.
    sizes = []
    for half in (9.0, 18.0):
        body = Prescribed(cracked(half, angle, lattice))
        found = body.measure(body.field(*field))
        sizes.append(np.abs(errors(found, *field)).max())
        assert found["J"] == pytest.approx(field[0] ** 2 + field[1] ** 2, abs=3 * sizes[-1])
        assert found["G"] == pytest.approx(found["K_I"] ** 2 + found["K_II"] ** 2, rel=1e-3)
    assert sizes[1] < 5e-4
    assert sizes[0] > 3 * sizes[1]


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_energy_release_rate_of_plane_stress_and_plane_strain(plane):
    rule = {"type": "elastic", "poisson_ratio": 0.3, "plane": plane}
    body = Prescribed(cracked(14.0, rule=rule))
    found = body.measure(body.field(2.0, nu=0.3, plane=plane))
    modulus = 1.0 if plane == "stress" else 1 / (1 - 0.3**2)
    assert found["K_I"] == pytest.approx(2.0, rel=2e-3)
    assert found["J"] == pytest.approx(4.0 / modulus, rel=2e-3)


@pytest.fixture(scope="module")
def body():
    return Prescribed(cracked(12.0))


def same(first, second, factors=(1, 1, 1, 1, 1)):
    names = ("K_I", "K_II", "J", "G", "T_stress")
    expected = [factor * first[n] for n, factor in zip(names, factors, strict=True)]
    assert [second[n] for n in names] == pytest.approx(expected, rel=1e-9, abs=1e-11)


def test_intensities_are_linear_and_energies_quadratic_in_the_load(body):
    u = body.field(1.0, 0.6, 0.1)
    same(body.measure(u), body.measure(-3.0 * u), (-3, -3, 9, 9, -3))


def test_rigid_motions_change_nothing(body):
    u = 1e-3 * body.field(1.0, 0.6, 0.1)
    turn = 1e-2 * np.stack([-body.x[:, 1], body.x[:, 0]], axis=1) + [3.0, -1.0]
    first, second = body.measure(u), body.measure(u + turn)
    assert second["K_II"] == pytest.approx(first["K_II"], rel=1e-8)
    assert second["J"] == pytest.approx(first["J"], rel=1e-8)


def test_mirror_image_changes_the_sign_of_mode_two():
    bodies = [Prescribed(cracked(12.0, at=(0.0, y))) for y in (0.25, -0.25)]
    first, second = (
        each.measure(each.field(1.0, K_II, 0.1))
        for each, K_II in zip(bodies, (0.6, -0.6), strict=True)
    )
    same(first, second, (1, -1, 1, 1, 1))


def test_uniform_stress_along_the_crack_is_t_stress_alone(body):
    found = body.measure(body.field(T=1.0))
    assert found["J"] == pytest.approx(0.0, abs=1e-12)
    assert found["K_I"] == pytest.approx(0.0, abs=1e-2)
    assert found["K_II"] == pytest.approx(0.0, abs=1e-12)
    assert found["T_stress"] == pytest.approx(1.0, rel=1e-3)


def test_units_scale_the_intensities(body):
    u = body.field(1.0, 0.6, 0.1)
    units = {"length": "0.25 mm", "youngs_modulus": "200 GPa", "thickness": "1 mm"}
    parts = cracked(12.0, units=units, diagnostics=[{"type": "stress-intensity"}])
    other = Prescribed(parts).measure(u)
    same(body.measure(u), other, (2e5, 2e5, 2e5, 2e5, 2e5))
    parts |= {"initial": EXTENDED, "solver": STEPPING}
    lattice = {**parts, "units": None, "diagnostics": [{**TIP, "youngs_modulus": 2e5}]}
    first, second = (pbdkit.run(each, progress=False) for each in (lattice, parts))
    assert second.K_I.units == "MPa*mm^0.5"
    assert second.J.units == "N/mm"
    assert float(first.K_I[0, 0]) > 0.0
    assert float(second.K_I[0, 0]) == pytest.approx(0.5 * float(first.K_I[0, 0]))
    assert float(second.J[0, 0]) == pytest.approx(0.25 * float(first.J[0, 0]))


def plate(cells, output=None, **parts):
    """A plate with a crack of some cells in its left edge, pulled apart by prescribed edges."""
    leaders = [
        {"select": {"edge": edge}, "motion": {"type": "displace", "displacement": [0.0, 1e-3 * n]}}
        for edge, n in (("top", 1), ("bottom", -1))
    ]
    given = cracked(16.0, at=(cells - 16.0, 0.25), leaders=leaders)
    given["diagnostics"] = [TIP, {"type": "strain-energy", "youngs_modulus": 1.0}]
    return pbdkit.run(given | parts, progress=False, output=output).isel(time=-1)


def test_j_integral_is_the_energy_that_an_anisotropic_body_releases():
    rule = {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 3.0, "shear_ratio": 0.4}
    with pytest.warns(AccuracyWarning, match="crack tip 0 at .*anisotropic.* J is the only value"):
        short, middle, long = (plate(cells, rule=rule) for cells in (13.25, 14.25, 15.25))
    rate = float(short.strain_energy - long.strain_energy) / 2
    assert float(middle.J[0]) == pytest.approx(rate, rel=2e-3)
    assert float(middle.J_error[0]) < 2e-3 * rate
    assert np.isnan(middle.K_I[0])
    assert np.isnan(middle.G[0])


def test_j_integral_is_the_energy_that_a_slanted_crack_releases():
    parts = [
        plate(0, cuts=[{"from": [-30.0, -30.0], "to": [n - 0.25, n - 0.25]}])
        for n in (-3.0, -2.0, -1.0)
    ]
    rate = float(parts[0].strain_energy - parts[2].strain_energy) / (2 * math.sqrt(2))
    assert float(parts[1].J[0]) == pytest.approx(rate, rel=1e-2)
    assert float(parts[1].G[0]) == pytest.approx(rate, rel=3e-2)


def test_tip_lies_where_the_first_intact_bond_crosses_the_line():
    edge, middle = (Prescribed(cracked(8.0, at=(x, 0.5))).position for x in (0.4, 0.6))
    assert edge == pytest.approx([1.0, 0.5])  # With Poisson's ratio 0 diagonals carry nothing.
    assert middle == pytest.approx([1.0, 0.5])
    rule = {"type": "springs"}
    edge, middle = (Prescribed(cracked(8.0, at=(x, 0.5), rule=rule)).position for x in (0.4, 0.6))
    assert edge == pytest.approx([0.5, 0.5])
    assert middle == pytest.approx([1.0, 0.5])


def test_tips_follow_a_crack_that_grows():
    cuts = [
        {"from": [-20.0, 0.5], "to": [-1.75, 0.5], "at": 2},
        {"from": [-2.0, 0.5], "to": [3.25, 0.5], "at": 4},
        {"from": [3.2, 0.4], "to": [5.2, 5.2], "at": 6},
    ]
    ds = pbdkit.run(
        cracked(13.0, cuts=cuts, rule={"type": "springs"}, solver=STEPPING, steps=6),
        progress=False,
    )
    assert ds.sizes["crack_tip"] == 1
    position = ds.crack_tip_position[:, 0].values
    assert np.isnan(position[:2]).all()
    assert np.isnan(ds.K_I[:2]).all()
    assert position[2] == pytest.approx([-1.5, 0.5])
    assert position[4] == pytest.approx([3.5, 0.5])
    assert ds.crack_tip_direction[4, 0].values == pytest.approx([1.0, 0.0])
    assert position[6, 1] > 4.0
    assert ds.crack_tip_direction[6, 0].values[1] > 0.8


@pytest.mark.parametrize(
    ("parts", "what"),
    [
        ({"body": {"type": "rectangle", "width": 22.0, "height": 8.0, "origin": [-16.0, -4.0]}},
         r"an edge of the body or of a hole is 3.5 lattice units away"),
        ({"loads": [{"select": {"nearest": [[4.0, 0.0]]}, "force": [0.0, 1.0]}]}, "a load"),
        ({"leaders": [{"select": {"nearest": [[4.0, 0.0]]}, "motion": {"type": "hold"}}]},
         "a leader"),
        ({"regions": {"stiff": {"type": "disc", "radius": 3.0, "centre": [6.0, 0.0]}},
          "rule": {"type": "elastic", "poisson_ratio": 0.0,
                   "stiffness": {"otherwise": 1.0, "stiff": 9.0}}}, "another material"),
        ({"cuts": [{"from": [-30.0, 0.25], "to": [0.0, 0.25]},
                   {"from": [4.0, -2.0], "to": [4.0, 20.0]}],
          "diagnostics": [TIP | {"tips": [{"at": [0.0, 0.25], "direction": [1.0, 0.0]}]}]},
         "another crack"),
        ({"cuts": [{"from": [-4.0, 0.25], "to": [0.0, 0.25]}]}, "the other end of the crack"),
        ({"diagnostics": [TIP | {"tips": [{"at": [6.0, 6.0], "direction": [1.0, 0.0]}]}]},
         "no broken bond is near it"),
    ],
    ids=["edge", "load", "leader", "material", "crack", "end", "nowhere"],
)  # fmt: skip
def test_a_tip_without_space_has_no_values_and_a_reason(parts, what):
    parts = cracked(16.0, solver=STEPPING) | parts
    with pytest.warns(AccuracyWarning, match=rf"stress-intensity: crack tip 0 at \(.*{what}"):
        ds = pbdkit.run(parts, progress=False)
    assert np.isnan(ds.J[-1, 0])


def test_domains_avoid_what_is_near_and_report_it():
    given = cracked(12.0, at=(3.25, 0.25), diagnostics=[TIP | {"radius": 11.0}])
    given |= {"solver": STEPPING}
    with pytest.warns(AccuracyWarning, match="domains are smaller than `radius`, because an edge"):
        ds = pbdkit.run(given, progress=False)
    assert 8.0 < float(ds.crack_tip_radius[-1, 0]) < 9.0
    assert float(ds.J[-1, 0]) == 0.0


def test_large_displacement_gradients_are_reported(body):
    with pytest.warns(AccuracyWarning, match="exceed 0.1"):
        body.measure(body.field(2.0))


def test_no_crack_is_an_error():
    given = cracked(8.0, cuts=[{"from": [-20.0, 0.25], "to": [20.0, 0.25]}])
    with pytest.raises(ExperimentError, match=r"requires a crack tip.*add `cuts` or `cracks`"):
        build_scene(pbdkit.Experiment(**given))
    tip = {"at": [0.0, 0.0], "direction": [0.0, 0.0]}
    with pytest.raises(ExperimentError, match="the direction has no length"):
        pbdkit.Experiment(**cracked(8.0, diagnostics=[TIP | {"tips": [tip]}]))


def test_anisotropic_stiffness_has_no_isotropic_constants():
    assert IsotropicPlane.of(Stiffness(2.0, 1.0, 0.3, 0.4)) is None


@pytest.mark.parametrize("units", [None, {"length": "0.5 mm", "youngs_modulus": "2 GPa"}])
def test_explain_compares_tips_with_the_fracture_energy(units, call, tmp_path):
    fracture = {"type": "cohesive", "energy": 4e-6, "onset": 1e-3}
    fracture["cracks"] = [[[-30.0, 0.5], [0.25, 0.5]]]
    file, modulus = str(tmp_path / "tip.nc"), 2000.0 if units else 1.0
    diagnostics = [{**TIP, "youngs_modulus": modulus}]
    started = {"solver": STEPPING, "initial": EXTENDED}
    plate(
        0, cuts=[], fracture=fracture, units=units, diagnostics=diagnostics, output=file, **started
    )
    (tip,) = json.loads(call("explain", file, "--json").out)["crack_tips"]
    assert tip["critical"] == pytest.approx(4e-6 * (0.5 if units else 1.0) * modulus)
    assert 0.01 < tip["share"] == pytest.approx(tip["release"] / tip["critical"])
    assert tip["load_factor"] == pytest.approx(tip["share"] ** -0.5)
    text = call("explain", file).out
    assert f"{tip['share']:.3g} of the critical one" in text
    assert f"the crack grows at {tip['load_factor']:.4g} times the load" in text


def test_explain_names_tips_without_critical_energy(call, tmp_path):
    file = str(tmp_path / "tip.nc")
    plate(12.25, output=file, solver=STEPPING)
    assert "no critical energy release rate" in call("explain", file).out
