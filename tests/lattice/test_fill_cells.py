"""Cells at an outline: areas, lengths and connected pieces inside them, against analytic ones."""

import math

import numpy as np
import pytest

from pbdkit.lattice.fill import _is_separated, cut_by_border, has_pieces, shares_inside

CELLS = {
    "square": [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)],
    "oblong": [(0.0, 0.0), (1.0, 0.0), (1.0, 0.6), (0.0, 0.6)],
    "triangle": [(0.0, 0.0), (1.0, 0.0), (0.5, math.sqrt(0.75))],
}


def area(corners):
    x, y = np.array(corners).T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def clipped(corners, normal, distance):
    """Corners of the part of a convex cell with normal · x <= distance, and the length of the
    cut."""
    result, cut = [], []
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        da, db = np.dot(normal, a) - distance, np.dot(normal, b) - distance
        if da <= 0.0:
            result.append(a)
        if da * db < 0.0:
            cut.append(tuple(np.array(a) + da / (da - db) * np.subtract(b, a)))
            result.append(cut[-1])
    return result, math.dist(*cut) if len(cut) == 2 else 0.0


def placed(name, count):
    """Corners of cells at random places, (corner, cell), and their shifts."""
    shift = np.random.default_rng(5).uniform(-20.0, 20.0, (count, 2))
    at = np.array(CELLS[name])[:, None, :] + shift
    return at[..., 0], at[..., 1], shift


@pytest.mark.parametrize("angle", [0.0, 25.0, 100.0, 215.0, 310.0])
@pytest.mark.parametrize("name", CELLS)
def test_half_planes_and_strips_have_analytic_areas_and_lengths(name, angle):
    """A half-plane cuts a polygon from each cell. A strip is the difference of two half-planes; its
    two sides are both borders."""
    normal = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    (x, y, _), corners = placed(name, 1), CELLS[name]
    base = np.array([x[0, 0], y[0, 0]])
    projections = np.array(corners) @ normal
    for part in (-0.2, 0.1, 0.35, 0.53, 0.8, 0.97, 1.2):
        level = projections.min() + part * np.ptp(projections)

        def plane(px, py, level=level):
            return (px - base[0]) * normal[0] + (py - base[1]) * normal[1] - level

        inside, length = clipped(corners, normal, level)
        share = area(inside) / area(corners) if len(inside) > 2 else 0.0
        found, facing = cut_by_border(plane, x, y)
        np.testing.assert_allclose(found, share, atol=1e-12)
        np.testing.assert_allclose(facing[0], length * np.outer(normal, normal), atol=1e-12)
        np.testing.assert_allclose(shares_inside(plane, x, y)[0], share, atol=1e-12)
        assert not has_pieces(plane, x, y)
        assert not shares_inside(plane, x, y)[1]


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize("radius", [0.7, 2.3, 7.9])
def test_the_cells_of_a_disc_add_up_to_it(name, radius):
    """Their areas to π r², and the integrals of n nᵀ to π r times the identity."""
    a, b = np.ptp(np.array(CELLS[name]), axis=0)
    n = np.arange(-math.ceil(10 / a), math.ceil(10 / a))
    m = np.arange(-math.ceil(10 / b), math.ceil(10 / b))
    i, j = (grid.ravel() for grid in np.meshgrid(n, m))
    cells = [np.array(CELLS[name])]
    slant = 0.5 if name == "triangle" else 0.0
    if name == "triangle":
        cells.append(np.array([(1.0, 0.0), (1.5, b), (0.5, b)]))
    total, turned = 0.0, np.zeros((2, 2))
    for cell in cells:
        x = cell[:, :1] + a * i + slant * j
        y = cell[:, 1:] + b * j
        x, y = x + 0.123, y + 0.071

        def disc(px, py):
            return np.hypot(px, py) - radius

        share, facing = cut_by_border(disc, x, y)
        assert ((share >= 0.0) & (share <= 1.0)).all()
        total += share.sum() * area(cell.tolist())
        turned += facing.sum(axis=0)
        coarse, _ = shares_inside(disc, x, y)
        np.testing.assert_allclose(coarse, share, atol=4e-3)
    assert total == pytest.approx(math.pi * radius**2, rel=1e-4)
    np.testing.assert_allclose(turned, math.pi * radius * np.eye(2), rtol=1e-3, atol=1e-3)


def nearest(*shapes):
    return lambda x, y: np.minimum.reduce([shape(x, y) for shape in shapes])


def disc(cx, cy, r):
    return lambda x, y: np.hypot(x - cx, y - cy) - r


def point(cx, cy):
    """The distance 0 of a point on the outline, as that of a body within its tolerance."""
    return lambda x, y: np.where(np.hypot(x - cx, y - cy) < 1e-9, 0.0, np.hypot(x - cx, y - cy))


def below(level):
    return lambda x, y: y - level


PIECES = {
    "one disc": (disc(0.45, 0.4, 0.2), False),
    "two discs": (nearest(disc(0.0, 0.0, 0.3), disc(1.0, 1.0, 0.3)), True),
    "two discs that overlap": (nearest(disc(0.35, 0.5, 0.2), disc(0.65, 0.5, 0.2)), False),
    "a strip and a disc at the side": (nearest(below(0.2), disc(0.5, 1.0, 0.1)), True),
    "a strip and a point on the outline": (nearest(below(0.2), point(0.5, 0.9995)), False),
    "a strip and a small disc there": (nearest(below(0.2), disc(0.5, 0.9995, 0.01)), True),
    "a strip and a corner": (nearest(below(0.2), disc(1.0, 1.0, 0.05)), True),
    "nearly two strips": (lambda x, y: 0.1 - np.abs(y - 0.5) - 10 * (x > 0.8), False),
    "two strips": (lambda x, y: 0.1 - np.abs(y - 0.5), True),
    "two strips and a thin void": (lambda x, y: 1e-3 - np.abs(y - 0.53), True),
    "a ring": (lambda x, y: np.abs(np.hypot(x - 0.5, y - 0.5) - 0.3) - 0.1, False),
    "all of it": (lambda x, y: np.full(x.shape, -1.0), False),
}


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("name", PIECES)
def test_pieces_are_those_of_the_region(name, turn):
    """However the cell is turned and mirrored."""
    signed, are_several = PIECES[name]
    x, y = (np.array(CELLS["square"]).T[n][:, None] for n in (0, 1))
    x, y = np.roll(x, turn, axis=0), np.roll(y, turn, axis=0)
    assert has_pieces(signed, x, y) == [are_several]
    assert has_pieces(lambda px, py: signed(1.0 - px, py), x, y) == [are_several]
    if are_several:
        assert shares_inside(signed, x, y)[1]


@pytest.mark.parametrize(
    ("width", "end"), [(1e-3, 0.07), (0.05, 0.07), (0.3, 0.07), (0.05, 0.0), (0.3, 0.0)]
)
def test_a_void_between_two_points_separates_them(width, end):
    """Even if one of the points lies on the outline."""

    def signed(x, y):
        return width / 2 - np.abs(x - 0.4)

    a, b = np.array([[0.1], [0.0]]), np.array([[0.4 + width / 2 + end], [0.2]])
    near, far = signed(*a), np.minimum(signed(*b), 0.0) if end else np.zeros(1)
    assert _is_separated(signed, a, b, near, far).all()
    assert _is_separated(signed, b, a, far, near).all()
    beside = np.array([[0.4 - width / 2], [0.2]])
    assert not _is_separated(signed, a, beside, near, np.zeros(1)).any()
