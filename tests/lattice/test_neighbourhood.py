"""Neighbourhoods of every lattice and metric: shells, opposite pairs, mutuality."""

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from property_cases import LATTICES, LATTICES_AND_NEIGHBOURS, NEIGHBOURS, scene_of

import pbdkit
from pbdkit.components.lattices import CentredRectangular, Hexagonal, Oblique, Rectangular, Square
from pbdkit.components.neighbours import Chebyshev, Coordination
from pbdkit.lattice.neighbourhood import build_neighbourhood
from pbdkit.lattice.raster import FRAME
from pbdkit.plugin import (
    BasisSite,
    Cell,
    Vector,
)

combinations = pytest.mark.parametrize(("lattice", "neighbours"), LATTICES_AND_NEIGHBOURS)
spacing = st.floats(0.3, 3.0)
any_lattice = st.one_of(
    st.builds(Square, a=spacing),
    st.builds(Rectangular, a=spacing, b=spacing),
    st.builds(CentredRectangular, a=spacing, b=spacing),
    st.builds(Hexagonal, a=spacing),
    st.builds(Oblique, a=spacing, b=spacing, angle=st.floats(20.0, 160.0)),
)
any_metric = st.builds(
    lambda metric, shells: metric(shells=shells),
    st.sampled_from([Coordination, Chebyshev]),
    st.integers(1, 4),
)


def counts(lattice, metric):
    """Return the number of neighbours in each shell, for every sublattice."""
    found = {
        tuple(len(shell) for shell in metric.shells_around(lattice.cell(), s))
        for s in range(len(lattice.cell().sites))
    }
    assert len(found) == 1
    return found.pop()


@pytest.mark.parametrize("a", [1.0, 0.1, 0.7, 1e6])
@pytest.mark.parametrize(
    ("lattice", "metric", "expected"),
    [
        (Square, Coordination, (4, 4, 4)),
        (Hexagonal, Coordination, (6, 6, 6)),
        (Square, Chebyshev, (8, 16)),
        (Hexagonal, Chebyshev, (8, 16)),
    ],
)
def test_shells_have_the_counts_of_the_paper(lattice, metric, expected, a):
    assert counts(lattice(a=a), metric(shells=len(expected))) == expected


def test_nearly_equal_distances_share_a_shell():
    # Equal within 1e-6 relative (model.md, section 4).
    assert counts(Rectangular(a=1.0, b=1.0 + 5e-7), Coordination(shells=1)) == (4,)
    assert counts(Rectangular(a=1.0, b=1.0 + 5e-6), Coordination(shells=2)) == (2, 2)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(lattice=any_lattice, metric=any_metric)
def test_slots_come_in_exactly_opposite_mutual_pairs(lattice, metric):
    neighbourhood = build_neighbourhood(lattice.cell(), metric)
    slots = [slot for own in neighbourhood.slots for slot in own]
    by_key = {(s.source, s.target, s.cell): s for s in slots}
    assert len(by_key) == len(slots) == 2 * len(neighbourhood.planes)
    for slot in slots:
        other = by_key[slot.target, slot.source, (-slot.cell[0], -slot.cell[1])]
        assert (other.rest.x, other.rest.y) == (-slot.rest.x, -slot.rest.y)
        assert other.site == (-slot.site[0], -slot.site[1])
        assert other.shell == slot.shell
    for own in neighbourhood.slots:
        assert [s.rest for s in own] == [s.rest for s in neighbourhood.slots[0]]
        assert sum(s.rest.x for s in own) == 0.0
        assert sum(s.rest.y for s in own) == 0.0


@settings(max_examples=80, deadline=None, derandomize=True)
@given(lattice=any_lattice, shells=st.integers(1, 4))
def test_coordination_selects_the_smallest_distances(lattice, shells):
    neighbourhood = build_neighbourhood(lattice.cell(), Coordination(shells=shells))
    chosen = max(max(lengths) for lengths in neighbourhood.shells())
    for s in range(len(lattice.cell().sites)):
        near = lattice.cell().offsets(s, chosen * (1 + 1e-7))
        assert len(neighbourhood.slots[s]) >= len(near)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(lattice=any_lattice, shells=st.integers(1, 4))
def test_chebyshev_shell_n_is_index_distance_n(lattice, shells):
    # A square of (2n + 1)² primitive cells less that of n - 1.
    assert counts(lattice, Chebyshev(shells=shells)) == tuple(8 * n for n in range(1, shells + 1))


@combinations
def test_every_bond_has_the_rest_offset_of_its_particles(lattice, neighbours):
    scene = scene_of(lattice=lattice, neighbours=neighbours)
    X, (low, high) = scene.raster.reference(), scene.bonds.ends.T
    rest = [np.hypot(*s.rest) for own in scene.neighbourhood.slots for s in own]
    lengths = np.hypot(*(X[high] - X[low]).T)
    # Sites up to 10 from the origin are rounded to 1e-15.
    assert np.abs(lengths[:, None] - np.array(rest)).min(axis=1).max() < 1e-14
    assert len({tuple(bond) for bond in scene.bonds.ends.tolist()}) == len(low)
    assert (low < high).all()


@combinations
def test_every_body_particle_with_its_frame_has_all_neighbours(lattice, neighbours):
    scene = scene_of(lattice=lattice, neighbours=neighbours)
    ends = np.bincount(scene.bonds.ends.ravel(), minlength=scene.raster.count)
    assert set(ends[scene.raster.body_rows]) == {len(scene.neighbourhood.slots[0])}


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_frame_maps_are_means(lattice, neighbours):
    scene = scene_of(lattice=lattice, neighbours=neighbours)
    total = np.bincount(scene.frame.map.point, scene.frame.map.weight)
    np.testing.assert_allclose(total, 1.0, rtol=1e-15)


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_bonds_are_stored_within_their_reach(lattice, neighbours):
    neighbourhood = scene_of(lattice=lattice, neighbours=neighbours).neighbourhood
    backward, forward = neighbourhood.owner_reach
    for slot, (_, at_start) in neighbourhood.owner.items():
        steps = zip(backward, slot.cell, forward, strict=True)
        assert at_start or all(-low <= step <= high for low, step, high in steps)


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_frame_points_follow_each_of_the_nearest_particles_once(lattice, neighbours):
    scene = scene_of(lattice=lattice, neighbours=neighbours, frame={"type": "mean"})
    raster, follow = scene.raster, scene.frame.map
    X = raster.reference(np.arange(raster.count))
    body, points = raster.body_rows, np.flatnonzero(raster.table_kind == FRAME)
    distance = np.linalg.norm(X[points][:, None] - X[body][None], axis=2)
    near = distance <= distance.min(axis=1, keepdims=True) * (1 + 1e-9)
    point, number = np.nonzero(near)
    np.testing.assert_array_equal(follow.point, point)
    np.testing.assert_array_equal(follow.body, body[number])
    np.testing.assert_allclose(follow.weight, 1.0 / near.sum(axis=1)[point], rtol=1e-15)


@pytest.mark.parametrize("lattice", LATTICES)
def test_offsets_within_a_radius_include_those_of_this_length(lattice):
    cell = scene_of(lattice=lattice).raster.cell
    for source in range(len(cell.sites)):
        shortest = cell.offsets(source, 2.6 * math.hypot(*cell.vectors[0]))
        for offset in shortest:
            within = [other for other in shortest if other.length <= offset.length]
            assert cell.offsets(source, offset.length) == within
            assert cell.offsets(source, 0.999 * offset.length) == [
                other for other in within if other.length <= 0.999 * offset.length
            ]


class OnTheCorner(pbdkit.Lattice):
    """Two sites a cell, neither of them a centre of inversion."""

    type: Literal["on-the-corner"] = "on-the-corner"

    def cell(self):
        other = BasisSite(Vector(0.25, 0.0), index=(1, 0), primitive=(1, 0))
        return Cell(
            vectors=(Vector(1.0, 0.0), Vector(0.0, 1.0)),
            sites=(BasisSite(), other),
            period=(2, 1),
            primitive=((2, 0), (0, 1)),
        )


class Twice(OnTheCorner):
    """Two sites with one index."""

    type: Literal["twice"] = "twice"

    def cell(self):
        cell = super().cell()
        return replace(cell, sites=(cell.sites[0], replace(cell.sites[1], index=(0, 0))))


def test_sites_of_a_cell_have_indices_of_their_own():
    with pytest.raises(pbdkit.ExperimentError, match="these must differ and lie within the"):
        scene_of(lattice=Twice())


def test_asymmetric_neighbourhoods_are_refused():
    """Mutual as they are, a body at rest would drift under the barycentre."""
    expected = (
        r"'coordination' is unbalanced on this lattice: the barycentre of the 1 neighbours of a "
        r"site differs from the site by \(0\.25, 0\), and a body at rest would drift; choose whole"
    )
    with pytest.raises(pbdkit.ExperimentError, match=expected):
        build_neighbourhood(OnTheCorner().cell(), Coordination())
