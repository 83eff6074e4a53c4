"""Rows of particles on the boundary of a body, against loops over its sites."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import pbdkit
from pbdkit.lattice.raster import RowRange
from pbdkit.scene.scene import build_scene

RAGGED = {"type": "polygon", "vertices": [[0.0, 0.0], [9.0, 2.0], [6.0, 7.0], [2.0, 5.0]]}


def raster_of(lattice):
    return build_scene(
        pbdkit.Experiment(
            name="raster", lattice=lattice, body=RAGGED, rule={"type": "barycentre"}, steps=1
        )
    ).raster


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
def test_ends_of_lines_are_the_outermost_particles(kind, axis, last):
    raster = raster_of({"type": kind, "a": 1.0})
    ends: dict[int, int] = {}
    for i, j in raster.site_of(raster.body_rows).tolist():
        along, line = ((i, j), (j, i))[axis]
        better = max if last else min
        ends[line] = better(ends.get(line, along), along)
    expected = {((n, line), (line, n))[axis] for line, n in ends.items()}
    rows = raster.ends_of_lines(axis, last=last)
    assert len(rows) == len(expected) > 4
    assert set(map(tuple, raster.site_of(rows).tolist())) == expected


def test_ends_of_the_body_are_its_first_and_last_particle():
    raster = raster_of({"type": "square", "a": 0.5, "origin": [0.1, 0.2]})
    X = raster.reference(raster.body_rows)
    np.testing.assert_array_equal(raster.body_ends(), X[[0, -1]])
    assert (X[0] != X[-1]).all()


@pytest.mark.parametrize("ends", [[], [4], [2, 5, 6]])
def test_each_line_belongs_to_one_process(ends):
    whole, far = raster_of({"type": "square", "a": 1.0}), 20
    rasters = [whole]
    if ends:
        parts = pairwise([-far, *ends, far])
        rasters = [replace(whole, row_range=RowRange(None, part, part)) for part in parts]
    lines = np.arange(-3, far - 1)
    assert (sum(raster.is_own(lines).astype(int) for raster in rasters) == 1).all()
