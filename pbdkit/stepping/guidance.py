"""How guided particles follow along the axes along which they do not lead.

A rule's move is S⁻¹ · force for some 2 × 2 matrix S of the particle. Where that is held along some
axes l, and free along others f, the move along f that has no force there is

    m_f + S_ff⁻¹ S_fl m_l:

what the rule moves along l is what pushes at the guide. S is asked of calibrated rules; others are
taken at their word. On straight edges S_fl is zero, at corners and in cut cells it is not.
"""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.guides import Guided, guided_at, has_guides
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compliance import stiffnesses
from pbdkit.stepping.state import Floats

STRAIGHT = 1e-12
"""Shares below this are rounding."""
Slants = dict[tuple[int, int], tuple[Indices, Floats]]
"""By (free axis, led axis): at these flat places, the share of the move along the one that adds to
the move along the other."""


class Guidance:
    """The guided particles of a scene, step by step; what is known stays as long as roles do."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.some = has_guides(scene.leading)
        """Whether there are any."""
        self.slanted = self.some and material_of(scene.experiment.rule) is not None
        """Whether a move along one axis may add to that along another."""
        self._known: dict[tuple[bool, ...], tuple[Guided, Slants]] = {}

    def at(self, step: int) -> Guided:
        """Those of a step."""
        return self._at(step)[0]

    def slants(self, step: int) -> Slants:
        """Their shares, for every pair of axes."""
        return self._at(step)[1]

    def correct(self, new: Floats, u: Floats, step: int) -> None:
        """Adds, in place, to where the particles go from u."""
        if not self.slanted:
            return
        flat, here = new.reshape(len(new), -1), u.reshape(len(u), -1)
        for (to, of), (place, share) in self.slants(step).items():
            flat[to, place] = flat[to, place] + share * (flat[of, place] - here[of, place])

    def _at(self, step: int) -> tuple[Guided, Slants]:
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if roles not in self._known:
            guided = guided_at(self._scene.raster, self._scene.leading, step)
            self._known[roles] = guided, self._slants_of(guided)
        return self._known[roles]

    def _slants_of(self, guided: Guided) -> Slants:
        shares = self.shares(guided)
        found = {}
        for to, of in np.ndindex(shares.shape[1:]):
            some = np.flatnonzero(np.abs(shares[:, to, of]) > STRAIGHT)
            if to != of:
                found[to, of] = guided.place[some], shares[some, to, of].astype(self._real)
        return found

    def shares(self, guided: Guided) -> Floats:
        """(particle, free axis, led axis): S_ff⁻¹ S_fl, zero elsewhere."""
        axes = self._scene.axes
        shares = np.zeros((len(guided.place), axes, axes))
        if not self.slanted or not len(guided.place):
            return shares
        pulls = stiffnesses(self._scene, guided.place)
        for pattern in np.unique(guided.led, axis=1).T:
            some = np.flatnonzero((pattern == guided.led.T).all(axis=1))
            f, of = np.flatnonzero(~pattern), np.flatnonzero(pattern)
            own, across = (pulls[np.ix_(some, f, axis)] for axis in (f, of))
            shares[np.ix_(some, f, of)] = np.linalg.pinv(own) @ across
        return shares

    @property
    def _real(self) -> str:
        return self._scene.experiment.stepping.precision
