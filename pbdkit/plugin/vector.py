"""Vectors, and functions for elementwise code.

The components of the vectors that the functions of a rule receive are arrays or numbers. The
functions use + - * /, the functions of numpy, and `where` in place of conditions.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, Self, TypeAlias, overload

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
        values = [function(*parts) for parts in zip(self, *vectors, strict=True)]
        return tuple.__new__(type(self), values)

    # The operators call no further Python function, because steps on small lattices consist mainly
    # of calls.

    def __add__(self, other: Vector[Any]) -> Self:  # type: ignore[override]  # adds, as arrays do
        pairs: Iterator[Any] = zip(self, other, strict=True)
        return tuple.__new__(type(self), [a + b for a, b in pairs])

    def __sub__(self, other: Vector[Any]) -> Self:
        pairs: Iterator[Any] = zip(self, other, strict=True)
        return tuple.__new__(type(self), [a - b for a, b in pairs])

    def __neg__(self) -> Self:
        components: tuple[Any, ...] = self
        return tuple.__new__(type(self), [-component for component in components])

    def __mul__(self, factor: Number) -> Self:  # type: ignore[override]  # scales, as arrays do
        components: tuple[Any, ...] = self
        return tuple.__new__(type(self), [component * factor for component in components])

    def __rmul__(self, factor: Number) -> Self:  # type: ignore[override]  # scales, as arrays do
        components: tuple[Any, ...] = self
        return tuple.__new__(type(self), [factor * component for component in components])

    def __truediv__(self, divisor: Number) -> Self:
        components: tuple[Any, ...] = self
        return tuple.__new__(type(self), [component / divisor for component in components])


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
    return tuple.__new__(KINDS[len(values)], values)


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
        values = [where(condition, *parts) for parts in zip(yes, no, strict=True)]
        return tuple.__new__(type(yes), values)
    if isinstance(condition, (bool, np.bool_)) and isinstance(yes, float) and isinstance(no, float):
        # For single numbers `numpy.where` takes several times as long.
        return np.float64(yes if condition else no)
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
    pairs: Iterator[Any] = zip(a, b, strict=True)
    products = [component * factor for component, factor in pairs]
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
