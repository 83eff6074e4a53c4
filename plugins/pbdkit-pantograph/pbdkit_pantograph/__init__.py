"""Pantographic sheets for pbdkit: two families of fibres, joined where they cross by pivots."""

from pbdkit.plugin import Component, hookimpl
from pbdkit_pantograph.beams import PantographBeams
from pbdkit_pantograph.fibres import Fibres
from pbdkit_pantograph.springs import Pantograph

pbdkit_api = 1

__all__ = ["Fibres", "Pantograph", "PantographBeams"]


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """What this distribution offers."""
    return [Fibres, Pantograph, PantographBeams]
