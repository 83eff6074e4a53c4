"""What is asked of fracture models, of frame policies and of diagnostics alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import (
    BreaksAtStrain,
    CellStress,
    Diagnostic,
    FractureModel,
    FrameMap,
    FramePolicy,
    RenewsBonds,
)
from pbdkit.scene.declarations import bond_numbers
from pbdkit.scene.frame_points import sites_of_frame
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.testing.properties.elementwise import ROUNDING
from pbdkit.testing.states import (
    SHAPE,
    Shown,
    differences,
    frame_showing,
    moment_of,
    remembers,
    stressed,
)
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of, place_of

CLOSE = 1e-9
"""How near to its breaking strain a bond is tried, as a share of its length."""


@asked_of(FractureModel, is_needed=True)
def is_seen_alike_from_both_ends(subject: Subject) -> None:
    """A bond breaks for both ends or for none: `breaks` and `update` answer the same for (-d, -r)
    as for (d, r), and `constants` for a slot and its opposite; they are called for one end only."""
    model, scene = subject.component, subject.scene
    for plane in scene.neighbourhood.planes:
        here, there = model.constants(plane.slot), model.constants(plane.opposite)
        if here != there:
            fault = f"{here} for the slot {plane.slot.site} and {there} for its opposite"
            raise PropertyError(f"`constants` are {fault}: take lengths and shells, not directions")
    evaluator, own = Evaluator(scene), remembers(model, scene, 0)
    cells = tuple(CellStress(*cell) for cell in stressed(model, 0))
    sides = _from_the_other_end([number.name for number in bond_numbers(scene.experiment)])
    theirs = tuple(own[n] for n in sides)
    asks: dict[str, list[tuple[CellStress, ...]]] = {"breaks": []}
    if isinstance(model, RenewsBonds):
        asks["update"] = [cells] if cells else []
    tried = differences(scene, 0, share=2.0)
    for slot, d in zip(scene.neighbourhood.slots[0], tried, strict=True):
        limits = scene.constants.limits[slot]
        for what, beside in asks.items():
            ask = getattr(evaluator, what)
            one = ask(d, slot.rest, limits, own, *beside)
            other = ask(-d, -slot.rest, limits, theirs, *(cells[::-1] for cells in beside))
            if beside:
                other = tuple(other[n] for n in sides)
            if not np.array_equal(np.asarray(one), np.asarray(other)):
                along = f"for (-d, -r) than for (d, r) along {slot.site}"
                raise PropertyError(f"`{what}` answers otherwise {along}")


def _from_the_other_end(names: list[str]) -> list[int]:
    """The place of each number that is seen from the other end of a bond: left for right."""
    turned = {"_left": "_right", "_right": "_left"}
    swapped = [
        next((n.removesuffix(a) + b for a, b in turned.items() if n.endswith(a)), n) for n in names
    ]
    return [names.index(n) for n in swapped]


@asked_of(FractureModel)
def breaks_as_declared(subject: Subject) -> None:
    """Where it declares `can_break = False` nothing breaks, however long: the scene then has no
    bond state."""
    scene = subject.scene
    if subject.component.can_break:
        return
    slots, breaks = scene.neighbourhood.slots[0], Evaluator(scene).breaks
    for slot, d in zip(slots, differences(scene, 0, share=1e3), strict=True):
        if np.any(breaks(d, slot.rest, scene.constants.limits[slot], ())):
            raise PropertyError("it declares `can_break = False`, and `breaks` says yes")


@asked_of(FractureModel)
def breaks_beyond_its_strain(subject: Subject) -> None:
    """Where it tells a `breaking_strain`, a bond that is drawn out along itself breaks a little
    above it and, if it has not broken, not a little below: `pbdkit explain` tells users so."""
    model, scene = subject.component, subject.scene
    if not isinstance(subject.component, BreaksAtStrain):
        raise NotAskedError("it tells no `breaking_strain`")
    evaluator, own, p = Evaluator(scene), remembers(model, scene, 0), scene.constants.fracture
    for slot in scene.neighbourhood.slots[0]:
        r, limits = slot.rest, scene.constants.limits[slot]
        told = model.breaking_strain(r, scene.constants.of_bond(*limits, *own), p)
        limit = np.broadcast_to(told, SHAPE)
        for side, expected in ((CLOSE, True), (-CLOSE, False)):
            stretch = limit + side * (1.0 + np.abs(limit))
            d, now = r * stretch, [np.array(value) for value in own]
            evaluator.renew_bonds(d, r, limits, now, np.ones(SHAPE, bool))
            wrong = np.broadcast_to(evaluator.breaks(d, r, limits, now), SHAPE) != expected
            if wrong.any():
                where = f"at strain {stretch[wrong][0]:.6g} along {slot.site} the bond"
                fault = f"{where} {'stays' if expected else 'breaks'}"
                raise PropertyError(f"`breaking_strain` and `breaks` disagree: {fault}")


@asked_of(FramePolicy)
def takes_every_point_alone(subject: Subject) -> None:
    """Whom a frame point follows does not depend on which other points there are."""
    policy, reason = subject.component, "it has no points"
    for scene in subject.scenes:
        frame = sites_of_frame(scene.raster, scene.experiment.rule)
        if frame is None:
            continue
        point, body = frame.nearest()
        whole = policy.follow(frame_showing(frame, frame.site, point, body))
        for some in (np.arange(0, len(frame.site), 2), np.array([len(frame.site) - 1])):
            kept = np.isin(point, some)
            anew = np.searchsorted(some, point[kept])
            try:
                part = policy.follow(frame_showing(frame, frame.site[some], anew, body[kept]))
            except ExperimentError as refusal:
                reason = reason and f"it takes whole frames only: {refusal}"
                continue
            reason = ""
            for n, one in enumerate(some):
                if _followed(part, n) != _followed(whole, int(one)):
                    fault = "follows somebody else where fewer points are asked about"
                    raise PropertyError(f"frame point {one} {fault} ({place_of(scene.experiment)})")
    if reason:
        raise NotAskedError(reason)


@asked_of(FramePolicy)
def follows_who_is_near(subject: Subject) -> None:
    """Where it declares itself `local`, points follow particles that are nearest to them, or no
    farther off than twice the layers in site index."""
    policy = subject.component
    if not policy.local:
        raise NotAskedError("it does not declare itself `local`")
    for scene in subject.scenes:
        raster = scene.raster
        frame = sites_of_frame(raster, scene.experiment.rule)
        if frame is None:
            continue
        follow, layers = policy.follow(frame), policy.depth(scene.neighbourhood.reach)
        way = np.abs(raster.site_of(follow.body) - frame.site[follow.point]).max(axis=1)
        nearest = {*zip(*(each.tolist() for each in frame.nearest()), strict=True)}
        for entry in np.flatnonzero(way > 2 * layers).tolist():
            point, body = int(follow.point[entry]), int(follow.body[entry])
            if (point, body) not in nearest:
                raise PropertyError(
                    f"frame point {point} follows a particle {way[entry]} sites away, beside "
                    f"{layers} layers ({place_of(scene.experiment)}): leave out `local`"
                )


def _followed(follow: FrameMap, point: int) -> tuple[list[int], list[Any]]:
    """The body particles that a point follows, and their weights."""
    entries = follow.point == point
    return follow.body[entries].tolist(), follow.weight[entries].tolist()


@asked_of(Diagnostic, is_needed=True)
def measures_what_it_declares(subject: Subject) -> None:
    """`measure` returns one array for each of its variables, shaped as their `dims` say, of numbers
    that go into the declared dtype without loss of kind."""
    diagnostic, scene, own = subject.component, subject.scene, subject.component.own_dimension
    sizes = {"particle": scene.raster.count, "axis": 2, "leader_group": len(scene.leading)}
    sizes |= {"load": len(scene.experiment.loads)}
    sizes |= {"obstacle": len(scene.barriers), "principal": 2}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    variables = diagnostic.variables()
    measured = [np.asarray(value) for value in diagnostic.measure(moment_of(scene, 0))]
    if len(variables) != len(measured):
        raise PropertyError(f"{len(measured)} arrays for {len(variables)} variables")
    if own and not diagnostic.at_end:
        remedy = "has a length only where it declares `at_end` too"
        raise PropertyError(f"its `own_dimension` '{own}' {remedy}")
    for variable, value in zip(variables, measured, strict=True):
        if own in variable.dims and value.ndim == len(variable.dims):
            sizes.setdefault(own, value.shape[variable.dims.index(own)])  # as the first has it
    for variable, value in zip(variables, measured, strict=True):
        for dim in variable.dims:
            if dim not in sizes:
                what = f"the dimension '{dim}', which `coordinates` does not give"
                raise PropertyError(f"'{variable.name}' has {what}")
        shape = tuple(sizes[dim] for dim in variable.dims)
        if value.shape != shape:
            raise PropertyError(f"'{variable.name}' has the shape {value.shape}, not {shape}")
        if not np.can_cast(value.dtype, variable.dtype, "same_kind"):
            fault = f"is declared as {variable.dtype} and measured as {value.dtype}"
            raise PropertyError(f"'{variable.name}' {fault}: digits would be lost without a word")


@asked_of(Diagnostic)
def takes_rows_in_any_order(subject: Subject) -> None:
    """Particles in another order have the same values in that order, and all else stays, to
    rounding: rows are found by `now.rows(numbers)` and mean nothing else."""
    diagnostic, scene = subject.component, subject.scene
    moment, order = moment_of(scene, 0), np.random.default_rng(0).permutation(scene.raster.count)
    values, seen = diagnostic.measure(moment), diagnostic.measure(Shown(moment, order))
    for variable, one, other in zip(diagnostic.variables(), values, seen, strict=True):
        expected = np.asarray(one)
        for axis, dim in enumerate(variable.dims):
            expected = np.take(expected, order, axis) if dim == "particle" else expected
        size = float(np.nanmax(np.abs(expected), initial=1e-300))
        if not np.allclose(other, expected, rtol=0.0, atol=ROUNDING * size, equal_nan=True):
            remedy = "ask `now.rows(numbers)` for particles by number"
            raise PropertyError(f"'{variable.name}' depends on the order of the rows: {remedy}")
