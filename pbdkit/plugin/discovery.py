"""Loading of components from plugins, and checks of their classes. Errors in the functions of a
component are converted to messages that name the component and its distribution.

Components of earlier versions are mapped to their successors until version 1.0.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import (
    EntryPoint,
    distribution,
    entry_points,
)
from typing import Any

from pydantic import ValidationError

from pbdkit.errors import ExperimentError, PbdkitError, PluginError, one_line
from pbdkit.hooks import GROUP, Offer, Plugin, guarded, hook_answer, worded
from pbdkit.plugin import BUILTIN, INTERFACES, Component


def interface_of(component: type[Component]) -> type[Component]:
    """Return the interface that a component class implements."""
    return next(i for i in INTERFACES.values() if issubclass(component, i))


def full_description(component: type[Component]) -> str:
    """Return the interface, type and distribution of a component as a text.

    An example is ``FollowerRule 'odd' of pbdkit-odd 0.3``. The distribution is the one with an
    entry point that refers to the package of the component.
    """
    package, origin = component.__module__.split(".")[0], ""
    with suppress(Exception):  # metadata of other distributions can be damaged
        for point in entry_points(group=GROUP):
            if point.module.split(".")[0] == package != GROUP and point.dist:
                origin = f" of {point.dist.name} {point.dist.version}".rstrip()
    return f"{interface_of(component).__name__} '{component.type_name()}'{origin}"


def component_error(component: type[Component], when: str, error: BaseException) -> PluginError:
    """Return the PluginError for an error in the code of a component."""
    message = worded(error, component.__module__.split(".")[0], component)
    return PluginError(f"{full_description(component)} failed {when}: {message}")


@contextmanager
def errors_attributed_to(component: Component, when: str, *field: str | int) -> Iterator[None]:
    """Convert errors in the code of a component.

    An exception is converted to a PluginError that names the interface, type and distribution of
    the component. Two exceptions are not converted. An ExperimentError is raised again with the
    `field` of the component, if it is given. A KeyboardInterrupt is raised again with a message
    that names the component.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"in {full_description(type(component))} {when}") from None
    except ExperimentError as error:
        if not field:
            raise component_error(type(component), when, error) from error
        has_field = error.where[: len(field)] == field
        raise ExperimentError(
            str(error), error.where if has_field else (*field, *error.where)
        ) from None
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except (Exception, SystemExit) as error:
        raise component_error(type(component), when, error) from error


TYPE = r"[A-Za-z0-9][A-Za-z0-9._-]*"
"""Pattern of the type of a component."""
REFUSALS = ("missing", "value_error", "assertion_error")
"""Types of pydantic errors that do not concern defaults.

A parameter is missing, or rejected by a validator of the component.
"""


@cache
def load_builtin() -> Plugin:
    """Load the built-in components by their entry point, without other plugins.

    The built-in components are not checked here, because the tests of pbdkit check them.
    """
    source = distribution(GROUP)
    (entry,) = source.entry_points.select(group=GROUP)
    return Plugin(entry.name, GROUP, source.version, entry, tuple(map(offer_of, _offered(entry))))


def loaded(plugin: Plugin) -> Plugin:
    """Import a plugin and call its hook `pbdkit_components`.

    An error is not raised but stored as the state of the plugin, with a reason. Disabled plugins
    are not imported. An unusable class does not affect the other classes of the plugin.
    """

    def load(entry: EntryPoint, package: str) -> Plugin:
        return replace(plugin, offers=tuple(_offer(c, package) for c in _offered(entry)))

    return guarded(plugin, load)


def offer_of(component: type[Component]) -> Offer:
    """Return the offer of a usable component class."""
    return Offer(component.type_name(), interface_of(component), component)


def _offered(entry: EntryPoint) -> list[Any]:
    answer = hook_answer(entry, "pbdkit_components", "component classes")
    return list({id(component): component for component in answer}.values())


def _offer(component: Any, package: str) -> Offer:
    try:
        return checked(component)
    except (Exception, SystemExit) as error:
        name, interface = "", None
        with suppress(Exception):
            interface, name = interface_of(component), str(component.type_name())
        return Offer(name, interface, reason=worded(error, package))


def checked(component: Any) -> Offer:
    """Return the offer of a component class if the class is usable.

    Raises
    ------
    TypeError
        If the class is not usable. The message contains the remedy.
    """
    if isinstance(component, Component):
        name = type(component).__name__
        raise TypeError(f"expected the class {name}, got an object of it; give {name}")
    interfaces = tuple(INTERFACES.values())
    if not (inspect.isclass(component) and issubclass(component, interfaces)):
        raise TypeError(f"{component!r} does not implement an interface of pbdkit")
    label, name = component.__name__, component.type_name()
    if not re.fullmatch(TYPE, name):
        raise TypeError(
            f"{label} has the type '{name}'; a type must begin with a letter or digit and contain "
            "only letters, digits, '.', '_' and '-'"
        )
    if missing := sorted(getattr(component, "__abstractmethods__", ())):
        forms = ", ".join(f"{name}{_arguments(component, name)}" for name in missing)
        raise TypeError(f"{label} does not define {forms}")
    _check_functions(component)
    try:
        component.model_json_schema()
    except Exception as error:
        why = f"cannot be described in a JSON Schema: {worded(error)}"
        raise TypeError(f"the parameters of {label} {why}") from None
    _check_defaults(component)
    return offer_of(component)


def _arguments(component: type[Component], name: str) -> str:
    """Return the arguments of a function of an interface in parentheses."""
    parameters = inspect.signature(getattr(component, name)).parameters
    return f"({', '.join(parameters)})"


FUNCTIONS = (types.FunctionType, staticmethod, classmethod)
"""Types of methods in the namespace of a class."""


def _check_functions(component: type[Component]) -> None:
    """Check that methods have the signature of the interface, and are static where declared so."""
    label, declarations = component.__name__, dict[str, tuple[type, Any]]()
    for base in reversed(component.__mro__):
        if base.__module__.startswith(f"{BUILTIN}.plugin.") and not issubclass(Component, base):
            declarations |= {name: (base, declared) for name, declared in vars(base).items()}
    for name, (base, declared) in declarations.items():
        function = inspect.getattr_static(component, name)
        if name.startswith("_") or not isinstance(declared, FUNCTIONS) or function is declared:
            continue
        specification = getattr(base, name)
        parameters = list(inspect.signature(specification).parameters)
        call = f"{name}({', '.join(parameters)})"
        if isinstance(declared, staticmethod) and not isinstance(function, staticmethod):
            text = f"write @staticmethod above it, without `self` in {call}"
            raise TypeError(f"{label}.{name} must be static: {text}")
        if isinstance(function, (staticmethod, classmethod)):
            parameters = [parameter for parameter in parameters if parameter != "self"]
        try:
            signature = inspect.signature(getattr(component, name))
        except (TypeError, ValueError):  # functions in C can lack a signature
            continue
        try:
            signature.bind(*parameters)
        except TypeError:
            raise TypeError(
                f"{label}.{name}{signature} has other arguments; declare {call}"
            ) from None


def _check_defaults(component: type[Component]) -> None:
    """Check that defaults have the declared types, because users cannot correct them."""
    try:
        component.model_validate({})
    except ValidationError as error:
        for fault in error.errors():
            if fault["loc"] and fault["type"] not in REFUSALS:
                raise TypeError(
                    f"the default of {component.__name__}.{fault['loc'][0]} is invalid: "
                    f"{one_line(fault['msg'])}, got {fault['input']!r}"
                ) from None
    except (Exception, SystemExit):  # errors of its code are reported where it is used
        return


@dataclass(frozen=True)
class Retired:
    """Built-in component that was removed.

    Parameters
    ----------
    field
        Field of the experiment.
    type
        Type of the component.
    successor
        Type of its successor.
    difference
        How results differ.
    renumbers
        Whether the numbers of the particles change if the successor is used.
    """

    field: str
    type: str
    successor: str
    difference: str
    renumbers: bool = False

    @property
    def advice(self) -> str:
        """Warning for experiments with this component."""
        return (
            f"'{self.type}' is retired, and is replaced by '{self.successor}' until version 1.0; "
            f"{self.difference}; write {self.field}: {{type: {self.successor}}}"
        )


RETIRED = (
    Retired(
        field="frame",
        type="traction-free",
        successor="natural",
        difference="the body then ends at its outermost particles, not half a spacing outside "
        "them, and has no frame points",
        renumbers=True,
    ),
)
"""Retired components with their successors."""


def retired_parts(parts: Mapping[str, Any]) -> list[Retired]:
    """Return the retired components in the parts of an experiment."""
    result = []
    for component in RETIRED:
        part = parts.get(component.field)
        name = part.get("type") if isinstance(part, Mapping) else None
        if name in (component.type, f"{GROUP}:{component.type}"):
            result.append(component)
    return result


def with_successors(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Replace retired components in the parts of an experiment by their successors."""
    successors = {
        component.field: {**parts[component.field], "type": component.successor}
        for component in retired_parts(parts)
    }
    return {**parts, **successors}


def refuse_retired(parts: Mapping[str, Any], what: str) -> None:
    """Raise ExperimentError if a scene cannot be built again because a component is retired.

    Parameters
    ----------
    parts
        Parts of the experiment.
    what
        What requires the scene, for the message.
    """
    for component in retired_parts(parts):
        field = component.field
        raise ExperimentError(
            f"{what} requires the scene of the run, but its {field} '{component.type}' is retired; "
            f"run the experiment again, with {field}: {{type: {component.successor}}}"
        )


def is_retired(interface: type | None, name: str) -> bool:
    """Return whether a type is the name of a retired component of an interface."""
    return any(name == part.type and INTERFACES[part.field] is interface for part in RETIRED)
