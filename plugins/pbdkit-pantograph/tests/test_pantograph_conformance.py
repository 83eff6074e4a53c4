"""What pbdkit asks of every NeighbourMetric and FollowerRule, one case for each property."""

from pbdkit_pantograph import Fibres, Pantograph

from pbdkit.testing import conformance

test_conformance = conformance(Fibres(), Pantograph(shear=0.01))
test_conformance_together = conformance(
    Pantograph(), neighbours=Fibres(), lattice={"type": "centred-rectangular", "a": 1.0, "b": 1.0}
)
