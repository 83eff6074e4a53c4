"""Whether a class can be used as a component, and what to mend where it cannot."""

from __future__ import annotations

import inspect
import re
from typing import Any

from pydantic import ValidationError

from pbdkit.interfaces import INTERFACES, Component
from pbdkit.registry.wording import one_line, worded

TYPE = r"[A-Za-z0-9][A-Za-z0-9._-]*"
REFUSALS = ("missing", "value_error", "assertion_error")
"""Kinds of pydantic's errors that are no fault of a default: a parameter is not given, or the
component's own validator refuses it."""


def interface_of(component: type[Component]) -> type[Component]:
    """The open interface that a component class implements."""
    return next(i for i in INTERFACES.values() if issubclass(component, i))


def check_component(component: Any) -> None:
    """Raises TypeError, with what to mend, unless this is a usable component class."""
    check_class(component)
    _check_functions(component)
    _check_parameters(component)
    _check_defaults(component)


def check_class(component: Any) -> None:
    """The part of `check_component` that costs nothing: an interface, a type, nothing abstract."""
    interfaces = tuple(INTERFACES.values())
    if isinstance(component, Component):
        name = type(component).__name__
        raise TypeError(f"an object of {name} is offered; offer the class {name} itself")
    if not (inspect.isclass(component) and issubclass(component, interfaces)):
        raise TypeError(f"{component!r} is no class of one of pbdkit's interfaces")
    name = component.type_name()
    if not re.fullmatch(TYPE, name):
        raise TypeError(
            f"{component.__name__} has the type '{name}': a type begins with a letter or digit and "
            "holds letters, digits, '.', '_' and '-' only"
        )
    if missing := ", ".join(sorted(getattr(component, "__abstractmethods__", ()))):
        raise TypeError(f"{component.__name__} lacks {missing}")


def _check_functions(component: type[Component]) -> None:
    """What the interface declares is called as the interface declares it."""
    interface = interface_of(component)
    for name, declared in vars(interface).items():
        if name.startswith("_") or not callable(getattr(interface, name)):
            continue
        own = inspect.getattr_static(component, name)
        if isinstance(declared, staticmethod) and not isinstance(own, staticmethod):
            raise TypeError(
                f"{component.__name__}.{name} must be static: write @staticmethod above it, "
                f"and no `self` in {_signature(interface, name)}"
            )
        _check_signature(component, name, interface)


def _check_signature(component: type[Component], name: str, interface: type[Component]) -> None:
    expected = list(inspect.signature(getattr(interface, name)).parameters)
    if isinstance(inspect.getattr_static(component, name), (staticmethod, classmethod)):
        expected = [parameter for parameter in expected if parameter != "self"]
    try:
        own = inspect.signature(getattr(component, name))
    except (TypeError, ValueError):  # a function in C does not always tell
        return
    try:
        own.bind(*expected)
    except TypeError:
        raise TypeError(
            f"{component.__name__}.{name}{own} is called as {_signature(interface, name)}"
        ) from None


def _signature(interface: type[Component], name: str) -> str:
    names = inspect.signature(getattr(interface, name)).parameters
    return f"{name}({', '.join(names)})"


def _check_parameters(component: type[Component]) -> None:
    """They can be described and written: schemas and datasets need them."""
    try:
        component.model_json_schema()
    except Exception as error:
        raise TypeError(
            f"the parameters of {component.__name__} cannot be described in a JSON Schema: "
            f"{worded(error)}"
        ) from None


def _check_defaults(component: type[Component]) -> None:
    """They are of the types that the parameters declare: the user could not mend them."""
    try:
        component.model_validate({})
    except ValidationError as error:
        for fault in error.errors():
            if fault["loc"] and fault["type"] not in REFUSALS:
                raise TypeError(
                    f"the default of {component.__name__}.{fault['loc'][0]} does not fit: "
                    f"{one_line(fault['msg'])}, got {fault['input']!r}"
                ) from None
    except (Exception, SystemExit):  # what its own code raises is said where it is used
        return
