"""Laws that every scene obeys, as functions of an experiment that return what breaks them.

Each returns a list of sentences, empty where the law holds or is not about the scene.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from changed_axes import AXES, Change, applies_to, changed, differences
from crossed_scenes import experiment_from
from interpreted_kernels import interpreting

import pbdkit
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.plugin import StoresEnergy
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import Simulation
from pbdkit.testing import mechanics as laws

Tree = dict[str, Any]
Faults = list[str]
CALIBRATED = ("elastic", "orthotropic", "springs", "strain-gradient")
POWERS_OF_TWO = (2.0**-30, 2.0**20, 2.0**-13, 2.0**30)
ANY_LENGTHS = (1e-9, 1e6, 3.7, 1e9)
FAR = (2.0**14 + 0.3, -3e4)
EXACT, ROUNDING, SINGLE, FOUND = 0.0, 1e-9, 1e-4, 1e-7
"""Tolerances of results: to the bit, by rounding, by rounding in single precision, and by the
tolerance of equilibria."""
LONGEST = 1e6
"""The largest internal length that strain-gradient takes, in lattice units."""


def run(experiment: Tree) -> Any:
    """The dataset, without warnings: scenes here are small, torn and pressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pbdkit.PbdkitWarning)
        return _run(experiment)


def _run(experiment: Tree) -> Any:
    if experiment["solver"].get("engine") != "compiled":
        return pbdkit.run(experiment_from(experiment), progress=False)
    with interpreting():
        return pbdkit.run(experiment_from(experiment), progress=False)


@lru_cache(maxsize=4)
def _known(text: str) -> Any:
    return run(json.loads(text))


def known(experiment: Tree) -> Any:
    """Return the same, computed once for each experiment."""
    return _known(json.dumps(experiment))


def tolerance(experiment: Tree, *, exact: bool = False) -> float:
    """Return the tolerance between results of the same scene in another description."""
    solver = experiment["solver"]
    if experiment.get("record", {}).get("dtype") == "float32":
        return SINGLE
    if solver["type"] == "equilibrium":
        return FOUND
    if exact and not _is_rounded(experiment):
        return EXACT
    return SINGLE if solver.get("precision") == "float32" and not exact else ROUNDING


def _is_rounded(experiment: Tree) -> bool:
    """Return whether areas, distances or measured fields are computed, which powers of two round
    too."""
    motions = [group["motion"]["type"] for group in experiment["leaders"]]
    return bool(experiment.get("loads") or experiment.get("obstacles") or "measured" in motions)


def keeps_answers(experiment: Tree, change: Change, what: str, *, exact: bool = False) -> Faults:
    """The changed experiment has the changed results."""
    if not applies_to(change, experiment):
        return []
    given = experiment
    if not exact and "auto" in experiment["solver"].values():
        given = with_chosen_weights(experiment)  # they are chosen to half of the digits
    found = differences(known(given), run(changed(given, change)), change)
    most = tolerance(experiment, exact=exact)
    return [f"{what}: {name} differs by {by:.2g}" for name, by in found.items() if not by <= most]


def with_chosen_weights(experiment: Tree) -> Tree:
    """Relaxation and memory as `auto` came to."""
    solver = json.loads(known(experiment).attrs["experiment"])["solver"]
    return experiment | {"solver": solver}


def of_units(experiment: Tree, n: int) -> Faults:
    """Lengths times a power of two, for even n: the same numbers; times another number: to
    rounding."""
    exact = n % 2 == 0
    factor = (POWERS_OF_TWO if exact else ANY_LENGTHS)[n // 2 % 4]
    if experiment["rule"].get("length", 0.0) * factor > LONGEST:
        factor = 2.0**20 if exact else 1e6
    return keeps_answers(experiment, Change(factor), f"lengths times {factor:g}", exact=exact)


def of_places(experiment: Tree, n: int = 0) -> Faults:
    """Compare with the same experiment far away."""
    return keeps_answers(experiment, Change(shift=FAR), "moved")


def of_axes(experiment: Tree, n: int) -> Faults:
    """Mirrored along one axis, and turned or with axes swapped."""
    names = list(AXES)
    chosen = names[n % 2], names[2 + n // 2 % 2]
    return [f for name in chosen for f in keeps_answers(experiment, Change(axes=AXES[name]), name)]


def of_engines(experiment: Tree, n: int = 0) -> Faults:
    """The compiled engine's kernels, run by Python, and a second run give the same bits."""
    solver, once = experiment["solver"], known(experiment)
    if solver["type"] != "stepping":
        return _different(once, run(experiment), "a second run")
    if solver.get("precision") == "float32":
        # Kernels that Python runs keep constants in double precision.
        return _different(once, run(experiment), "a second run")
    plain = run(experiment | {"solver": solver | {"engine": "numpy"}})
    faults = _different(once, plain, "a second run")
    try:
        compiled = run(experiment | {"solver": solver | {"engine": "compiled"}})
    except pbdkit.ExperimentError as error:
        refused = "the compiled engine is not available" in str(error)
        return faults if refused else [*faults, str(error)]
    return faults + _different(plain, compiled, "the compiled engine")


def _different(one: Any, other: Any, what: str) -> Faults:
    if one.sizes != other.sizes:
        return [f"{what}: other sizes"]
    names = [n for n in one.variables if not one[n].identical(other[n])]
    return [f"{what}: other {', '.join(map(str, names))}"] if names else []


def of_stopping(experiment: Tree, n: int) -> Faults:
    """Stop at some step, store the state, and resume in a rebuilt scene: the bits are the same."""
    if experiment["solver"]["type"] != "stepping":
        return []
    step = 1 + n % (experiment["steps"] - 3)
    scene, again = (build_scene(experiment_from(experiment)) for _ in range(2))
    with interpreting():
        found = laws.resumed(scene, again, step)
    names = [n for n, v in known(experiment).variables.items() if not v.equals(found[n].variable)]
    return [f"continued after step {step}: other {', '.join(map(str, names))}"] if names else []


def of_balance(experiment: Tree, n: int = 0) -> Faults:
    """In equilibrium reactions, loads and contact forces sum to 0, and in linear elasticity half of
    what they do is the strain energy."""
    rests = experiment["solver"]["type"] == "equilibrium"
    if not (rests and has_laws_of_mechanics(experiment)):
        return []
    experiment = with_forces(experiment)
    ds = known(experiment)
    forces = [ds["reaction"].values[-1]]
    for name in ("load_resultant", "contact_force"):
        if name in ds:
            forces.append(ds[name].values[-1])
    total, largest = np.concatenate(forces).sum(axis=0), max(np.abs(f).max() for f in forces)
    scale = max(largest, _modulus(experiment) * 1e-3)
    faults = []
    if not np.abs(total).max() <= 1e-6 * scale:
        faults.append(f"forces leave {total} of {largest:.3g}")
    if not (experiment.get("obstacles") or _is_torn(experiment) or experiment.get("cuts")):
        faults += _of_energy(experiment, ds)
    return faults


def with_forces(experiment: Tree) -> Tree:
    """Return the experiment with all forces and the energy among its diagnostics."""
    parts = {"reaction": "leaders", "load-displacement": "loads", "contact": "obstacles"}
    kinds = ["strain-energy", *(kind for kind, part in parts.items() if experiment.get(part))]
    others = [one for one in experiment["diagnostics"] if one["type"] not in kinds]
    units = experiment.get("units", {})
    values = {} if "youngs_modulus" in units else {"youngs_modulus": 1.0}
    values |= {"thickness": 1.0} if units and "thickness" not in units else {}
    added = [{"type": kind} | values for kind in kinds]
    return experiment | {"diagnostics": [*others, *added], "record": {}}


def _of_energy(experiment: Tree, ds: Any) -> Faults:
    scene, moment = last_moment(experiment)
    if isinstance(scene.experiment.rule, StoresEnergy):
        return []  # springs are not linear
    work = 0.5 * _modulus(experiment) * work_of(scene, moment)
    energy = float(ds["strain_energy"].values[-1])
    size = max(abs(work), abs(energy), 1e-6 * _modulus(experiment))
    wrong = not abs(work - energy) <= 1e-6 * size
    return [f"half the work is {work:.6g}, the energy {energy:.6g}"] if wrong else []


def work_of(scene: Scene, moment: StateMoment) -> float:
    """Displacements times the forces of leaders and loads, over Young's modulus and thickness."""
    forces, u = np.array(moment.forces.on_particles()), moment.displacement()
    outer = np.zeros_like(u)
    for load in moment.loads():
        outer[load.rows] += np.outer(load.share, load.force)
    led = np.zeros(u.shape, bool)
    for group in moment.leader_groups():
        for axis in group.axes if group.leads else ():
            led[group.rows, axis] = True
    return float(np.nansum(np.where(led, -forces, outer) * u))


def last_moment(experiment: Tree) -> tuple[Scene, StateMoment]:
    """The scene, and where its run ends."""
    course = Simulation.of_scene(build_scene(experiment_from(experiment)))
    for _ in course:
        pass
    return course.scene, StateMoment(course.driver.state.copy(), Tables(course.scene))


def _modulus(experiment: Tree) -> float:
    """Return the factor of forces in a dataset, over Young's modulus and thickness."""
    units = experiment.get("units", {})
    modulus, thickness = (
        float(units.get(n, "1 ").split()[0]) for n in ("youngs_modulus", "thickness")
    )
    return modulus * thickness


def _is_torn(experiment: Tree) -> bool:
    return experiment.get("fracture", {}).get("type", "none") != "none"


def has_laws_of_mechanics(experiment: Tree) -> bool:
    """Return whether the rule has forces, and edges are free: copying frames pull."""
    natural = experiment["frame"]["type"] == "natural"
    return natural and experiment["rule"]["type"] in CALIBRATED


def of_stiffness(experiment: Tree, n: int) -> Faults:
    """Rigid motions cost nothing, what a does to b is what b does to a, no deformation gives energy
    back, and bonds that break or soften stiffen nothing: whole, and with bonds torn at random."""
    if not has_laws_of_mechanics(experiment):
        return []
    stepping = {"type": "stepping", "relaxation": 0.5}
    experiment = experiment | {"solver": stepping, "record": {}}
    scene = build_scene(experiment_from(experiment))
    # A central difference of springs has some nine digits.
    most = 1e-9 if isinstance(scene.experiment.rule, StoresEnergy) else 1e-12
    whole = laws.whole_state(scene)
    torn = laws.softened_state(scene, n) if scene.has_fracture else whole
    again = laws.torn_state(scene, n + 1, torn)
    matrices = [laws.stiffness(scene, state) for state in (whole, torn, again)]
    faults = []
    for K, what in zip(matrices, ("whole", "torn", "torn further"), strict=True):
        found = {
            "a rigid motion costs": laws.resistance_to_rigid_motions(scene, K),
            "is not symmetric, by": laws.asymmetry(K),
            "gives energy back:": laws.energy_given_back(K),
        }
        faults += [f"{what}, {law} {by:.2g}" for law, by in found.items() if not by <= most]
    for before, after in pairwise(matrices):
        if not (by := laws.stiffening(before, after)) <= most:
            faults.append(f"breaking bonds stiffens by {by:.2g}")
    return faults


LAWS: dict[str, Callable[[Tree, int], Faults]] = {
    "units": of_units,
    "places": of_places,
    "axes": of_axes,
    "engines": of_engines,
    "stopping": of_stopping,
    "balance": of_balance,
    "stiffness": of_stiffness,
}
"""Laws by name; each gets the experiment, and a number that draws what the law leaves open."""
