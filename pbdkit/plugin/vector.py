"""Vectors, and functions for elementwise code.

The components of the vectors that the functions of a rule receive are arrays or numbers. The
functions use + - * /, the functions of numpy, and `where` in place of conditions.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Self, TypeAlias, cast, overload

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeVar

Number: TypeAlias = float | NDArray[np.floating[Any]]
"""Value of an elementwise function: a number, or an array with a number for each particle or
bond."""
Condition: TypeAlias = bool | NDArray[np.bool_]
"""Result of a comparison of numbers or of arrays."""

T = TypeVar("T", covariant=True, default=Number)
V = TypeVar("V", bound="Vector[Any]")

if TYPE_CHECKING:

    class _Plane(tuple[T, ...]):
        @property
        def x(self) -> T: ...
        @property
        def y(self) -> T: ...
        def __new__(cls, x: T, y: T) -> Self: ...

    class _Space(tuple[T, ...]):
        @property
        def z(self) -> T: ...
        def __new__(cls, x: T, y: T, z: T) -> Self: ...

else:  # named tuples, which numba compiles
    _Plane = namedtuple("Vector", ("x", "y"))
    _Space = namedtuple("SpaceVector", ("x", "y", "z"))


class Vector(_Plane[T]):
    """A vector with components that are numbers or arrays of one shape.

    The operators + - * / are those of vectors and scalars: `+` adds components and does not
    concatenate.

    Parameters
    ----------
    x, y : float or array
        Components along the axes: numbers in a ``Vector[float]``, and numbers or arrays (`Number`)
        in the arguments of elementwise functions.

    Examples
    --------
    >>> 2.0 * Vector(1.0, 2.0) - Vector(0.5, 0.0)
    Vector(x=1.5, y=4.0)
    """

    __slots__ = ()
    __array_ufunc__ = None  # array * vector is then computed by the vector

    def each(self, function: Callable[..., Any], *vectors: Iterable[Any]) -> Self:
        """Return the vector with the components ``function(component, ...)``.

        Parameters
        ----------
        function : callable
            Function that receives the same component of each vector.
        *vectors : iterable
            Further vectors with as many components.

        Returns
        -------
        Vector
            Vector of the results.

        Examples
        --------
        >>> Vector(1.0, -2.0).each(abs)
        Vector(x=1.0, y=2.0)
        """
        return self._of([function(*parts) for parts in zip(self, *vectors, strict=True)])

    def _of(self, components: list[Any]) -> Self:
        return tuple.__new__(type(self), components)

    def __add__(self, other: Vector[Any]) -> Self:  # type: ignore[override]  # adds, as arrays do
        return self._of([a + b for a, b in zip(cast(Any, self), other, strict=True)])

    def __sub__(self, other: Vector[Any]) -> Self:
        return self._of([a - b for a, b in zip(cast(Any, self), other, strict=True)])

    def __neg__(self) -> Self:
        return self._of([-component for component in cast(Any, self)])

    def __mul__(self, factor: Number) -> Self:  # type: ignore[override]  # scales, as arrays do
        return self._of([component * factor for component in cast(Any, self)])

    def __rmul__(self, factor: Number) -> Self:  # type: ignore[override]  # scales, as arrays do
        return self._of([factor * component for component in cast(Any, self)])

    def __truediv__(self, divisor: Number) -> Self:
        return self._of([component / divisor for component in cast(Any, self)])


class SpaceVector(_Space[T], Vector[T]):
    """A vector in space, with a third component `z`.

    Parameters
    ----------
    x, y, z : float or array
        Components along the axes.
    """

    __slots__ = ()


KINDS: dict[int, type[Vector[Any]]] = {2: Vector, 3: SpaceVector}
"""Class of vectors by number of components."""


def vector(components: Iterable[Any]) -> Any:
    """Return the vector with two or three components.

    Raises
    ------
    ValueError
        For another number of components.
    """
    values = tuple(components)
    if len(values) not in KINDS:
        raise ValueError(f"a vector has two or three components, not {len(values)}")
    return KINDS[len(values)](*values)


@overload
def where(condition: Any, yes: V, no: V) -> V: ...
@overload
def where(condition: Any, yes: Number, no: Number) -> Number: ...
def where(condition: Any, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition holds, else `no`, elementwise.

    Elementwise functions use this function and not `numpy.where`, which kernels do not support for
    vectors.

    Parameters
    ----------
    condition : Condition
        Comparison.
    yes, no : Number or Vector
        Both numbers, or both vectors.

    Returns
    -------
    Number or Vector
        Value of the same kind as `yes` and `no`.

    Examples
    --------
    >>> where(1.0 > 2.0, Vector(1.0, 0.0), Vector(0.0, 1.0)).each(float)
    Vector(x=0.0, y=1.0)
    """
    if isinstance(yes, Vector):
        return yes._of([np.where(condition, *parts) for parts in zip(yes, no, strict=True)])
    return np.where(condition, yes, no)


def dot(a: Vector[T], b: Vector[T]) -> T:
    """Return a·b = a_x b_x + a_y b_y, elementwise.

    Parameters
    ----------
    a, b : Vector
        Vectors of one kind.

    Returns
    -------
    Number
        Scalar product.

    Examples
    --------
    >>> dot(Vector(1.0, 2.0), Vector(3.0, 4.0))
    11.0
    """
    products: list[Any] = [
        component * factor for component, factor in zip(a, cast(Any, b), strict=True)
    ]
    # No type is named here, because the kernel cache identifies functions by the objects to which
    # they refer.
    total: T = sum(products[1:], products[0])
    return total


def squared_length(v: Vector[T]) -> T:
    """Return v·v. The result for v and that for -v are equal to the last bit.

    Parameters
    ----------
    v : Vector
        Vector of numbers or arrays.

    Returns
    -------
    Number
        Square of the norm.
    """
    return dot(v, v)


def length(v: Vector[T]) -> T:
    """Return the norm √(v·v), elementwise.

    Parameters
    ----------
    v : Vector
        Vector of numbers or arrays.

    Returns
    -------
    Number
        Norm.

    Examples
    --------
    >>> float(length(Vector(3.0, 4.0)))
    5.0
    """
    square: Any = squared_length(v)
    root: T = np.sqrt(square)
    return root


class Numbers:
    """Named numbers that an elementwise function reads as attributes.

    The object that the function receives is a named tuple.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Number: ...


class Parameters(Numbers):
    """Parameters of a component, read as ``p.name``."""


class Weights(Numbers):
    """Constants of a slot that a rule declares, read as ``w.name``."""


class Constants(Numbers):
    """Constants of a slot and state variables of the bond, read as ``c.name``."""
