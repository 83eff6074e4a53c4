"""What parts remember, as it goes into the dataset."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.interfaces import RenewsBonds, RenewsParticles
from pbdkit.results.layout import Column, remembered_column
from pbdkit.results.moment import StateMoment
from pbdkit.scene.remembering import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene


class RememberedColumns:
    """The recorded numbers of a scene's fracture model and rule."""

    def __init__(self, scene: Scene) -> None:
        fracture, rule = scene.experiment.fracture, scene.experiment.rule
        renews_bonds, renews_own = (
            isinstance(fracture, RenewsBonds),
            isinstance(rule, RenewsParticles),
        )
        every = [
            *((n, "bond", renews_bonds) for n in bond_numbers(scene.experiment)),
            *((n, "particle", renews_own) for n in particle_numbers(scene.experiment)),
        ]
        self.columns = [remembered_column(*entry) for entry in every if entry[0].recorded]

    def checked(self, taken: set[str]) -> list[Column]:
        """The columns. Raises PluginError where one has a name that every dataset has."""
        for column in self.columns:
            if column.name in taken:
                raise PluginError(
                    f"a part remembers '{column.name}' of each {column.dims[-1]}, and that name "
                    "is taken in the dataset; give it another"
                )
        return self.columns

    def once(self, start: StateMoment) -> dict[str, Any]:
        """Those that stay as they are at the start."""
        return dict(self._of(start, (c for c in self.columns if not c.grows)))

    def at(self, now: StateMoment) -> dict[str, Any]:
        """Those that change. Raises FloatingPointError where one is not finite."""
        values = dict(self._of(now, (c for c in self.columns if c.grows)))
        for name, value in values.items():
            if not np.isfinite(value).all():
                raise FloatingPointError(f"{name} at step {now.step}")
        return values

    @staticmethod
    def _of(moment: StateMoment, columns: Iterable[Column]) -> Iterator[tuple[str, Any]]:
        for column in columns:
            yield column.name, moment.remembered(column.name)
