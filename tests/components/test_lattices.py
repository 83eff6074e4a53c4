"""Indices of the built-in lattices agree with the positions of their sites."""

from itertools import product

import numpy as np
import pytest

from pbdkit.components.frames import NoFrame
from pbdkit.components.lattices import CentredRectangular, Hexagonal, Oblique, Rectangular, Square
from pbdkit.components.neighbours import Chebyshev, Coordination, Euclidean
from pbdkit.lattice.cells import tiling_of
from pbdkit.lattice.neighbourhood import build_neighbourhood
from pbdkit.plugin.lattice import Cell, Vector

LATTICES = [
    Square(a=1.3),
    Rectangular(a=1.3, b=0.7),
    CentredRectangular(a=1.3, b=0.7),
    Hexagonal(a=1.3),
    Oblique(a=1.3, b=0.7, angle=70.0),
]


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda lattice: lattice.type)
def test_primitive_indices_are_coordinates(lattice):
    """X = p e1 + q e2 at every site, and there is one site for each pair of whole numbers."""
    cell = lattice.cell()
    sites = range(len(cell.sites))
    offsets = [
        cell.offset(source, target, step)
        for source, target, step in product(sites, sites, product(range(-3, 4), repeat=2))
    ]
    position = {offset.primitive: np.array(offset.rest) for offset in offsets}
    e1, e2 = position[1, 0], position[0, 1]
    for offset in offsets:
        p, q = offset.primitive
        np.testing.assert_allclose(offset.rest, p * e1 + q * e2, rtol=0, atol=1e-12)
    area = np.linalg.det(np.array(cell.vectors))
    assert np.linalg.det([e1, e2]) == pytest.approx(area / len(cell.sites), rel=1e-12)


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda lattice: lattice.type)
def test_site_indices_number_the_lines_of_sites(lattice):
    """Sites with the same index lie on one line, and lines with successive indices are one
    spacing apart."""
    cell = lattice.cell()
    sites = range(len(cell.sites))
    height = [
        (offset.site[1], offset.rest.y)
        for target, step in product(sites, product(range(-3, 4), repeat=2))
        for offset in [cell.offset(0, target, step)]
    ]
    spacing = cell.vectors[1].y / cell.period[1]
    np.testing.assert_allclose([y for _, y in height], [j * spacing for j, _ in height], atol=1e-12)


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda lattice: lattice.type)
@pytest.mark.parametrize("weights", [(1.0, 1.0), (1.0, 1.7), (2.2, 0.6)])
def test_weighted_neighbours_are_the_sites_within_the_radius(lattice, weights):
    """√(w_x x² + w_y y²) is at most the radius, and equal in a shell."""
    cell, radius = lattice.cell(), 2.9
    sites = range(len(cell.sites))
    shells = Euclidean(radius=radius, weights=weights).shells_around(cell, 0)

    def distance(rest):
        return np.sqrt(weights[0] * rest[0] ** 2 + weights[1] * rest[1] ** 2)

    every = [
        offset
        for target, step in product(sites, product(range(-9, 10), repeat=2))
        for offset in [cell.offset(0, target, step)]
    ]
    expected = {o for o in every if 0.0 < distance(o.rest) <= radius}
    assert {offset for shell in shells for offset in shell} == expected
    means = [np.mean([distance(o.rest) for o in shell]) for shell in shells]
    assert means == sorted(means)
    for shell, mean in zip(shells, means, strict=True):
        np.testing.assert_allclose([distance(o.rest) for o in shell], mean, rtol=1e-6)


@pytest.mark.parametrize("vectors", [((1, 1), (0, 1)), ((1, 0), (1, 1)), ((2, 1), (1, 1))])
def test_neighbours_by_index_distance_do_not_depend_on_the_repeat_cell(vectors):
    """On the square lattice, all cells of area 1 have the neighbours |Δx|, |Δy| ≤ 2."""
    cell = Cell(tuple(Vector(float(x), float(y)) for x, y in vectors), primitive=vectors)
    shells = Chebyshev(shells=2).shells_around(cell, 0)
    expected = {rest for rest in product(range(-2, 3), repeat=2) if rest != (0, 0)}
    assert {tuple(offset.rest) for shell in shells for offset in shell} == expected


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda lattice: lattice.type)
def test_cells_of_regular_lattices_are_regular(lattice):
    neighbours = Coordination() if lattice.type == "hexagonal" else Chebyshev()
    cell = lattice.cell()
    polygons = tiling_of(cell, build_neighbourhood(cell, neighbours).slots).polygons
    assert polygons
    for polygon in polygons:
        assert polygon.is_regular == (lattice.type in ("square", "hexagonal"))


def test_sites_of_the_hexagonal_lattice_have_six_neighbours_at_the_distance_a():
    for sublattice in range(2):
        (shell,) = Coordination().shells_around(Hexagonal(a=1.3).cell(), sublattice)
        assert [offset.length for offset in shell] == pytest.approx([1.3] * 6)


def test_no_frame_has_no_frame_points():
    follow = NoFrame().follow(None)
    assert len(follow.point) == len(follow.body) == len(follow.weight) == 0
