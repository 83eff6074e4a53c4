"""The conformance suite: every property that components of an interface must have, for anybody's.

In a plugin's tests one line is enough::

    from pbdkit.testing import conformance

    test_conformance = conformance(MyRule())

`examine` gives the same as a report, and `pbdkit plugins check DISTRIBUTION` does it for all
components of a distribution. docs/extending/testing.md lists the properties.
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
from pbdkit.testing.subject import NotAskedError, Property, PropertyError, examples_of

__all__ = [
    "PROPERTIES",
    "NotAskedError",
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
