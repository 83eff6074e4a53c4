"""Finds the configuration at which no follower moves but against an obstacle."""

from __future__ import annotations

import math

import numpy as np

from pbdkit.equilibrium.certificate import UNKNOWN, Certificate, UnconvergedError, spacing_of
from pbdkit.equilibrium.contact_system import ContactSystem
from pbdkit.equilibrium.newton import CONTRACTION, UNSTABLE, Finder, Search
from pbdkit.equilibrium.system import IndefiniteError, one_thread
from pbdkit.stepping.state import Floats, State

MOST_SETS = 60
"""So often who is held by obstacles may change."""
LEAST_PART = 2.0**-6
"""Smallest part of a correction that is tried where the whole takes particles off obstacles that
hold them."""


def follow_contact(finder: Finder, state: State, moment: float) -> Certificate:
    """Moves the followers of `state`, in place, to an equilibrium nearby that is stable, with
    obstacles where they are at a moment.

    Raises ExperimentError where there is no unique one, UnconvergedError and StoppedError.
    """
    with one_thread():
        try:
            return _ContactSearch(finder, state, moment, state, "finding the contact").run()
        except IndefiniteError:
            raise UnconvergedError(UNSTABLE, UNKNOWN) from None


class _ContactSearch(Search):
    """By linearisations at each state it comes to, with those held who would enter an obstacle,
    until nobody else would. What nothing holds yet is led on by weak springs."""

    def run(self) -> Certificate:
        """Raises UnconvergedError where who is held goes on changing, where corrections do not
        become smaller once it stays, or where what they lead to is not stable."""
        held, size, went_loose = None, math.inf, False
        system = self._newest()
        for _ in range(MOST_SETS):
            loose = system.is_loose(self._left, self._rounding())
            if not loose and not self._finder.tolerance < self._distance() < math.inf:
                break
            same, held = held is not None and np.array_equal(held, system.held), system.held
            if loose:
                went_loose = True
                correction = system.solve_loose(self._left, spacing_of(self._finder.scene))
            else:
                correction = system.solve(self._left, self._wanted, None, self._rounding())
            before, size = size, float(np.abs(correction).max(initial=0.0))
            if same and not loose and not size <= CONTRACTION * before:
                break
            self._go(correction)
            part, system = 1.0, self._newest()
            while not loose and part > LEAST_PART and system.is_loose(self._left, self._rounding()):
                part /= 2.0  # farther on what was held would come off again
                self._go(-part * correction)
                system = self._newest()
        if went_loose:
            system.refuse_floats()
        # What is held stands on its outline, as after a step, and not beside it by what is left.
        self._shift(system.of_held(self._left))
        certificate = self._certified()
        if not system.is_stable():
            raise UnconvergedError(UNSTABLE, certificate)
        return certificate

    def _go(self, correction: Floats) -> None:
        system = self._newest()
        self._shift(correction)
        self._shift(system.of_held(self._left))
        self._system = self._linearised(self._state, "finding the contact")

    def _newest(self) -> ContactSystem:
        assert isinstance(self._system, ContactSystem)
        return self._system
