"""A component that fails is named: the user learns whose fault it is, not where it surfaced."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import PureWindowsPath

from pbdkit.errors import ExperimentError, PbdkitError, PluginError, did_you_mean
from pbdkit.interfaces import INTERFACES, Component
from pbdkit.interfaces.component import AnswerError
from pbdkit.registry import GROUP

LONGEST = 400
NUMBERS = {"Parameters": "p", "Weights": "w", "Constants": "c", "Own": "here.own"}
"""What authors call the tuples of numbers that their functions are given."""
NO_REFERENCE = (
    "`here.X` and `here.centred` are given to rules that declare "
    "`uses_reference: ClassVar[bool] = True`"
)


def interface_of(component: type[Component]) -> type[Component]:
    """The open interface that a component class implements."""
    return next(i for i in INTERFACES.values() if issubclass(component, i))


def whose(component: type[Component]) -> str:
    """``FollowerRule 'odd' of pbdkit-odd 0.3``, where a distribution's entry point leads to its
    package."""
    package, origin = component.__module__.split(".")[0], ""
    with suppress(Exception):  # metadata of others can be torn
        for point in entry_points(group=GROUP):
            if point.module.split(".")[0] == package != GROUP and point.dist:
                origin = f" of {point.dist.name} {point.dist.version}".rstrip()
    return f"{interface_of(component).__name__} '{component.type_name()}'{origin}"


def blame(component: type[Component], when: str, error: BaseException) -> PluginError:
    """The error to raise where a component's own code has failed."""
    told = worded(error, component.__module__.split(".")[0], component)
    return PluginError(f"{whose(component)} failed {when}: {told}")


@contextmanager
def blaming(component: Component, when: str, *field: str | int) -> Iterator[None]:
    """What a component's own code raises becomes a PluginError with its interface, type and
    distribution; what it refuses with an ExperimentError is about its `field` of the experiment,
    where one is given. An interrupt says where it came."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"in {whose(type(component))} {when}") from None
    except ExperimentError as error:
        if not field:
            raise blame(type(component), when, error) from error
        named = error.where[: len(field)] == field
        raise ExperimentError(
            str(error), error.where if named else (*field, *error.where)
        ) from None
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except (Exception, SystemExit) as error:
        raise blame(type(component), when, error) from error


def worded(
    error: BaseException, package: str = "", component: type[Component] | None = None
) -> str:
    """Return ``Type: message`` of whatever foreign code raised, on one line, without control
    characters, cut where it is long; with `package`, the place in its code where the traceback has
    one, and with the `component` whose code it is a remedy that fits."""
    try:
        message = str(error)
    except Exception:  # a plugin's own error class can fail to say what it is
        message = "(its message cannot be had)"
    if isinstance(error, AnswerError):
        return one_line(message)
    told = f"{type(error).__name__}: {message}" if message else type(error).__name__
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if package and str(frame.f_globals.get("__name__")).split(".")[0] == package:
            # which takes the separators of every system
            place = f" ({PureWindowsPath(frame.f_code.co_filename).name}, line {line})"
    advice = ""
    with suppress(Exception):  # foreign errors and objects can fail to be looked at
        advice = remedy(error, component)
    return one_line(told) + advice + place


def remedy(error: BaseException, component: type[Component] | None = None) -> str:
    """Return what elementwise functions are to do instead, where the fault is a frequent one."""
    if isinstance(error, ValueError) and "truth value of an array" in str(error):
        return "; choose with `pbdkit.where` in the place of `if`, `and` and `or`"
    of_none = isinstance(error, AttributeError | TypeError) and "'NoneType'" in str(error)
    if of_none and not getattr(component, "uses_reference", True):
        return f"; {NO_REFERENCE}"
    if not isinstance(error, AttributeError):
        return ""
    name, kind = str(error.name), type(error.obj).__name__
    if kind in NUMBERS and component and name in component.model_fields:
        return (
            f"; `{NUMBERS[kind]}` holds numbers, and the parameter '{name}' is none: make numbers "
            "of it in `parameters` or `weights`"
        )
    known = [n for n in getattr(error.obj, "_fields", dir(error.obj)) if not n.startswith("_")]
    there = f"; `{NUMBERS[kind]}` holds {', '.join(known) or 'nothing'}" if kind in NUMBERS else ""
    return did_you_mean(name, known) or there


def one_line(text: str) -> str:
    """The words of the text, printable ones, cut where it is long."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= LONGEST else words[: LONGEST - 3] + "..."
