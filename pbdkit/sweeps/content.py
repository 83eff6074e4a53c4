"""What is kept of one run, as bytes: names and shapes as JSON, then the values as they are."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.results.layout import Column

LENGTH = 8
"""Bytes of the number that says how long the JSON is."""


class Variable(NamedTuple):
    """One variable of a run; `fixed` where it was known before the first step."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attributes: dict[str, Any]
    coordinate: bool
    fixed: bool


def variable_of(column: Column, values: NDArray[Any], fixed: bool) -> Variable:
    """The variable of a column of the dataset."""
    return Variable(column.dims, values, column.attributes, column.coordinate, fixed)


def packed(variables: dict[str, Variable]) -> bytes:
    """The bytes."""
    head, parts = {}, []
    for name, (dims, values, attributes, *marks) in variables.items():
        said = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in attributes.items()}
        head[name] = [dims, values.dtype.str, values.shape, said, *marks]
        parts.append(np.ascontiguousarray(values).tobytes())
    described = json.dumps(head).encode()
    return b"".join([len(described).to_bytes(LENGTH, "little"), described, *parts])


def unpacked(content: bytes) -> dict[str, Variable]:
    """What was packed; the values are views of the bytes."""
    begin = LENGTH + int.from_bytes(content[:LENGTH], "little")
    found = {}
    for name, entry in json.loads(content[LENGTH:begin]).items():
        dims, dtype, shape, attributes, coordinate, fixed = entry
        count, kind = int(np.prod(shape, dtype=np.int64)), np.dtype(dtype)
        values = np.frombuffer(content, kind, count, begin) if count else np.zeros(0, kind)
        begin += count * kind.itemsize
        flags = {k: np.array(v, kind) if isinstance(v, list) else v for k, v in attributes.items()}
        found[name] = Variable(tuple(dims), values.reshape(shape), flags, coordinate, fixed)
    return found
