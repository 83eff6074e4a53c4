"""Vectors, and the operations in which elementwise functions are written.

The functions of a rule are called with whole arrays, single numbers or probes, always one value a
component. They use + - * /, the functions of numpy, and `where` for choices.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterable
from typing import Any, Self

import numpy as np


class Components(tuple[Any, ...]):
    """A vector by components; each is a number or an array, all of one shape.

    Vectors add, subtract and are scaled as vectors are; with `+` no tuple is made longer.
    """

    __slots__ = ()
    __array_ufunc__ = None  # so that array * vector asks the vector

    @property
    def x(self) -> Any:
        """The component along the first axis."""
        return self[0]

    @property
    def y(self) -> Any:
        """The component along the second axis."""
        return self[1]

    def each(self, function: Callable[..., Any], *others: Iterable[Any]) -> Self:
        """The vector of function(component, ...), component by component."""
        return self._of([function(*parts) for parts in zip(self, *others, strict=True)])

    def _of(self, components: list[Any]) -> Self:
        return tuple.__new__(type(self), components)

    def __add__(self, other: Any) -> Self:
        return self._of([a + b for a, b in zip(self, other, strict=True)])

    def __sub__(self, other: Any) -> Self:
        return self._of([a - b for a, b in zip(self, other, strict=True)])

    def __neg__(self) -> Self:
        return self._of([-component for component in self])

    def __mul__(self, factor: Any) -> Self:
        return self._of([component * factor for component in self])

    def __rmul__(self, factor: Any) -> Self:
        return self._of([factor * component for component in self])

    def __truediv__(self, divisor: Any) -> Self:
        return self._of([component / divisor for component in self])


class Vector(namedtuple("Vector", ("x", "y")), Components):
    """A vector in the plane."""

    __slots__ = ()


class SpaceVector(namedtuple("SpaceVector", ("x", "y", "z")), Components):
    """A vector in space."""

    __slots__ = ()


KINDS: dict[int, type[Components]] = {2: Vector, 3: SpaceVector}
"""The kind of vector by its number of components."""


def vector(components: Iterable[Any]) -> Any:
    """The vector with these components; ValueError where there are neither two nor three."""
    values = tuple(components)
    if len(values) not in KINDS:
        raise ValueError(f"a vector has two or three components, not {len(values)}")
    return KINDS[len(values)](*values)


def where(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` where the condition holds, else `no`, elementwise; both numbers or both vectors.

    Elementwise functions choose with this and not with `numpy.where`: a compiled engine knows it.
    """
    if isinstance(yes, Components):
        return yes.each(lambda a, b: np.where(condition, a, b), no)
    return np.where(condition, yes, no)


def dot(a: Components, b: Components) -> Any:
    """a·b = a_x b_x + a_y b_y."""
    products = [one * other for one, other in zip(a, b, strict=True)]
    return sum(products[1:], products[0])


def squared_length(v: Components) -> Any:
    """v·v; the same to the last bit for v and -v."""
    return dot(v, v)


def length(v: Components) -> Any:
    """√(v·v)."""
    return np.sqrt(squared_length(v))
