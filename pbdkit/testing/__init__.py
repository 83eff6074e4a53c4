"""The conformance suite: the properties that every component of an interface must have.

In the tests of a plugin one line is enough::

    from pbdkit.testing import conformance

    test_conformance = conformance(MyRule())

`examine` tests the same properties and returns a report. `pbdkit plugins check DISTRIBUTION` tests
all components of a distribution. docs/extending/testing.md lists the properties.
"""

from pbdkit.testing.conformance import (
    PROPERTIES,
    Outcome,
    Report,
    conformance,
    examine,
    examine_all,
    properties_of,
)
from pbdkit.testing.subject import NotApplicableError, Property, PropertyError, examples_of

__all__ = [
    "PROPERTIES",
    "NotApplicableError",
    "Outcome",
    "Property",
    "PropertyError",
    "Report",
    "conformance",
    "examine",
    "examine_all",
    "examples_of",
    "properties_of",
]
