"""Guided particles lead along some axes and follow along the others, as on rollers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.places import Mask, distinct
from pbdkit.scene.raster import FOLLOWER, LEADER, Raster


@dataclass(frozen=True)
class Guided:
    """The guided particles of a step by row and flat place, sorted by row; `led` (axis, particle)
    tells along which axes they lead: some, not all."""

    rows: Indices
    place: Indices
    led: Mask

    def is_led(self, raster: Raster) -> Mask:
        """(axis, flat place): the components that they lead; no others' are."""
        found = np.zeros((len(self.led), raster.kind.size), bool)
        found[:, self.place] = self.led
        return found


def has_guides(leading: Iterable[Leading]) -> bool:
    """Whether anybody may be guided."""
    return any(len(each.axes) < each.reference.shape[1] for each in leading)


def guided_at(raster: Raster, leading: Iterable[Leading], step: int) -> Guided:
    """Those of a step; groups on different axes of one particle go together."""
    now = [each for each in leading if each.group.leads(step)]
    axes = len(raster.lattice.cell().vectors)
    some = [each.rows for each in now if len(each.axes) < axes]
    rows = distinct(np.concatenate(some)) if some else np.empty(0, np.intp)
    led = np.zeros((axes, len(rows)), bool)
    for each in now if some else ():
        led[list(each.axes)] |= np.isin(rows, each.rows)
    free = ~led.all(axis=0)
    return Guided(rows[free], raster.place_of(rows[free]), led[:, free])


def kinds_of_places(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """The kinds of flat places with the roles of a step; who is guided counts as a follower."""
    kind = raster.kind.ravel().copy()
    every = tuple(leading)
    for each in every:
        if each.group.leads(step):
            kind[each.place] = LEADER
    if has_guides(every):
        kind[guided_at(raster, every, step).place] = FOLLOWER
    return kind
