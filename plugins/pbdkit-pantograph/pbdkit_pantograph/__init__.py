"""Pantographic sheets for pbdkit: two families of fibres, connected by pivots where they cross."""

from pbdkit.plugin import Component, hookimpl
from pbdkit_pantograph.beams import PantographBeams
from pbdkit_pantograph.fibres import Fibres
from pbdkit_pantograph.springs import Pantograph

pbdkit_api = 1

__all__ = ["Fibres", "Pantograph", "PantographBeams"]


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """Return the components of this distribution."""
    return [Fibres, Pantograph, PantographBeams]
