"""Plain data with arrays as JSON and bytes, and back: no object is ever made that was not asked
for."""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Data = TypeVar("Data")
KINDS = "biuf"
"""Arrays of truth values, whole numbers and numbers: nothing that Python would have to make."""


def packed(data: Any) -> tuple[str, list[NDArray[Any]]]:
    """A dataclass whose fields are numbers, text, None, arrays, tuples, or such dataclasses, as JSON
    and the arrays that it counts off."""
    arrays: list[NDArray[Any]] = []

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays.append(np.ascontiguousarray(value))
            return {"array": len(arrays) - 1, "dtype": value.dtype.str, "shape": value.shape}
        if dataclasses.is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if isinstance(value, tuple):
            return [plain(each) for each in value]
        if isinstance(value, float):
            return {"float": value.hex()}
        return value

    return json.dumps(plain(data)), arrays


def unpacked(kind: type[Data], text: str, content: bytes) -> Data:
    """The dataclass again, from JSON and the bytes of its arrays one after the other. Raises
    ValueError where they do not fit."""
    try:
        tree = json.loads(text)
        arrays = list(_arrays(tree, memoryview(content)))
        made: Data = _made(kind, tree, iter(arrays))
    except (KeyError, TypeError, AttributeError, StopIteration, RecursionError) as error:
        raise ValueError(f"is no {kind.__name__}: {error}") from None
    return made


def _arrays(tree: Any, content: memoryview) -> Iterator[NDArray[Any]]:
    place = 0
    for described in _leaves(tree):
        dtype, shape = np.dtype(described["dtype"]), tuple(described["shape"])
        if dtype.kind not in KINDS or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError("holds an array that pbdkit does not write")
        size = math.prod(shape) * dtype.itemsize
        part = content[place : place + size]
        if len(part) != size:
            raise ValueError("is cut short")
        yield np.frombuffer(part, dtype).reshape(shape).copy()
        place += size


def _leaves(tree: Any) -> Iterator[dict[str, Any]]:
    """The descriptions of arrays, in their order."""
    if isinstance(tree, dict) and "array" in tree:
        yield tree
    elif isinstance(tree, dict | list):
        for each in tree.values() if isinstance(tree, dict) else tree:
            yield from _leaves(each)


def _made(kind: Any, tree: Any, arrays: Iterator[NDArray[Any]]) -> Any:
    """What a field of that type holds."""
    if isinstance(tree, dict) and "array" in tree:
        return next(arrays)
    if isinstance(tree, dict) and "float" in tree:
        return float.fromhex(tree["float"])
    if tree is None:
        return None
    kind = _without_none(kind)
    if isinstance(tree, list):
        return tuple(_made(_of_items(kind), each, arrays) for each in tree)
    if isinstance(tree, dict):
        types_ = typing.get_type_hints(kind)
        return kind(**{name: _made(types_[name], tree[name], arrays) for name in tree})
    return tree


def _without_none(kind: Any) -> Any:
    """X of `X | None`."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return next(each for each in typing.get_args(kind) if each is not types.NoneType)
    return kind


def _of_items(kind: Any) -> Any:
    """X of `tuple[X, ...]`."""
    return (*typing.get_args(kind), Any)[0]
