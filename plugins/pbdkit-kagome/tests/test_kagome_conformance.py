"""What pbdkit asks of every Lattice and NeighbourMetric, one case for each property."""

from pbdkit_kagome import BondSteps, Honeycomb, Kagome

from pbdkit.testing import conformance

test_conformance = conformance(Kagome(), Honeycomb(a=0.7), BondSteps(shells=2))
test_conformance_on_kagome = conformance(
    BondSteps(shells=2), lattice=Kagome(a=1.3), rule={"type": "barycentre"}
)
