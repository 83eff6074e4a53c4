"""What is asked of the stiffness that a body has, whole and with bonds torn at random."""

from __future__ import annotations

from itertools import pairwise

from pbdkit.interfaces import FollowerRule, FractureModel, FramePolicy, StoresEnergy
from pbdkit.scene.scene import Scene
from pbdkit.testing.laws import (
    asymmetry,
    energy_given_back,
    resistance_to_rigid_motions,
    stiffening,
)
from pbdkit.testing.solids import NoSolidError, Solid
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of, place_of

LINEAR, NEARLY = 1e-11, 1e-8
"""What rounding leaves, as a share of the largest stiffness: of rules that are linear, and of
others, whose stiffness is a difference of forces."""


@asked_of(FollowerRule, FramePolicy, FractureModel, is_needed=True)
def moves_rigidly_for_nothing(subject: Subject) -> None:
    """Where forces are known and edges are free, a body that is moved or turned a little as a whole
    exerts no force, whatever bonds are broken."""
    for solid in _solids(subject):
        for what, K in solid.stages:
            if (force := resistance_to_rigid_motions(solid.scene, K)) > _rounding(solid.scene):
                _fail(
                    solid.scene,
                    f"a rigid motion of a {what} body meets {force:.3g} of its stiffness",
                    "let forces act along the line between two particles, or sum to those of cells "
                    "that feel strains alone",
                )


@asked_of(FollowerRule, FramePolicy, FractureModel, is_needed=True)
def acts_both_ways_alike(subject: Subject) -> None:
    """There, what a particle's displacement does to another is what the other's does to it (Maxwell
    and Betti): forces have no resultant, and a work."""
    for solid in _solids(subject):
        for what, K in solid.stages:
            if (off := asymmetry(K)) > _rounding(solid.scene):
                _fail(
                    solid.scene,
                    f"the stiffness of a {what} body is not symmetric, by {off:.3g} of the largest",
                    "give both ends of a bond one weight, the transpose where it is a matrix",
                )


@asked_of(FollowerRule, FramePolicy, FractureModel, is_needed=True)
def gives_no_energy_back(subject: Subject) -> None:
    """There, no displacement from rest has a negative energy."""
    for solid in _solids(subject):
        for what, K in solid.stages:
            if (back := energy_given_back(K)) > _rounding(solid.scene):
                _fail(
                    solid.scene,
                    f"some displacement of a {what} body gives energy back, {back:.3g} of the "
                    "largest stiffness",
                    "let `force` pull towards where neighbours are",
                )


@asked_of(FollowerRule, FramePolicy, FractureModel)
def does_not_stiffen_by_breaking(subject: Subject) -> None:
    """There, no displacement needs more force after bonds have softened or broken than before."""
    for solid in _solids(subject):
        for (_, before), (what, after) in pairwise(solid.stages):
            if (more := stiffening(before, after)) > _rounding(solid.scene):
                _fail(
                    solid.scene,
                    f"some displacement of a {what} body meets more force than before, by "
                    f"{more:.3g} of the largest stiffness",
                    "let what is seen of a bond be a share of its difference, falling from 1 to 0",
                )


def _solids(subject: Subject) -> list[Solid]:
    try:
        return subject.solids
    except NoSolidError as reason:
        raise NotAskedError(str(reason)) from None


def _fail(scene: Scene, fault: str, remedy: str) -> None:
    raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _rounding(scene: Scene) -> float:
    return NEARLY if isinstance(scene.experiment.rule, StoresEnergy) else LINEAR
