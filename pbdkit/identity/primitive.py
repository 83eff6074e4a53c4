"""The stencil of a rule in the smallest repeat cell, in units of the spacing.

A lattice may be told by a larger cell than it needs: two sites a cell for the rows of a hexagonal
lattice, one of which is the other shifted. Sites that a translation takes to one another, stencil
and all, are one site here; what then is left over are the sublattices of a lattice with a basis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.stencil import Stencil
from pbdkit.interfaces import Cell

Floats = NDArray[np.float64]
NEAR = 1e-6
"""Places nearer than this, in units of the spacing, are one."""
ALIKE = 1e-8
"""Matrices that differ by less, as a share of the largest entry, are one."""


@dataclass(frozen=True)
class Primitive:
    """move_s = own_s u_s + Σ matrix_e u_target_e over the entries e with source_e = s.

    `spacing` is the smallest distance of two sites (lattice units), the unit of all other
    lengths; `basis` holds the shortest two independent translations as rows; `own` is
    (site, axis, axis), `source` and `target` (entry,), `rest` (entry, axis), `matrix`
    (entry, axis, axis).
    """

    spacing: float
    basis: Floats
    own: Floats
    source: NDArray[np.intp]
    target: NDArray[np.intp]
    rest: Floats
    matrix: Floats

    @property
    def sites(self) -> int:
        """How many sites a cell has."""
        return len(self.own)


def spacing_of(cell: Cell) -> float:
    """The smallest distance between two sites, in lattice units."""
    reach = min(float(np.hypot(*v)) for v in cell.vectors) * (1 + NEAR)
    return min(o.length for s in range(len(cell.sites)) for o in cell.offsets(s, reach))


def primitive(cell: Cell, stencil: Stencil) -> Primitive:
    """The stencil with sites that are translated copies of one another taken together."""
    spacing = spacing_of(cell)
    at = np.array([site.at for site in cell.sites]) / spacing
    vectors = np.array(cell.vectors) / spacing
    slots = list(stencil.neighbours)
    whole = Primitive(
        spacing,
        vectors,
        stencil.own,
        np.array([slot.source for slot in slots]),
        np.array([slot.target for slot in slots]),
        np.array([slot.rest for slot in slots]) / spacing,
        np.array(list(stencil.neighbours.values())),
    )
    shifts = [at[s] - at[0] for s in range(len(at))]
    images = [_image(at, vectors, shift) for shift in shifts]
    kept = [
        (shift, image)
        for shift, image in zip(shifts, images, strict=True)
        if image is not None and _same_under(whole, image)
    ]
    basis = _shortest(vectors, np.array([shift for shift, _ in kept]))
    return _merged(whole, basis, np.array([image for _, image in kept]))


def _image(at: Floats, vectors: Floats, shift: Floats) -> NDArray[np.intp] | None:
    """Which site each site lands on when all are shifted; None where one lands on no site."""
    apart = at[:, None, :] + shift - at[None, :, :]
    cells = apart @ np.linalg.inv(vectors)
    misses = np.linalg.norm((cells - np.rint(cells)) @ vectors, axis=-1)
    image: NDArray[np.intp] = misses.argmin(axis=1)
    return image if (misses.min(axis=1) < NEAR).all() else None


def _same_under(whole: Primitive, image: NDArray[np.intp]) -> bool:
    """Whether every site has the stencil of its image."""
    scale = np.abs(whole.matrix).max()
    if np.abs(whole.own[image] - whole.own).max() > ALIKE * scale:
        return False
    for s in range(whole.sites):
        here, there = whole.source == s, whole.source == image[s]
        if here.sum() != there.sum():
            return False
        far = np.linalg.norm(whole.rest[here][:, None] - whole.rest[there], axis=-1)
        pair = far.argmin(axis=1)
        if far.min(axis=1).max() > NEAR:
            return False
        if (image[whole.target[here]] != whole.target[there][pair]).any():
            return False
        if np.abs(whole.matrix[here] - whole.matrix[there][pair]).max() > ALIKE * scale:
            return False
    return True


def _merged(whole: Primitive, basis: Floats, images: NDArray[np.intp]) -> Primitive:
    """One site for each set of images, the first of them."""
    first = images.min(axis=0)
    names, number = np.unique(first, return_inverse=True)
    entries = np.isin(whole.source, names)
    return Primitive(
        whole.spacing,
        basis,
        whole.own[names],
        number[whole.source[entries]],
        number[whole.target[entries]],
        whole.rest[entries],
        whole.matrix[entries],
    )


def _shortest(vectors: Floats, shifts: Floats) -> Floats:
    """The shortest two independent translations among shifts + cells: a reduced basis."""
    a, b = vectors
    while True:  # Lagrange and Gauss, so that few cells around have to be looked at
        if a @ a > b @ b:
            a, b = b, a
        turns = np.rint(a @ b / (a @ a))
        if turns == 0:
            break
        b = b - turns * a
    cells = np.array([m * a + n * b for m in range(-2, 3) for n in range(-2, 3)])
    within = shifts - np.rint(shifts @ np.linalg.inv(np.array([a, b]))) @ np.array([a, b])
    found = (cells[:, None] + within[None]).reshape(-1, 2)
    # Nearly equal lengths are told apart by direction, so that rounding does not choose.
    upper = found[(found[:, 1] > NEAR) | ((np.abs(found[:, 1]) <= NEAR) & (found[:, 0] > NEAR))]
    lengths = np.round(np.linalg.norm(upper, axis=1), 6)
    upper = upper[np.lexsort((np.arctan2(upper[:, 1], upper[:, 0]), lengths))]
    one = upper[0]
    across = np.abs(upper[:, 0] * one[1] - upper[:, 1] * one[0])
    return np.array([one, upper[across > NEAR][0]])
