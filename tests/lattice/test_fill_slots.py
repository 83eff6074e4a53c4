"""Slots of a body that are too narrow for a frame on both of their faces, against loops."""

import math
from itertools import pairwise

import numpy as np
import pytest

from pbdkit.lattice import fill
from pbdkit.lattice.fill import has_narrow_slot


def gap(line, place):
    """The number of empty sites between two particles of a line, or infinity."""
    before = [n for n in range(place) if line[n]]
    after = [n for n in range(place, len(line)) if line[n]]
    if line[place] or not before or not after:
        return math.inf
    return after[0] - before[-1] - 1


def is_narrow(body, layers):
    """Two adjacent lines have an empty site beside each other, both in a gap that is too narrow."""
    width = 2 * layers + 1
    return any(
        gap(one, place) < width and gap(other, place) < width
        for lines in (body, body.T)
        for one, other in pairwise(lines)
        for place in range(len(one))
    )


@pytest.mark.parametrize("at_once", [1, 20, 10**6])
def test_narrow_slots_are_those_of_loops(monkeypatch, at_once):
    monkeypatch.setattr(fill, "CHUNK_ROWS", at_once)
    rng, seen = np.random.default_rng(5), set()
    for _ in range(60):
        body = np.ones((7, 11), bool)
        for _ in range(rng.integers(1, 3)):
            (i, j), (h, w) = rng.integers(-1, (7, 11)), rng.integers(1, 7, 2)
            body[max(i, 0) : i + h, max(j, 0) : j + w] = False
        for layers in (1, 2):
            expected = is_narrow(body, layers)
            assert has_narrow_slot(body, layers) == expected
            seen.add(expected)
    assert seen == {True, False}


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_a_slot_has_room_for_the_frames_of_both_faces(layers):
    for width in range(1, 2 * layers + 3):
        body = np.ones((6, 18), bool)
        body[:3, 5 : 5 + width] = False
        assert has_narrow_slot(body, layers) == (width < 2 * layers + 1)
