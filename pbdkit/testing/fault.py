"""How a property says that it does not hold, or has nothing to say."""

from __future__ import annotations


class PropertyError(Exception):
    """A property does not hold; the text names the fault, and the remedy where there is one."""


class NotAskedError(Exception):
    """A property says nothing about this component; the text is the reason."""
