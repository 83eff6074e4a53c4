"""Vectors calculate as their components do, to the last bit, on arrays and in compiled code."""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, strategies as st

import pbdkit
from pbdkit.plugin.vector import KINDS, vector
from pbdkit.stepping.numba_engine.cache import compiled

NUMBERS = st.floats(-1e150, 1e150)
SPACES = pytest.mark.parametrize("space", sorted(KINDS))


def dotted(a, b):
    """a·b in the order of the components."""
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


OPERATIONS = {
    "sum": (lambda a, b, s: a + b, lambda a, b, s: [x + y for x, y in zip(a, b, strict=True)]),
    "difference": (
        lambda a, b, s: a - b,
        lambda a, b, s: [x - y for x, y in zip(a, b, strict=True)],
    ),
    "negation": (lambda a, b, s: -a, lambda a, b, s: [-x for x in a]),
    "multiple": (lambda a, b, s: a * s, lambda a, b, s: [x * s for x in a]),
    "scaled": (lambda a, b, s: s * a, lambda a, b, s: [s * x for x in a]),
    "quotient": (lambda a, b, s: a / s, lambda a, b, s: [x / s for x in a]),
    "choice": (
        lambda a, b, s: pbdkit.plugin.where(s > 1.0, a, b),
        lambda a, b, s: [x if s > 1.0 else y for x, y in zip(a, b, strict=True)],
    ),
    "dot": (lambda a, b, s: pbdkit.plugin.dot(a, b), lambda a, b, s: [dotted(a, b)]),
    "square": (lambda a, b, s: pbdkit.plugin.squared_length(a), lambda a, b, s: [dotted(a, a)]),
    "length": (lambda a, b, s: pbdkit.plugin.length(a), lambda a, b, s: [math.sqrt(dotted(a, a))]),
    "formula": (
        lambda a, b, s: (1.0 - s) * a + s * b - (a + b) / s,
        lambda a, b, s: [((1.0 - s) * x + s * y) - (x + y) / s for x, y in zip(a, b, strict=True)],
    ),
}
"""Functions by name: of vectors a and b and a positive number s; and the same of plain numbers."""
EVERY = pytest.mark.parametrize("name", OPERATIONS)


@cache
def in_numba(name):
    return compiled(OPERATIONS[name][0])


def in_space(space):
    plain = st.tuples(*[NUMBERS] * space)
    return st.tuples(plain, plain, st.floats(1e-3, 1e3))


def bits(answer):
    return np.atleast_1d(np.array(answer, np.float64)).view(np.int64).tolist()


@SPACES
@EVERY
def test_scalars_match_the_definition(space, name):
    of_vectors, of_numbers = OPERATIONS[name]

    @given(in_space(space))
    def agree(drawn):
        a, b, s = drawn
        expected = bits(of_numbers(a, b, s))
        assert bits(of_vectors(vector(a), vector(b), s)) == expected
        assert bits(in_numba(name)(vector(a), vector(b), s)) == expected

    agree()


@SPACES
@EVERY
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_arrays_are_computed_elementwise_in_their_precision(space, name, precision):
    of_vectors, of_numbers = OPERATIONS[name]
    drawn = np.random.default_rng(space).normal(size=(2 * space + 1, 4, 3)).astype(precision)
    a, b, s = drawn[:space], drawn[space:-1], np.abs(drawn[-1]) + precision(0.5)
    whole = np.atleast_2d(np.array(of_vectors(vector(a), vector(b), s))).reshape(-1, 4, 3)
    assert whole.dtype == precision
    for place in np.ndindex(4, 3):
        there = (slice(None), *place)
        expected = np.array(of_numbers(a[there], b[there], s[place]), precision)
        np.testing.assert_array_equal(whole[there], expected)


@SPACES
def test_vector_keeps_its_type_and_number_of_components(space):
    kind, a = KINDS[space], vector(range(space))
    s = np.array([2.0, 3.0])
    made = [a + a, a - a, -a, 2.0 * a, a * 2.0, a / 2.0, s * a, a * s, np.float64(2.0) * a]
    assert {type(v) for v in made} == {kind}
    assert {len(v) for v in made} == {space}
    assert all(np.array_equal(x, y * s) for x, y in zip(s * a, a, strict=True))


def test_other_numbers_of_components_are_refused():
    with pytest.raises(ValueError, match="a vector has two or three components, not 4"):
        vector(range(4))
    plane, space = pbdkit.plugin.Vector(1.0, 2.0), pbdkit.plugin.SpaceVector(1.0, 2.0, 3.0)
    for one, other in ((plane, space), (space, plane)):
        with pytest.raises(ValueError, match=r"argument 2 is (longer|shorter)"):
            one + other
        with pytest.raises(ValueError, match=r"argument 2 is (longer|shorter)"):
            pbdkit.plugin.dot(one, other)
