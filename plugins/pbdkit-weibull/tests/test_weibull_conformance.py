"""Properties that pbdkit requires of every FractureModel, one case for each."""

from pbdkit_weibull import Weibull

from pbdkit.testing import conformance

test_conformance = conformance(Weibull())
