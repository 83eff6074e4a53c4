"""Properties that pbdkit requires of every Lattice and NeighbourMetric, one case for each.

On few scenes each, as kernels take seconds to compile: `pbdkit plugins check` tries all.
"""

from pbdkit_kagome import BondSteps, Honeycomb, Kagome

from pbdkit.testing import conformance

test_conformance = conformance(Kagome(), Honeycomb(a=0.7), neighbours=BondSteps())
test_conformance_of_bond_steps = conformance(
    BondSteps(shells=2), lattice=Honeycomb(), rule={"type": "barycentre"}
)
