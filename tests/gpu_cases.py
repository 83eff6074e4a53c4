"""Scenes for the GPU engine. As a script this steps them in the simulator beside numpy, in a
process of its own, as numba requires (NUMBA_ENABLE_CUDASIM=1)."""

import os
import sys

import numpy as np
from particle_operations import Drag, Wind
from property_cases import FRAMES, LATTICES, RULES
from remembering_parts import Tiring, Weakest
from turning_frame import Turning

import pbdkit
from pbdkit.scene.scene import build_scene
from tests.components.test_fracture_cohesive import COHESIVE
from tests.model.test_boundary_conditions import PLATE, cut
from tests.plugin import test_lattice as test_axes, test_schedule as test_courses
from tests.scene import test_loads
from tests.scene.test_leader_groups_directions import CASES, vanes
from tests.scene.test_materials import FIELDS, REGIONS
from tests.stepping.numba_engine.test_engine import (
    CUT,
    DAMAGE,
    ELASTIC,
    MANY,
    SCATTERED,
    TORN,
    TWICE,
    assert_bitwise_equal,
    sheet,
)

SMALL = {"body": {"type": "grid", "columns": 5, "rows": 5}}
MOVING = {"type": "stepping", "relaxation": 0.7, "memory": 0.2}
TEARS = {"fracture": TORN | {"thresholds": [1.2]}}
SHEETS = {
    "still": {"initial": {"type": "noise", "amplitude": 0.1}},
    "sublattices, lag, memory": {
        "lattice": LATTICES["hexagonal"],
        "rule": RULES["distance-weighted"],
        "frame": FRAMES["lag"],
        "solver": MOVING,
    },
    "by place": {"lattice": LATTICES["oblique"], "rule": RULES["mixed-coordinate-y"]},
    "torn": TEARS,
    "torn, no frame": TEARS | {"frame": {"type": "none"}},
    "torn, matrices of a frame": {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": ELASTIC,
        "frame": Turning(),
        "fracture": TORN | {"thresholds": [1.2], "placement": 1.0},
    },
    "torn cells": {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": ELASTIC,
        "frame": {"type": "natural"},
        "fracture": {"type": "strain", "failure": 0.15},
        "initial": {"type": "noise", "amplitude": 0.1},
    },
    "torn by the stress of cells": {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": ELASTIC,
        "frame": {"type": "natural"},
        "fracture": {"type": "cohesive", "energy": 0.05, "onset": 0.1},
        "initial": {"type": "noise", "amplitude": 0.1},
    },
    "strength by bond, cut cells": CUT["square"]
    | {"fracture": SCATTERED, "initial": {"type": "noise", "amplitude": 0.3}},
    "triangles": CUT["hexagonal"],
    "damage, numbers of particles": {
        "rule": Tiring(spread=0.1),
        "fracture": DAMAGE | {"scatter": 0.3, "frame_bonds": False},
    },
    "many neighbours, drawn and counted": {
        "neighbours": MANY,
        "rule": Tiring(spread=0.1),
        "fracture": Weakest(spread=0.3, weak=0.7),
    },
    "operations of particles": {
        "operations": [
            Wind(select={"edge": "top"}),
            Drag(select={"box": [1.0, 1.0, 4.0, 4.0]}),
        ],
        "fracture": TORN | {"thresholds": [1.2]},
    },
    "moves of another": TWICE | {"frame": {"type": "mean"}},
    "single precision": TEARS | {"solver": MOVING | {"precision": "float32"}},
}
COMPOSITE = {
    "name": "composite",
    "regions": REGIONS,
    "body": {"type": "rectangle", "width": 6.7, "height": 5.0},
    "leaders": sheet()["leaders"],
    "steps": 12,
    "solver": {"type": "stepping", "relaxation": 0.5},
}
TIME_DEPENDENT = test_courses.sheet(**test_courses.CHANGING["both"])
OTHERS = {
    "composite": COMPOSITE | FIELDS["torn composite"],
    "parameters by particle": COMPOSITE | FIELDS["K"],
    "numbers that change": TIME_DEPENDENT | SMALL,
    "loads": test_loads.loaded(test_loads.TIP | {"from": 3}, solver={"type": "stepping"}, steps=20),
    "cut on the way": PLATE | {"cuts": cut(3)},
    "seen by neighbours": vanes(**CASES["hole"] | {"leaders": sheet()["leaders"]}),
}

WHOLE = {"neighbours": {"type": "chebyshev", "shells": 1}}
SHIPPED = {
    "barycentre": {"fracture": TORN, "frame": FRAMES["mean"]},
    "mean-displacement": {"fracture": SCATTERED, "frame": {"type": "mirror"}},
    "distance-weighted": {"lattice": LATTICES["hexagonal"], "fracture": DAMAGE}
    | {"frame": FRAMES["lag"]},
    "mixed-coordinate": {"rule": RULES["mixed-coordinate"]}
    | {"fracture": TORN, "frame": FRAMES["first"]},
    "springs": WHOLE | {"fracture": COHESIVE | {"energy": 1e-3}, "frame": {"type": "natural"}},
    "elastic": WHOLE | {"rule": ELASTIC, "frame": {"type": "none"}},
    "orthotropic": WHOLE
    | {"rule": FIELDS["orthotropic"]["rule"] | {"modulus_ratio": 0.5}, "frame": {"type": "none"}},
    "strain-gradient": TWICE | {"solver": MOVING | {"precision": "float32"}},
}
"""Every rule that comes with pbdkit, and between them every fracture model and frame policy."""


def shipped(rule):
    return scene_of(sheet(**SMALL | {"rule": {"type": rule}} | SHIPPED[rule]))


def scene_of(given):
    return build_scene(pbdkit.Experiment(**given))


def scenes():
    """Return the scenes by name; each has a feature that others do not have."""
    found = {name: scene_of(sheet(**SMALL | parts)) for name, parts in SHEETS.items()}
    found |= {name: scene_of(given) for name, given in OTHERS.items()}
    torn = {"type": "threshold", "thresholds": [1.2]}
    return found | {"in space": test_axes.scene("numpy", torn)}


def names(every):
    """Return a share of the names of scenes; all of them if `every` is 1."""
    return [*SHEETS, *OTHERS, "in space"][::every]


def compare(every):
    """Each kernel for one block and for several, of a share of the scenes."""
    from pbdkit.stepping import cuda_engine as program
    from pbdkit.stepping.cuda_engine import GpuStepper

    for name, scene in scenes().items():
        if name not in names(every):
            continue
        for alone in (0, 4096) if name in ("torn", "moves of another") else (4096,):
            program.ALONE = alone
            with np.errstate(all="ignore"):
                reference = assert_bitwise_equal(scene, GpuStepper(scene), calls=(1, 2, 4))
            assert reference.u.any(), name
            if name.startswith(("torn", "strength", "composite", "cut", "in space")):
                assert (reference.broken_step > 0).any(), name
        print(name)


if __name__ == "__main__":
    assert os.environ["NUMBA_ENABLE_CUDASIM"] == "1"
    compare(int(sys.argv[1]) if sys.argv[1:] else 1)
