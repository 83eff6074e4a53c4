"""Validate the parts of an experiment with pydantic and word each error with place, field, cause
and the nearest valid value; read field files.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, reduce
from operator import or_
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BeforeValidator, ValidationError, ValidationInfo
from pydantic_core import PydanticCustomError

from pbdkit.errors import (
    ExperimentError,
    PbdkitError,
    PluginError,
    StorageError,
    did_you_mean,
    one_line,
)
from pbdkit.model.reading import Beside, Source, beside
from pbdkit.plugin import INTERFACES, Component
from pbdkit.plugin.discovery import blame
from pbdkit.plugin.fields import MOST_VALUES, Gridded, TakesFields
from pbdkit.plugin.registry import Registry
from pbdkit.plugin.schedule import FORMS, WORD
from pbdkit.plugin.units import TEXT
from pbdkit.untrusted_files import VALUES, read_apart

MOST_BYTES = 2**30
LONGEST_NAME = 200
"""Maximum number of characters in the name of a variable."""


class FieldFileError(ValueError):
    """A field file that is not there, cannot be read, or holds no field; the text names it."""


def read_field(given: dict[str, Any], files: Beside) -> Gridded:
    """Return what ``{file: NAME, variable: NAME}`` says, the file among those that may be named.

    Raises ValueError where the file or the variable is not there, or no numbers over x and y.
    """
    if given.keys() != {"file", "variable"}:
        raise ValueError(f"a field from a file has file and variable, got {', '.join(given)}")
    path, variable = files.path(given["file"], "netCDF"), given["variable"]
    if not isinstance(variable, str) or not variable.isprintable() or len(variable) > LONGEST_NAME:
        raise ValueError(f"variable should be the name of one in {path}")
    about = path.stat()
    if about.st_size > MOST_BYTES:
        raise ValueError(f"{path} is larger than 1 GiB")
    return _read(path, variable, about.st_size, about.st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: Path, variable: str, size: int, changed_ns: int) -> Gridded:
    """The field in a file of that size and time of change: members of a sweep read the same."""
    try:
        read = read_apart(path, variable, str(MOST_VALUES))
    except StorageError as error:
        raise FieldFileError(str(error)) from None
    try:
        with np.load(io.BytesIO(read)) as arrays:
            x, y, values = (_decoded(name, arrays) for name in ("x", "y", VALUES))
        return Gridded(x, y, values)
    except MemoryError:
        raise
    except Exception as error:  # attributes that make no sense, in words of other libraries
        raise FieldFileError(f"{path}: '{variable}': {one_line(str(error))}") from None


def _decoded(name: str, arrays: Any) -> Any:
    """The numbers of an array, unpacked and masked as its attributes demand."""
    from xarray import Variable
    from xarray.conventions import decode_cf_variable

    begin = f"{name}."
    keys = [key for key in arrays if key.startswith(begin)]
    attributes = {key.removeprefix(begin): arrays[key][()] for key in keys}
    if not attributes:
        return arrays[name]
    dims = [f"d{n}" for n in range(arrays[name].ndim)]
    stored = Variable(dims, arrays[name], attributes)
    return decode_cf_variable(name, stored, decode_times=False).values


SHOWN = 8
PLAIN = {
    "missing": "is missing",
    "tuple_type": "should be a list, got {got}",
    "too_long": "should have at most {max_length} items, got {actual_length}",
    "too_short": "should have at least {min_length} item(s), got {actual_length}",
    "model_type": "should be a map of keys, got {got}",
}
"""Where pydantic speaks of Python's types, the words of an experiment file."""
_LONG = re.compile(r"(?<=than )(?=[-\d.]{20})[-\d.]+|(?<=equal to )(?=[-\d.]{20})[-\d.]+")
"""A bound that pydantic writes out in full, as 1e-100."""


def report(error: ValidationError, source: Source) -> ExperimentError:
    """The error to raise instead: a line a fault, the first few of them."""
    found = [_plainly(fault) for fault in error.errors(include_url=False)]
    faults = [f for f in found if f["type"] != "too_short" or not _follows(f, found)]
    lines = [source.message(*_described(fault)) for fault in faults[:SHOWN]]
    if len(faults) > SHOWN:
        lines.append(f"... and {len(faults) - SHOWN} more")
    return ExperimentError("\n".join(lines), _described(faults[0])[0])


def _plainly(fault: Any) -> Any:
    """The fault without the names of forms, and with all that a word could also be."""
    where = tuple(word for word in fault["loc"] if word not in (*FORMS, "[key]"))
    said = {"msg": f"should be {WORD}"} if fault["loc"][-1:] == (WORD,) else {}
    return fault | {"loc": where} | said


def _described(fault: Any) -> tuple[tuple[str | int, ...], str]:
    where, context = tuple(fault["loc"]), fault.get("ctx", {})
    if "text" in context:
        key = context.get("key", ())
        return (*where, *(key if isinstance(key, tuple) else (key,))), context["text"]
    if fault["type"] in PLAIN:
        text = PLAIN[fault["type"]].format(got=brief(fault["input"]), **context)
        return where, text + _decimal_commas(fault)
    message = fault["msg"].removeprefix("Value error, ").replace("Input should", "should")
    if fault["type"] == "value_error":
        return where, message
    message = _LONG.sub(lambda number: f"{_bound(context):g}", message)
    hint, given = "", fault["input"]
    if fault["type"] == "int_type" and isinstance(given, float) and given % 1 == 0:
        hint = f"; write {int(given)}"
    if fault["type"] == "literal_error" and isinstance(given, str):
        hint = did_you_mean(given, re.findall(r"'([^']*)'", context["expected"]))
    if fault["type"] == "float_type" and isinstance(given, str) and TEXT.fullmatch(given):
        hint = "; this takes a plain number, and no unit"
    if fault["type"] in ("float_type", "int_type") and isinstance(given, str):
        hint = hint or _meant_number(given)
    return where, f"{message}, got {brief(given)}{hint}"


def _meant_number(text: str) -> str:
    """What to write in place of a text that is a number but for its way of writing."""
    number = text.strip().replace(",", ".", 1)
    share = number.endswith("%")
    with suppress(ValueError):
        value = float(number.rstrip("% ")) / (100.0 if share else 1.0)
        return f"; write {value:g}" + ", without quotes" * (not share and "," not in text)
    return ""


def _decimal_commas(fault: Any) -> str:
    """A hint where whole numbers are twice as many as can be: ``[0,01, 0,0]``."""
    given, most = fault["input"], fault.get("ctx", {}).get("max_length")
    if fault["type"] != "too_long" or not isinstance(given, (list, tuple)):
        return ""
    doubled = len(given) == 2 * most and all(type(value) is int for value in given)
    return "; decimals have a point and no comma, as in 0.01" if doubled else ""


def _bound(context: Any) -> float:
    return next(float(context[k]) for k in ("gt", "ge", "lt", "le") if k in context)


def _follows(fault: Any, found: list[Any]) -> bool:
    """Whether a list is too short only because its items are at fault themselves."""
    where = fault["loc"]
    return any(f["loc"][: len(where)] == where and f["loc"] != where for f in found)


LONGEST_TYPE = 200
Finder = Callable[[str], type[Component]]


def open_part(interface: type[Component]) -> BeforeValidator:
    """The part is a component of an open interface, found in the registry.

    The registry comes in the validation context, so that components handed over in Python count.
    """

    def build(value: Any, info: ValidationInfo) -> Any:
        registry: Registry = (info.context or {}).get("registry") or Registry()
        part = _build(value, interface, lambda name: registry.find(interface, name), info)
        try:
            part.model_dump_json()
        except (Exception, SystemExit) as error:
            when = "when written as JSON, as datasets keep it"
            raise _blame(type(part), when, error, info) from error
        return part

    return BeforeValidator(build)


def closed_part(base: type[Component], *members: type[Component]) -> BeforeValidator:
    """The part is one of a fixed list of classes, told apart by `type`."""
    by_name = {member.type_name(): member for member in members}

    def find(name: str) -> type[Component]:
        if name not in by_name:
            hint = did_you_mean(name, by_name)
            raise ExperimentError(f"unknown type '{name}'{hint} (known: {', '.join(by_name)})")
        return by_name[name]

    return BeforeValidator(
        lambda value, info: _build(value, base, find, info),
        json_schema_input_type=reduce(or_, members),
    )


def _build(value: Any, base: type[Component], find: Finder, info: ValidationInfo) -> Any:
    if isinstance(value, base):
        return value
    if not isinstance(value, dict):
        raise fault(f"expected {{type: ..., its parameters}}, got {brief(value)}")
    name = value.get("type")
    if name is None:
        raise fault("`type` is missing")
    if not isinstance(name, str):
        raise fault(f"expected a word, got {brief(name)}", key="type")
    if len(name) > LONGEST_TYPE:
        raise fault(f"unknown type {brief(name)}", key="type")
    try:
        part = find(name)
    except ExperimentError as error:
        raise fault(str(error), key="type") from None
    except PluginError as error:
        raise PluginError(str(error), (info.field_name or "", "type")) from None
    parameters = {k: v for k, v in value.items() if k != "type"}
    if issubclass(part, TakesFields):
        parameters |= _from_files(parameters, part, info)
    try:
        return part.model_validate(parameters, context=info.context)
    except (ValidationError, PbdkitError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        if not issubclass(part, tuple(INTERFACES.values())):
            raise
        raise _blame(part, "when given its parameters", error, info) from error


def _from_files(
    parameters: dict[str, Any], part: type[TakesFields], info: ValidationInfo
) -> dict[str, Any]:
    """The fields that stand in files, read."""
    found = {}
    for name in part.numbers() & parameters.keys():
        given = parameters[name]
        if isinstance(given, dict) and "file" in given:
            try:
                found[name] = read_field(given, beside(info))
            except ValueError as error:
                raise fault(str(error), key=name) from None
    return found


def _blame(
    part: type[Component], when: str, error: BaseException, info: ValidationInfo
) -> PluginError:
    return PluginError(str(blame(part, when, error)), (info.field_name or "",))


def fault(text: str, **where: Any) -> PydanticCustomError:
    """An error for pydantic to carry: `text` for the user, `key` where a key of it is meant."""
    return PydanticCustomError("fault", "{text}", {"text": text, **where})


def brief(value: Any) -> str:
    """The value as users wrote it, cut where it is long."""
    if isinstance(value, (dict, list, tuple)) and len(value) > 4:
        return f"a {'map' if isinstance(value, dict) else 'list'} of {len(value)}"
    if isinstance(value, int) and abs(value) > 10**20:
        return "a huge integer"
    if isinstance(value, str):
        value = value[:50]
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
