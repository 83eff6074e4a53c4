"""Properties that pbdkit requires of every NeighbourMetric and FollowerRule, one case for each.

On few scenes each, as kernels take seconds to compile: `pbdkit plugins check` tries all.
"""

from pbdkit_pantograph import Fibres, Pantograph, PantographBeams

from pbdkit.testing import conformance

LATTICE = {"type": "centred-rectangular", "a": 1.0, "b": 1.0}

test_conformance = conformance(Pantograph(shear=0.01), neighbours=Fibres(), lattice=LATTICE)
test_conformance_of_fibres = conformance(
    Fibres(), lattice=[LATTICE, {"type": "hexagonal", "a": 0.7}], rule={"type": "barycentre"}
)
test_conformance_of_beams = conformance(
    PantographBeams(pivot=0.1),
    neighbours={"type": "coordination", "shells": 1},
    lattice={"type": "square", "a": 1.0},
)
