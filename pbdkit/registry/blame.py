"""A component that fails is named: the user learns whose fault it is, not where it surfaced."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pbdkit.errors import ExperimentError, PbdkitError, PluginError
from pbdkit.interfaces import Component
from pbdkit.registry.checking import interface_of
from pbdkit.registry.discovery import BUILTIN, installed_points
from pbdkit.registry.wording import worded


def blame(component: type[Component], when: str, error: BaseException) -> PluginError:
    """The error to raise where a component's own code has failed."""
    package = component.__module__.split(".")[0]
    return PluginError(f"{_whose(component)} failed {when}: {worded(error, package)}")


@contextmanager
def blaming(component: Component, when: str, *field: str | int) -> Iterator[None]:
    """What a component's own code raises becomes a PluginError with its interface, type and
    distribution; what it refuses with an ExperimentError is about its `field` of the experiment,
    where one is given. An interrupt says where it came."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"in {_whose(type(component))} {when}") from None
    except ExperimentError as error:
        if not field:
            raise blame(type(component), when, error) from error
        raise ExperimentError(str(error), (*field, *error.where)) from None
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except (Exception, SystemExit) as error:
        raise blame(type(component), when, error) from error


def _whose(component: type[Component]) -> str:
    package = component.__module__.split(".")[0]
    return f"{interface_of(component).__name__} '{component.type_name()}'{_origin(package)}"


def _origin(package: str) -> str:
    """`` of pbdkit-x 0.3``, where a distribution's entry point leads to that package."""
    if package != BUILTIN:
        for point in installed_points():
            if point.package == package:
                return f" of {point.distribution} {point.version}".rstrip()
    return ""
