"""What pbdkit asks of every FractureModel, one case for each property."""

from pbdkit_weibull import Weibull

from pbdkit.testing import conformance

test_conformance = conformance(Weibull())
