"""Calibrated rules are rejected with frames and lattices that do not suit them."""

from typing import Literal

import numpy as np
import pytest

import pbdkit
from pbdkit.components.elasticity import StrainGradient
from pbdkit.lattice import fill as cut_cells
from pbdkit.scene.scene import build_scene

SQUARE, HEXAGONAL = {"type": "square", "a": 1.0}, {"type": "hexagonal", "a": 1.0}
RECTANGULAR = {"type": "rectangular", "a": 1.0, "b": 1.3}
FOUR, EIGHT = {"type": "coordination", "shells": 1}, {"type": "chebyshev", "shells": 1}
ELASTIC, SPRINGS = {"type": "elastic", "poisson_ratio": 0.3}, {"type": "springs"}
ORTHOTROPIC = {
    "type": "orthotropic",
    "poisson_ratio": 0.3,
    "modulus_ratio": 0.5,
    "shear_ratio": 0.2,
}
GRADIENT = {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 2.0}
NATURAL, MEAN = {"type": "natural"}, {"type": "mean"}
GRID = {"type": "grid", "columns": 6, "rows": 5}
DISC = {"type": "disc", "radius": 3.0, "centre": [0.3, 0.1]}


def scene(lattice=SQUARE, neighbours=EIGHT, rule=ELASTIC, frame=NATURAL, body=GRID, **parts):
    named = {"lattice": lattice, "neighbours": neighbours, "rule": rule, "frame": frame}
    return build_scene(pbdkit.Experiment(name="s", body=body, steps=5, **named, **parts))


UNFIT = {
    "neighbours of elastic": (
        {"neighbours": FOUR, "frame": MEAN},
        "rule",
        "requires the square or the rectangular lattice with 8 neighbours",
    ),
    "neighbours of cells": (
        {"neighbours": FOUR},
        "neighbours",
        "use 8 on the square or the rectangular lattice",
    ),
    "lattice of cells": (
        {"lattice": {"type": "oblique", "a": 1.0, "b": 1.0, "angle": 70.0}},
        "neighbours",
        "the neighbours of a site are not the corners of the cells around it",
    ),
    "lattice of elastic": (
        {"lattice": {"type": "oblique", "a": 1.0, "b": 1.0, "angle": 70.0}, "frame": MEAN},
        "rule",
        "requires the square or the rectangular lattice",
    ),
    "orthotropic triangles": (
        {"lattice": HEXAGONAL, "neighbours": FOUR, "rule": ORTHOTROPIC},
        "rule",
        "is not isotropic and requires the square or rectangular lattice",
    ),
    "springs on rectangles": (
        {"lattice": RECTANGULAR, "rule": SPRINGS},
        "rule",
        "requires the hexagonal lattice with 6 neighbours",
    ),
    "gradient on rectangles": (
        {"lattice": RECTANGULAR, "rule": GRADIENT},
        "rule",
        "requires cells of equal sides, but these are 1 by 1.3",
    ),
    "gradient with a frame that lags": (
        {"rule": GRADIENT, "frame": {"type": "mean", "lag": 1}},
        "frame",
        "is incompatible with this setting of frame; use frame: lag: 0",
    ),
    "gradient with fracture": (
        {"rule": GRADIENT, "fracture": {"type": "threshold", "thresholds": [2.0]}},
        "fracture",
        "is incompatible with this setting of fracture; use fracture: {type: none}",
    ),
    "cells of a rule that has none": (
        {"rule": {"type": "barycentre"}},
        "frame",
        "the rule 'barycentre' is not defined by cells",
    ),
    "no cell": (
        {"body": {"type": "disc", "radius": 0.05, "centre": [0.5, 0.5]}},
        "body",
        "contains no cell of the lattice",
    ),
}


@pytest.mark.parametrize(("parts", "place", "said"), UNFIT.values(), ids=UNFIT)
def test_incompatible_parts_are_refused_with_alternatives(parts, place, said):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        scene(**parts)
    assert said in str(caught.value)
    assert caught.value.where[:1] == (place,)


IMPOSSIBLE = {
    "incompressible plane strain": (
        ELASTIC | {"poisson_ratio": 0.495, "plane": "strain"},
        "at most 0.49",
    ),
    "no positive energy": (
        ORTHOTROPIC | {"poisson_ratio": 2.0},
        "poisson_ratio² · modulus_ratio must be below 1, got 2",
    ),
    "Poisson's ratio above a half": (ELASTIC | {"poisson_ratio": 0.6}, "0.5"),
}


@pytest.mark.parametrize(("rule", "said"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_unphysical_materials_are_refused(rule, said):
    with pytest.raises(pbdkit.ExperimentError, match="rule") as caught:
        scene(rule=rule)
    assert said in str(caught.value)


@pytest.mark.parametrize(("frame", "warned"), [(MEAN, True), (NATURAL, False)])
def test_copying_frames_give_a_warning_with_the_error(frame, warned):
    said = [w for w in scene(frame=frame).warnings if "edges are not free of stress" in w]
    assert len(said) == warned
    for text in said:
        assert "6.7 %" in text
        assert "14.5 %" in text
    assert not any("edges" in w for w in scene(rule={"type": "barycentre"}, frame=MEAN).warnings)


def test_cut_cells_have_the_area_of_the_outline(monkeypatch):
    """The moment of a disc is reproduced at second order, except for the slivers that are left
    out."""
    monkeypatch.setattr(cut_cells, "MIN_SHARE", 0.0)
    off = []
    for spacing in (0.2, 0.1, 0.05):
        lattice = SQUARE | {"a": spacing}
        built = scene(lattice=lattice, body={"type": "disc", "radius": 1.0, "centre": [0.3, 0.1]})
        area = built.cells.share.sum() * spacing**2
        off.append(abs(area / 3.141592653589793 - 1))
    assert off[0] < 1e-4
    assert off[2] < off[0] / 8
    monkeypatch.undo()
    slivers = scene(lattice=lattice, body={"type": "disc", "radius": 1.0, "centre": [0.3, 0.1]})
    assert 0 < area - slivers.cells.share.sum() * spacing**2 < 0.02 * 80 * spacing**2
    hexagons = scene(HEXAGONAL | {"a": 0.05}, FOUR, body=DISC | {"radius": 1.0})
    triangle = 0.05**2 * 3**0.5 / 4
    assert hexagons.cells.share.sum() * triangle == pytest.approx(3.141592653589793, rel=1e-3)


def test_cells_between_explicit_sites_are_whole():
    assert set(scene().cells.share.ravel().tolist()) == {0.0, 1.0}
    assert scene().cells.share.sum() == 5 * 4


class Tiring(pbdkit.plugin.Remembers, StrainGradient):
    type: Literal["tiring"] = "tiring"

    def remembered(self):
        return (pbdkit.plugin.Remembered("tiredness", "how tired it is", "1"),)


def test_rule_composed_with_a_rule_with_state_is_refused():
    tiring = Tiring(poisson_ratio=0.3, length=2.0)
    with pytest.raises(pbdkit.ExperimentError, match="one without remembered numbers"):
        scene(rule=tiring)


def test_difference_of_bodies_of_explicit_sites_gives_no_warning():
    """Such bodies have no outline and are infinitely far: their differences have whole cells."""
    body = {
        "type": "difference",
        "of": [
            {"type": "rectangle", "width": 9.0, "height": 6.0, "origin": [-4.0, -1.3]},
            {"type": "grid", "columns": 4, "rows": 4},
        ],
    }
    cells = scene(body=body, leaders=[]).cells
    assert cells is not None
    assert np.isfinite(cells.share).all()
