"""Indices of the built-in lattices agree with the positions of their sites."""

from itertools import product

import numpy as np
import pytest

from pbdkit.components.lattices import CentredRectangular, Hexagonal, Oblique, Rectangular, Square

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
