"""Results and texts of `pbdkit identify` for rules and lattices of third parties."""

import json
from typing import Literal

import numpy as np
import pytest
from identity_cases import (
    BARYCENTRE,
    EIGHT,
    HEXAGONAL,
    NEAREST,
    RECTANGULAR,
    SQUARE,
    WEIGHTED,
    experiment,
    identity,
    oblique,
)
from remembering_parts import Tiring

import pbdkit
from pbdkit.identification.elastic_constants import Elasticity
from pbdkit.plugin import FollowerRule, Table, interpolate, length

HONEYCOMB = {"type": "honeycomb"}


def test_lattice_with_two_sites_is_identified_by_its_long_waves():
    """A walk over three neighbours at distance 1 spreads by 1/4; waves λ = ±|Σ exp(ik·r)|/3."""
    found = identity(HONEYCOMB, NEAREST, BARYCENTRE)
    assert (found.kind, found.symmetry) == ("diffusion", "isotropic")
    assert found.stencil.sites == 2
    assert found.diffusivity == pytest.approx(0.25, rel=1e-12)
    assert found.spectrum.smallest == pytest.approx(-1.0, abs=1e-12)
    assert "2 sites per cell: their relative shifts are eliminated" in found.notes


def test_springs_along_a_honeycomb_have_no_shear_stiffness():
    """Three bonds a site are too few: C11 = C12 and C66 = 0, with the sites' shift let go."""
    found = identity(HONEYCOMB, NEAREST, "central")
    constants = found.body.stiffness / found.body.stiffness[0, 0]
    np.testing.assert_allclose(constants, [[1, 1, 0], [1, 1, 0], [0, 0, 0]], atol=1e-12)
    assert found.body.least_stiffness == pytest.approx(0.0, abs=1e-12)
    assert "the energy of some uniform strain is zero" in found.notes
    assert any(note.endswith("do not decay at all") for note in found.notes)


def test_equal_springs_are_isotropic_on_triangles_and_not_on_squares():
    triangles = identity(HEXAGONAL, NEAREST, "central")
    assert (triangles.symmetry, triangles.poisson_ratio) == ("isotropic", pytest.approx(1 / 3))
    squares = identity(SQUARE, EIGHT, "central")
    assert (squares.symmetry, squares.body.axis) == ("square", 0.0)
    # C11 as Σ n_x² x² = 2 + 2 over edges and diagonals, C12 = C66 as Σ n_x² y² = 0 + 2.
    np.testing.assert_allclose(
        squares.body.stiffness / squares.body.stiffness[0, 0],
        [[1, 0.5, 0], [0.5, 1, 0], [0, 0, 0.5]],
        atol=1e-12,
    )
    assert squares.body.zener == pytest.approx(2.0)


@pytest.mark.parametrize("lattice", [{"type": "hexagonal", "a": 1.0}, {"type": "displaced"}])
def test_larger_cell_changes_nothing(lattice):
    two_sites, one_site = (
        identity(lattice, NEAREST, WEIGHTED) for lattice in (lattice, oblique(60.0))
    )
    assert (two_sites.stencil.sites, one_site.stencil.sites) == (1, 1)
    np.testing.assert_allclose(two_sites.long.second, one_site.long.second, atol=1e-12)
    assert two_sites.spectrum.smallest == pytest.approx(one_site.spectrum.smallest, abs=1e-9)


@pytest.mark.parametrize("rule", [{"type": "elastic", "poisson_ratio": 0.3}, WEIGHTED])
def test_lattice_scale_changes_nothing(rule):
    small, large = (identity({"type": "square", "a": a}, EIGHT, rule) for a in (1e-3, 1e3))
    np.testing.assert_allclose(small.long.second, large.long.second, atol=1e-12)
    assert (small.spacing, large.spacing) == (1e-3, 1e3)


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        (
            "odd",
            "the coupling is not symmetric: ∂x∂x of y moves x by 0.1125 and ∂x∂x of x moves y by "
            "-0.1125, so that there is no energy",
        ),
        (
            "slanted",
            "a rigid rotation costs energy: the second-order terms Q_xxxy = 0.125 and Q_xyxx = 0 "
            "should be one constant",
        ),
        (
            "windy",
            "opposite neighbours have different weights: displacements drift, "
            "on average by (-0.15, 0) h per step",
        ),
        (
            "anchored",
            ("a rigid translation is not preserved: under a translation by 1 along x, the rule "
            "moves a particle by -0.1 along x per step"),
        ),
        (
            "restless",
            "a body at rest does not remain at rest: the rule moves it by 0.01 h per step",
        ),
        (
            "bent",
            ("arbitrarily small displacements do not superpose: the rule is not differentiable at "
            "rest, and has no plane waves; a table with a corner at the distance of a neighbour "
            "has this effect: move the point"),
        ),
        (
            "idle",
            "the second-order terms vanish: long waves do not decay as in diffusion",
        ),
        (
            "growing",
            "long waves along 0° grow instead of decaying: their diffusivity is -0.375",
        ),
        (
            "sloping",
            ("the rule depends on the position: the weights at (8, 0) differ from those in the "
            "middle"),
        ),
    ],
)  # fmt: skip
def test_unclassified_rule_has_a_reason(rule, reason):
    found = identity(SQUARE, EIGHT, rule)
    assert (found.kind, found.symmetry, found.poisson_ratio) == ("neither", None, None)
    assert reason in found.reasons
    json.dumps(found.as_dict())


class Cornered(FollowerRule):
    """Preserves translations; its table has a corner at the distance of the nearest neighbours."""

    type: Literal["cornered"] = "cornered"
    law: Table = Table([(0.0, 1.0), (1.0, 1.0), (2.0, 0.5)])

    @staticmethod
    def gather(d, r, w, p):
        return interpolate(length(r + d), p.law) * (r + d), 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


def test_translations_are_not_blamed_for_a_corner_of_a_table():
    settings = ["rule={type: cornered}"]
    found = pbdkit.identify(pbdkit.load("paper/a", components=[Cornered], settings=settings))
    (reason,) = found.reasons
    assert "not differentiable" in reason
    assert reason.endswith("move the point")


def test_immobile_sites_are_not_one_body():
    found = identity(HONEYCOMB, NEAREST, "idle")
    said = "relative displacements of the sublattices do not decay: they are not coupled"
    assert (found.kind, found.reasons) == ("neither", (said,))


def test_zero_stretching_stiffness_has_no_anisotropy():
    costless = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.5]])
    assert Elasticity(costless, np.eye(2)).zener is None


def test_rule_with_state_is_identified_in_its_initial_state():
    """Fresh particles follow the barycentre by their zeal: 0.9 of its diffusivity."""
    found = pbdkit.identify(experiment(SQUARE, NEAREST, Tiring()), components=[Tiring])
    fresh = identity(SQUARE, NEAREST, BARYCENTRE)
    assert (found.kind, found.symmetry) == (fresh.kind, fresh.symmetry)
    assert found.diffusivity == pytest.approx(0.9 * fresh.diffusivity, rel=1e-9)


def test_growing_waves_are_unstable_at_any_relaxation():
    found = identity(SQUARE, EIGHT, "growing")
    assert found.spectrum.largest_stable_relaxation is None
    assert "some waves grow at any relaxation" in found.notes


def test_rotating_waves_have_their_own_bound():
    """z = 1 ± 0.3 i times that of the barycentre, up to 3/2: w < 2 / (1.5 · 1.09)."""
    found = identity(SQUARE, EIGHT, "odd")
    assert found.spectrum.largest_stable_relaxation == pytest.approx(2 / (1.5 * 1.09))
    assert found.spectrum.imaginary == pytest.approx(0.45)


def test_failing_rule_is_named():
    with pytest.raises(pbdkit.PluginError) as caught:
        identity(SQUARE, EIGHT, "failing")
    assert str(caught.value).startswith(
        "FollowerRule 'failing' failed when evaluated for small displacements: "
        "ValueError: no such neighbour (identity_cases.py, line "
    )
    with pytest.raises(pbdkit.ExperimentError) as refused:
        identity(SQUARE, EIGHT, "dividing")
    assert str(refused.value) == (
        "'dividing' returns values that are not finite for small displacements of a body at "
        "rest; check its divisions"
    )
    assert refused.value.where == ("rule",)


def test_the_command_prints_a_table_and_the_figures(call):
    result = call("identify", "e.json")
    assert (result.code, result.err) == (0, "")
    assert result.out.startswith("tensile: barycentre, square lattice, 4 neighbours (coordination)")
    rows = {line[:22].strip(): line[22:].strip() for line in result.out.splitlines()}
    assert rows["identity"] == "isotropic diffusion"
    assert rows["diffusivity D"] == "0.25 h²/step"
    assert rows["relaxation"] == "stable below 1"
    assert "note: away from free edges the rule is plane-stress elasticity" in result.out
    settings = ("--set", "rule={type: springs}", "--set", "neighbours={type: chebyshev}")
    figures = json.loads(call("identify", "e.json", "--json", *settings).out)
    assert figures == pbdkit.identify(pbdkit.load("e.json", settings=settings[1::2])).as_dict()
    assert figures["poisson_ratio"] == pytest.approx(1 / 3)


def test_the_table_of_an_anisotropic_body(call):
    parts = {
        "lattice": RECTANGULAR,
        "neighbours": EIGHT,
        "rule": "{type: orthotropic, poisson_ratio: 0.2, modulus_ratio: 0.5, shear_ratio: 0.3}",
        "solver": "{type: stepping, memory: 0.25}",
    }
    settings = [a for k, v in parts.items() for a in ("--set", f"{k}={v}".replace("'", ""))]
    lines = call("identify", "e.json", *settings).out.splitlines()
    rows = {line[:22].strip(): line[22:].strip() for line in lines}
    assert rows["identity"] == "orthotropic elasticity"
    assert rows["elastic constants"].startswith("C22 0.5, C12 0.1, C66 0.294 in units of C11 = ")
    assert rows["Poisson's ratio"] == "0.2 under tension along x, 0.1 along y (plane stress)"
    assert rows["axis of symmetry"] == "at 0°"
    assert rows["relaxation"] == "stable below 0.900625 with memory 0.25"
