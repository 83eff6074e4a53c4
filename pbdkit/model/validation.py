"""Validate the parts of an experiment with pydantic.

Spatially varying parameters are read from files. The message of an error contains the place, the
field, the cause and the nearest valid value.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
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
from pbdkit.model.csv_columns import columns_of
from pbdkit.model.reading import FileResolver, Source, file_resolver
from pbdkit.plugin import INTERFACES, Component
from pbdkit.plugin.discovery import component_error
from pbdkit.plugin.fields import MAX_VALUES, Gridded, TakesFields
from pbdkit.plugin.registry import Registry
from pbdkit.plugin.schedule import FORMS, WORD
from pbdkit.plugin.table import tables_of
from pbdkit.plugin.units import TEXT
from pbdkit.untrusted_files import VALUES, read_apart

MAX_BYTES = 2**30
"""Maximum size of a file of spatially varying parameters in bytes."""
MAX_NAME = 200
"""Maximum number of characters in the name of a variable."""


def read_columns(file: Any, info: ValidationInfo, names: Sequence[str]) -> list[list[float]]:
    """Return the rows of a CSV file, with numbers in the order of `names`.

    The path is relative to the experiment file.

    Raises
    ------
    PydanticCustomError
        If the file cannot be read. The error refers to the key `file` and contains the place and
        the remedy.
    """
    try:
        return columns_of(file_resolver(info).path(file, "CSV"), names)
    except OSError as error:
        raise fault(f"{file}: cannot be read: {error.strerror or error}", key="file") from None
    except ValueError as error:
        raise fault(str(error), key="file") from None


class FieldFileError(ValueError):
    """A file of a spatially varying parameter is missing, cannot be read, or has no such data."""


def read_field(value: dict[str, Any], files: FileResolver) -> Gridded:
    """Read a spatially varying parameter, ``{file: NAME, variable: NAME}``.

    Raises
    ------
    ValueError
        If the file or the variable does not exist, or is not a function of x and y.
    """
    if value.keys() != {"file", "variable"}:
        raise ValueError(
            f"a field from a file requires the keys file and variable, got {', '.join(value)}"
        )
    path, variable = files.path(value["file"], "netCDF"), value["variable"]
    if not isinstance(variable, str) or not variable.isprintable() or len(variable) > MAX_NAME:
        raise ValueError(f"variable should be the name of a variable in {path}")
    info = path.stat()
    if info.st_size > MAX_BYTES:
        raise ValueError(f"{path} is larger than 1 GiB; use a coarser grid")
    return _read(path, variable, info.st_size, info.st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: Path, variable: str, size: int, changed_ns: int) -> Gridded:
    """Read a file, given its size and its time of modification.

    The result is cached for members of a sweep.
    """
    try:
        content = read_apart(path, variable, str(MAX_VALUES))
    except StorageError as error:
        raise FieldFileError(str(error)) from None
    try:
        with np.load(io.BytesIO(content)) as arrays:
            x, y, values = (_decoded(name, arrays) for name in ("x", "y", VALUES))
        return Gridded(x, y, values)
    except MemoryError:
        raise
    except Exception as error:  # Libraries raise various errors for invalid attributes.
        raise FieldFileError(f"{path}: '{variable}': {one_line(str(error))}") from None


def _decoded(name: str, arrays: Any) -> Any:
    """Return an array after its attributes for packing and missing values have been applied."""
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


MAX_FAULTS = 8
"""Maximum number of errors in a message."""
PLAIN = {
    "missing": "is missing",
    "tuple_type": "should be a list, got {got}",
    "dict_type": "should be a map of keys, got {got}",
    "too_long": "should have at most {max_length} items, got {actual_length}",
    "too_short": "should have at least {min_length} item(s), got {actual_length}",
    "model_type": "should be a map of keys, got {got}",
}
"""Messages that use the terms of experiment files, by the type of a pydantic error."""
_LONG = re.compile(r"(?<=than )(?=[-\d.]{20})[-\d.]+|(?<=equal to )(?=[-\d.]{20})[-\d.]+")
"""Pattern of a bound with many digits, which pydantic writes without an exponent, for example
1e-100."""


def report(error: ValidationError, source: Source) -> ExperimentError:
    """Convert a pydantic error to an ExperimentError with one line for each of the first faults."""
    details = [_as_written(_plainly(f), source) for f in error.errors(include_url=False)]
    details = _as_points(details)
    faults = [f for f in details if not _follows(f, details)]
    lines = [source.message(*_described(fault)) for fault in faults[:MAX_FAULTS]]
    if len(faults) > MAX_FAULTS:
        lines.append(f"... and {len(faults) - MAX_FAULTS} more")
    return ExperimentError("\n".join(lines), _described(faults[0])[0])


def _plainly(fault: Any) -> Any:
    """Remove the names of union members from the path, and describe all forms of a value."""
    where = tuple(word for word in fault["loc"] if word not in (*FORMS, "[key]"))
    message = {"msg": f"should be {WORD}"} if fault["loc"][-1:] == (WORD,) else {}
    return fault | {"loc": where} | message


def _as_points(faults: list[Any]) -> list[Any]:
    """Return the faults with one fault in place of two if the coordinates of one point are given
    where a list of points is expected."""
    points = list[Any]()
    for fault in faults:
        *parent, n = fault["loc"] or ("",)
        both = [*points[-1:], fault]
        if (
            n == 1
            and both[0]["loc"] == (*parent, 0)
            and all(f["type"] == "tuple_type" for f in both)
            and all(isinstance(f["input"], (str, int, float)) for f in both)
        ):
            point = ", ".join(str(f["input"]) for f in both)
            message = f"should be a list of points, got [{point}]; write [[{point}]]"
            points[-1] = {"loc": tuple(parent), "type": "", "ctx": {"text": message}}
        else:
            points.append(fault)
    return points


def _as_written(fault: Any, source: Source) -> Any:
    """Return the fault with value and bound in the unit of the source, if the value was given with
    a unit and is beyond a bound."""
    bound, number = _bounds(fault.get("ctx", {})), fault["input"]
    value = source.data
    for key in fault["loc"]:
        try:
            value = value[key]
        except (TypeError, LookupError):
            return fault
    text = TEXT.fullmatch(value) if isinstance(value, str) else None
    if not (bound and text and fault["type"] in WRITTEN_BOUNDS):
        return fault
    scaled = [b * float(text[1]) / number if number else b for b in bound]
    message = WRITTEN_BOUNDS[fault["type"]].format(*scaled)
    unit = f" {text[2]}" if scaled[0] else ""
    return fault | {"msg": f"should be {message}{unit}", "input": value.strip(), "type": "bound"}


WRITTEN_BOUNDS = {
    "greater_than": "greater than {:.6g}",
    "greater_than_equal": "greater than or equal to {:.6g}",
    "less_than": "less than {:.6g}",
    "less_than_equal": "less than or equal to {:.6g}",
}
"""Conditions of bounds by the type of an error of pydantic."""


def _described(fault: Any) -> tuple[tuple[str | int, ...], str]:
    where, context = tuple(fault["loc"]), fault.get("ctx", {})
    if "text" in context:
        key = context.get("key", ())
        return (*where, *(key if isinstance(key, tuple) else (key,))), context["text"]
    if fault["type"] == "missing" and where and isinstance(where[-1], int):
        return where, f"is missing; the list needs {where[-1] + 1} entries"
    if context.get("actual_length", 0) is None:
        context |= {"actual_length": np.size(fault["input"])}
    if fault["type"] in PLAIN:
        text = PLAIN[fault["type"]].format(got=brief(fault["input"]), **context)
        return where, text + (_decimal_commas(fault) or _as_list(fault))
    message = fault["msg"].removeprefix("Value error, ").replace("Input should", "should")
    if fault["type"] == "value_error":
        return where, message
    message = _LONG.sub(lambda number: f"{_bound(context):g}", message)
    hint, value = "", fault["input"]
    if fault["type"] == "int_type" and isinstance(value, float) and value % 1 == 0:
        hint = f"; write {int(value)}"
    if fault["type"] == "literal_error" and isinstance(value, str):
        hint = did_you_mean(value, re.findall(r"'([^']*)'", context["expected"]))
    if fault["type"] == "float_type" and isinstance(value, str) and TEXT.fullmatch(value):
        hint = "; expected a plain number without a unit"
    if fault["type"] in ("float_type", "int_type") and isinstance(value, str):
        hint = hint or _meant_number(value)
    return where, f"{message}, got {brief(value)}{hint}"


def _as_list(fault: Any) -> str:
    """Return a hint if a value is given where a list is expected."""
    value = fault["input"]
    if fault["type"] == "dict_type" and isinstance(value, str):
        return f"; write {{{value}: ...}}"
    if fault["type"] != "tuple_type" or value is None:
        return ""
    if isinstance(value, dict):
        return "; write `- ` before each entry, also if there is one"
    return f"; write [{value:g}]" if isinstance(value, (int, float)) else f"; write [{value}]"


FRACTION = re.compile(r"\s*(\d+(?:\.\d*)?)\s*/\s*(\d+(?:\.\d*)?)\s*")
"""Pattern of a fraction."""


def _meant_number(text: str) -> str:
    """Return a hint if text is a number in another notation."""
    if (fraction := FRACTION.fullmatch(text)) and float(fraction[2]):
        return f"; write {float(fraction[1]) / float(fraction[2]):.12g}"
    number = text.strip().replace(",", ".", 1)
    share = number.endswith("%")
    with suppress(ValueError):
        value = float(number.rstrip("% ")) / (100.0 if share else 1.0)
        return f"; write {value:g}" + ", without quotes" * (not share and "," not in text)
    return ""


def _decimal_commas(fault: Any) -> str:
    """Return a hint if a list has integers in place of decimals, as in ``[0,01, 0.0]``."""
    items, maximum = fault["input"], fault.get("ctx", {}).get("max_length")
    if fault["type"] != "too_long" or not isinstance(items, (list, tuple)):
        return ""
    integers = sum(type(item) is int for item in items)
    is_split = integers >= 2 and (integers < len(items) or len(items) == 2 * maximum)
    return "; write decimals with a point instead of a comma, as in 0.01" if is_split else ""


def _bound(context: Any) -> float:
    return _bounds(context)[0]


def _bounds(context: Any) -> list[float]:
    """Return the bound that a value exceeds, as a list that is empty if there is none."""
    return [float(context[k]) for k in ("gt", "ge", "lt", "le") if k in context]


def _follows(fault: Any, faults: list[Any]) -> bool:
    """Return whether a fault is only a consequence of other faults.

    For example, a list is too short because some of its items are invalid, or a default is not
    available because a part on which it depends is invalid.
    """
    where = fault["loc"]
    if fault["type"] != "too_short":
        return bool(fault["type"] == "default_factory_not_called")
    return any(f["loc"][: len(where)] == where and f is not fault for f in faults)


MAX_TYPE = 200
"""Maximum number of characters in the name of a type."""
Finder = Callable[[str], type[Component]]
"""Type of a function from the name of a type to its class."""


def open_part(interface: type[Component]) -> BeforeValidator:
    """Validate a component of an interface that plugins can implement.

    Its class is found in the registry of the validation context, which includes components that
    were passed as Python objects.
    """

    def build(value: Any, info: ValidationInfo) -> Any:
        registry: Registry = (info.context or {}).get("registry") or Registry()
        part = _build(
            value,
            interface,
            lambda name: registry.find(interface, name),
            info,
            lambda: sorted(names[0] for names in registry.spellings(interface).values()),
        )
        try:
            part.model_dump_json()
        except (Exception, SystemExit) as error:
            when = "to be written as JSON for datasets"
            raise _component_error(type(part), when, error, info) from error
        return part

    return BeforeValidator(build)


def closed_part(base: type[Component], *members: type[Component]) -> BeforeValidator:
    """Validate an object that belongs to one of a fixed list of classes, selected by `type`."""
    by_name = {member.type_name(): member for member in members}

    def find(name: str) -> type[Component]:
        if name not in by_name:
            hint = did_you_mean(name, by_name)
            raise ExperimentError(f"unknown type '{name}'{hint} (known: {', '.join(by_name)})")
        return by_name[name]

    return BeforeValidator(
        lambda value, info: _build(value, base, find, info, lambda: by_name),
        json_schema_input_type=reduce(or_, members),
    )


def _build(
    value: Any,
    base: type[Component],
    find: Finder,
    info: ValidationInfo,
    types: Callable[[], Iterable[str]],
) -> Any:
    if isinstance(value, base):
        return value
    if not isinstance(value, dict):
        meant = isinstance(value, str) and value.isprintable() and len(value) <= MAX_TYPE
        hint = f"; write {{type: {value}}}" if meant else ""
        raise fault(f"expected {{type: ..., its parameters}}, got {brief(value)}{hint}")
    name = value.get("type")
    if name is None:
        raise fault(f"`type` is missing; it is one of {', '.join(types())}")
    if not isinstance(name, str):
        raise fault(f"expected a word, got {brief(name)}", key="type")
    if len(name) > MAX_TYPE:
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
    for key in tables_of(part) & parameters.keys():
        parameters[key] = _table(parameters[key], key, info)
    try:
        return part.model_validate(parameters, context=info.context)
    except (ValidationError, PbdkitError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        if not issubclass(part, tuple(INTERFACES.values())):
            raise
        raise _component_error(part, "to validate its parameters", error, info) from error


def _from_files(
    parameters: dict[str, Any], part: type[TakesFields], info: ValidationInfo
) -> dict[str, Any]:
    """Read the spatially varying parameters from their files."""
    result = {}
    for name in part.numbers() & parameters.keys():
        value = parameters[name]
        if isinstance(value, dict) and "file" in value:
            try:
                result[name] = read_field(value, file_resolver(info))
            except ValueError as error:
                raise fault(str(error), key=name) from None
    return result


TABLE = "a table from a file requires {file: NAME.csv, columns: [x, y]}, also units: [mm, MPa]; got"


def _table(value: Any, key: str, info: ValidationInfo) -> Any:
    """Read the points of a table from its file, if it has one."""
    if not isinstance(value, dict) or "file" not in value:
        return value
    columns, units = value.get("columns", ["x", "y"]), value.get("units")
    pairs = (columns, units) if units is not None else (columns,)
    texts = [isinstance(of, list) and len(of) == 2 and {*map(type, of)} <= {str} for of in pairs]
    if value.keys() - {"file", "columns", "units"} or not all(texts):
        raise fault(f"{TABLE} {brief(value)}", key=key)
    try:
        points = columns_of(file_resolver(info).path(value["file"], "CSV"), columns)
    except OSError as error:
        text = f"{value['file']}: cannot be read: {error.strerror or error}"
        raise fault(text, key=key) from None
    except ValueError as error:
        raise fault(str(error), key=key) from None
    if units is None:
        return points
    return [
        [x if unit == "1" else f"{x!r} {unit}" for x, unit in zip(point, units, strict=True)]
        for point in points
    ]


def _component_error(
    part: type[Component], when: str, error: BaseException, info: ValidationInfo
) -> PluginError:
    return PluginError(str(component_error(part, when, error)), (info.field_name or "",))


def fault(text: str, **where: Any) -> PydanticCustomError:
    """Return an error for pydantic with a text for the user.

    If a key of the value is wrong, the error contains this key.
    """
    return PydanticCustomError("fault", "{text}", {"text": text, **where})


def brief(value: Any) -> str:
    """Return the value as it is written in the file, shortened if it is long."""
    if isinstance(value, (dict, list, tuple)) and len(value) > 4:
        return f"a {'map' if isinstance(value, dict) else 'list'} of {len(value)}"
    if isinstance(value, int) and abs(value) > 10**20:
        return "a huge integer"
    if isinstance(value, str):
        value = value[:50]
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
