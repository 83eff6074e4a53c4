"""The program of a scene: the operations of a step, in their order."""

from __future__ import annotations

from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import BreakBonds, CutBonds
from pbdkit.stepping.contact import PushOut
from pbdkit.stepping.followers import MoveFollowers
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.leaders import (
    CorrectGuided,
    GuideLeaders,
    GuideToObstacles,
    HoldDirections,
    HoldLeaders,
    PlaceLeaders,
    TurnDirections,
)
from pbdkit.stepping.particle_operation import OperateOnParticles
from pbdkit.stepping.step import Hindrance, Mode, Operation

Program = tuple[Operation, ...]
ORDER: tuple[type[Operation], ...] = (
    CutBonds,
    PlaceLeaders,
    BreakBonds,
    TurnDirections,
    GuideLeaders,
    MoveFollowers,
    HoldDirections,
    CorrectGuided,
    OperateOnParticles,
    GuideToObstacles,
    PushOut,
    HoldLeaders,
    FollowFrame,
)
"""The order of a step: it stands here, and nowhere else."""


def program_of(scene: Scene, sweep: MoveFollowers | None = None) -> Program:
    """Return the operations that a scene needs, in the order of a step; of a feature that it does
    not have there is none. `sweep` takes the place of the one that moves its followers."""
    found: list[Operation] = []
    for kind in ORDER:
        found += [sweep] if sweep and kind is MoveFollowers else kind.of(scene)
    return tuple(found)


def moves_of(scene: Scene, sweep: MoveFollowers) -> Program:
    """Return the operations that make the moves of a scene's particles, in the order of a step."""
    return tuple(operation for operation in program_of(scene, sweep) if operation.makes_moves)


def hindrance(scene: Scene, mode: Mode) -> Hindrance | None:
    """Return the first reason for which the steps of a scene cannot be made in a mode; None where
    they can."""
    reasons = (operation.hindrance(mode) for operation in program_of(scene))
    return next(filter(None, reasons), None)


def reason_against(scene: Scene, mode: Mode) -> str:
    """Return that reason in words; empty where there is none."""
    found = hindrance(scene, mode)
    return found.reason if found else ""
