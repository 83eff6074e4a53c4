"""A component that fails is named: the user learns whose fault it is, not where it surfaced."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pbdkit.errors import ExperimentError, PbdkitError, PluginError
from pbdkit.interfaces import Component
from pbdkit.registry.registry import interface_of


def blame(component: Component, when: str, error: Exception) -> PluginError:
    """The error to raise where a component's own code has failed."""
    what = f"{interface_of(type(component)).__name__} '{component.type}' failed {when}"
    return PluginError(f"{what}: {type(error).__name__}: {error}")


@contextmanager
def blaming(component: Component, when: str, *field: str | int) -> Iterator[None]:
    """What a component's own code raises becomes a PluginError with its interface and type; what
    it refuses with an ExperimentError is about its `field` of the experiment."""
    try:
        yield
    except ExperimentError as error:
        raise ExperimentError(str(error), (*field, *error.where)) from None
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except Exception as error:
        raise blame(component, when, error) from error
