"""A component that fails is named: the user learns whose fault it is, not where it surfaced."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pbdkit.errors import PbdkitError, PluginError
from pbdkit.interfaces import Component
from pbdkit.registry.registry import interface_of


@contextmanager
def blaming(component: Component, when: str) -> Iterator[None]:
    """Whatever a component's own code raises becomes a PluginError with its interface and type."""
    try:
        yield
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except Exception as error:
        what = f"{interface_of(type(component)).__name__} '{component.type}' failed {when}"
        raise PluginError(f"{what}: {type(error).__name__}: {error}") from error
