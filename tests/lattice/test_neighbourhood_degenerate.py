"""Lattices without area, neighbours along one line, and frame points without weights are
reported."""

import math
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from property_cases import scene_of

import pbdkit
from pbdkit.lattice.neighbourhood import flatness
from pbdkit.plugin import BasisSite, Cell, Vector

ORIGIN = BasisSite()


class Given(pbdkit.Lattice):
    """The lattice of a cell made by hand, chosen by name."""

    type: Literal["given"] = "given"
    of: str

    def cell(self):
        return CELLS[self.of]


CELLS = {
    "no area": Cell((Vector(1.0, 0.0), Vector(-2.0, 0.0))),
    "two at one place": Cell(
        (Vector(1.0, 0.0), Vector(0.0, 1.0)),
        (ORIGIN, BasisSite(Vector(0.0, 1.0), index=(0, 1))),
        period=(1, 2),
    ),
    "twenty in a row": Cell(
        (Vector(20.0, 0.0), Vector(0.0, 1.0)),
        tuple(BasisSite(Vector(float(i), 0.0), (i, 0), (i, 0)) for i in range(20)),
        period=(20, 1),
        primitive=((20, 0), (0, 1)),
    ),
}


def oblique(angle):
    return {"type": "oblique", "a": 1.0, "b": 1.0, "angle": angle}


def rectangular(a, b):
    return {"type": "rectangular", "a": a, "b": b}


@pytest.mark.parametrize(
    "lattice", [oblique(0.05), oblique(179.99), rectangular(1.0, 9e-4), rectangular(1e100, 1e-100)]
)
def test_nearly_degenerate_lattices_are_refused_quickly(lattice):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        scene_of(lattice=lattice)
    assert str(caught.value).startswith("lattice: the cell vectors (")
    assert "nearly degenerate: the longer vector" in str(caught.value)
    assert "increase their angle, or choose more similar lengths" in str(caught.value)


@pytest.mark.parametrize(("angle", "said"), [(2.8, True), (2.9, False), (177.2, True)])
def test_flat_lattices_give_a_warning(angle, said):
    warnings = scene_of(lattice=oblique(angle), neighbours="chebyshev-1").warnings
    closer = 1 / math.sin(math.radians(angle))
    expected = (
        f"lattice: nearly degenerate, the longer cell vector is {closer:.3g} times the smallest"
    )
    assert [w.startswith(expected) for w in warnings] == [True] * said


@pytest.mark.parametrize(
    ("lattice", "said"),
    [
        (
            "no area",
            "lattice: the cell vectors (1.0, 0.0) and (-2.0, 0.0) span no area; "
            "choose independent ones",
        ),
        (
            "two at one place",
            "lattice: the sites with the indices (0, 0) and (0, 1) lie at one place, (0.0, 0.0); "
            "choose different positions",
        ),
    ],
)
def test_cells_that_form_no_lattice_are_refused(lattice, said):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        scene_of(lattice=Given(of=lattice))
    assert str(caught.value) == said


def test_long_cell_with_many_sites_is_not_flat():
    assert flatness(CELLS["twenty in a row"]) == pytest.approx(1.0, abs=1e-15)
    assert scene_of(lattice=Given(of="twenty in a row")).warnings == ()


@settings(deadline=None)
@given(st.floats(0.2, 2.0), st.floats(0.2, 2.0), st.floats(15.0, 165.0), st.floats(0.1, 3.0))
def test_offsets_are_all_within_the_radius(a, b, angle, radius):
    """Against all pairs of a window that surely holds them."""
    cell = Cell(
        (
            Vector(a, 0.0),
            Vector(b * math.cos(math.radians(angle)), b * math.sin(math.radians(angle))),
        )
    )
    many = math.ceil((radius + 0.1) * max(a, b) / (a * b * math.sin(math.radians(angle))))
    window = range(-many, many + 1)
    every = {
        (m, n)
        for m in window
        for n in window
        if (m, n) != (0, 0) and cell.offset(0, 0, (m, n)).length <= radius
    }
    found = cell.offsets(0, radius)
    assert {o.cell for o in found} == every
    assert len(found) == len(every)
    assert all(one.length <= other.length for one, other in pairwise(found))


class Mute(pbdkit.FramePolicy):
    """Frame point 3 follows a particle with the weight 0."""

    type: Literal["mute"] = "mute"

    def depth(self, reach):
        return reach

    def follow(self, frame):
        point, body = frame.nearest()
        return pbdkit.plugin.FrameMap(point, body, np.where(point == 2, 0.0, 1.0))


def test_frame_point_with_zero_weights_is_refused():
    with pytest.raises(pbdkit.ExperimentError) as caught:
        scene_of(frame=Mute())
    assert str(caught.value) == (
        "frame: 'mute' maps frame point 3 to no particle of the body, so that the point would be "
        "fixed in space; map every frame point"
    )
