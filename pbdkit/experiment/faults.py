"""Turns what pydantic finds into one message: place, field, what is wrong, the nearest right."""

from __future__ import annotations

import re
from typing import Any

from pydantic import ValidationError

from pbdkit.errors import ExperimentError
from pbdkit.experiment.parts import brief
from pbdkit.experiment.source import Source
from pbdkit.interfaces.naming import did_you_mean

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
    found = error.errors(include_url=False)
    faults = [f for f in found if f["type"] != "too_short" or not _follows(f, found)]
    lines = [source.message(*_described(fault)) for fault in faults[:SHOWN]]
    if len(faults) > SHOWN:
        lines.append(f"... and {len(faults) - SHOWN} more")
    return ExperimentError("\n".join(lines), _described(faults[0])[0])


def located(error: ExperimentError, source: Source) -> ExperimentError:
    """The same error with the place of its field in front."""
    return ExperimentError(source.message(error.where, str(error)), error.where)


def _described(fault: Any) -> tuple[tuple[str | int, ...], str]:
    where, context = tuple(fault["loc"]), fault.get("ctx", {})
    if "text" in context:
        return (*where, context["key"]) if "key" in context else where, context["text"]
    if fault["type"] in PLAIN:
        return where, PLAIN[fault["type"]].format(got=brief(fault["input"]), **context)
    message = fault["msg"].removeprefix("Value error, ").replace("Input should", "should")
    if fault["type"] == "value_error":
        return where, message
    message = _LONG.sub(lambda number: f"{_bound(context):g}", message)
    hint = ""
    if (
        fault["type"] == "int_type"
        and isinstance(fault["input"], float)
        and fault["input"] % 1 == 0
    ):
        hint = f"; write {int(fault['input'])}"
    if fault["type"] == "literal_error" and isinstance(fault["input"], str):
        hint = did_you_mean(fault["input"], re.findall(r"'([^']*)'", context["expected"]))
    return where, f"{message}, got {brief(fault['input'])}{hint}"


def _bound(context: Any) -> float:
    return next(float(context[k]) for k in ("gt", "ge", "lt", "le") if k in context)


def _follows(fault: Any, found: list[Any]) -> bool:
    """Whether a list is too short only because its items are at fault themselves."""
    where = fault["loc"]
    return any(f["loc"][: len(where)] == where and f["loc"] != where for f in found)
