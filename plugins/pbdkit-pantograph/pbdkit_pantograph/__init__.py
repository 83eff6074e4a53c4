"""Pantographic sheets for pbdkit: two families of fibres, joined where they cross by pivots."""

import pbdkit
from pbdkit_pantograph.beams import PantographBeams
from pbdkit_pantograph.fibres import Fibres
from pbdkit_pantograph.springs import Pantograph

pbdkit_api = 1

__all__ = ["Fibres", "Pantograph", "PantographBeams"]


@pbdkit.hookimpl
def pbdkit_components() -> list[type[pbdkit.Component]]:
    """What this distribution offers."""
    return [Fibres, Pantograph, PantographBeams]
