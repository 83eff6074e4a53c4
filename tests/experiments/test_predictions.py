"""Compare the predictions of `pbdkit check` for every shipped experiment with its run.

The run is followed from where its leaders have come to rest, shaken a little so that symmetric
leaders leave no mode out, to its equilibrium, which is known without stepping. A share of the
experiments is run, and all of them in the profile `long`.
"""

import json
import math

import numpy as np
import pytest
from property_cases import body_of
from scene_strategies import in_turn

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.linear.operator import step_operator
from pbdkit.linear.spectrum import modes, slowest_oscillation, spectrum
from pbdkit.model.shipped import read_experiment, shipped_names
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

MASSES = {"modelling/mass-on-a-bar"}
SHIPPED = {name: read_experiment(name).data for name in shipped_names()}
BARE = [n for n, data in SHIPPED.items() if "obstacles" not in data and n not in MASSES]
"""`check` makes no prediction for obstacles, and the rest position of masses is not determined
beforehand."""
TORN = [n for n in BARE if SHIPPED[n].get("fracture", {}).get("type", "none") != "none"]
JUMPS = [n for n in TORN if SHIPPED[n].get("solver", {}).get("type") == "equilibrium"]
STEPS = [n for n in TORN if n not in JUMPS and n != "modelling/ageing"]
"""A bar that has aged is in two halves at once, of which nothing holds one against sliding."""
STEPPED = "solver={type: stepping, relaxation: 0.2, memory: 0.8}"
OVERDAMPED = "solver={type: stepping, memory: 0.6}"
SWINGING = "solver={type: stepping, memory: 0.9}"
SWINGING_LONG = "solver={type: stepping, memory: 0.95}"
SMALLER = {
    "material/bar": ["lattice.a=0.2", OVERDAMPED],
    "material/dogbone": ["lattice.a=1.0", "solver.memory=0.95"]
    + [
        f"leaders.{n}.motion={{type: velocity, velocity: [{x}, 0.0], steps: 260}}"
        for n, x in enumerate((-8e-4, 8e-4))
    ],
    "modelling/ageing": [OVERDAMPED],
    "modelling/rollers": [OVERDAMPED],
    "modelling/strip": ["units.length=3.125 mm", SWINGING_LONG],
    "material/cantilever": ["lattice.a=0.25", "solver={type: stepping, memory: 0.7}"],
    "material/hole": ["lattice.a=0.2"],
    "modelling/cantilever-weight": ["lattice.a=0.5", SWINGING_LONG],
    "modelling/hanging-bar": ["lattice.a=0.5", SWINGING_LONG],
    "modelling/double-cantilever": [
        "body.columns=13",
        "cuts=[{from: [-1.0, 5.5], to: [3.25, 5.5]}]",
        "solver={type: stepping, memory: 0.97}",
    ],
    "fracture/crack-tip": [
        "body={type: grid, columns: 13, rows: 15}",
        "cuts=[{from: [5.0, 6.5], to: [8.0, 9.5]}]",
        "leaders.1.select.nearest=[[6.0, 0.0]]",
        "diagnostics=[]",
        SWINGING_LONG,
    ],
    "fracture/edge-crack": [
        "body={type: grid, columns: 11, rows: 16}",
        "fracture.cracks=[[[-1.0, 7.5], [4.25, 7.5]]]",
        "leaders.2.select.nearest=[[10.0, 0.0]]",
        "diagnostics=[]",
        SWINGING_LONG,
    ],
    "fracture/notched-beam": ["lattice.a=20.0", SWINGING_LONG],
    "modelling/dogbone-to-failure": ["lattice.a=2.5", SWINGING_LONG],
    "modelling/inclusion": ["lattice.a=1.0", SWINGING],
    "modelling/graded-bar": ["lattice.a=1.0", SWINGING],
    "modelling/composite-plate": ["lattice.a=5.0", SWINGING_LONG],
    "modelling/weakest-place": ["body.columns=8", SWINGING],
    "material/gradient-layer": ["lattice.a=0.1", STEPPED],
    "start": ["body={type: grid, columns: 12, rows: 6}"],
    "paper/e-40": ["body={type: grid, columns: 12, rows: 12}"]
    + [
        f"leaders.{n}.select={{nearest: [[{x}, {y}]]}}"
        for n, (x, y) in enumerate([(5, 5), (5, 6), (6, 5), (6, 6)])
    ],
}
"""Settings of shorter variants if the experiment itself would take minutes to converge, and of
stable steps if those of the file are not, because it solves for the equilibrium."""
LONG = ["steps=100000", "record={at: [100000]}"]
STRAIGHT = ["solver={type: equilibrium, tolerance: 1.0e-10}"]
SHAKEN = 0.1
HANGING = 1e-5
"""So near to 1 are the modes of what hangs by a line of springs, in tension or compression."""


def scene_with(name, *settings):
    return build_scene(pbdkit.load(name, settings=[*SMALLER.get(name, []), *LONG, *settings]))


def words_for(name, *settings):
    """Return the options of the command for the same experiment."""
    return [word for setting in (*SMALLER.get(name, []), *settings) for word in ("--set", setting)]


def at_rest(scene):
    """The first step in which no leader begins, moves or ends any more."""
    groups = [leading.group for leading in scene.leading]
    ends = [g.until + 1 for g in groups if g.until]
    return max([1, *ends, *(g.from_ + k for g in groups for k in g.motion.knots() if k < 1e9)])


def shaken(scene, state):
    """The state with its followers a little off; less so where there may be other equilibria."""
    rows = np.setdiff1d(scene.raster.body_rows, np.concatenate([x.rows for x in scene.leading]))
    size = SHAKEN if scene.experiment.rule.linear else SHAKEN / 10
    noise = size * np.random.default_rng(0).uniform(-1, 1, (2, len(rows)))
    state.u.reshape(2, -1)[:, scene.raster.place_of(rows)] += noise
    return state


@pytest.mark.parametrize("name", in_turn(BARE, 9))
def test_runs_converge_in_the_predicted_steps(call, name):
    """With bonds that hold: torn bodies have another operator, see below."""
    whole = ["fracture={type: none}"] if name in TORN else []
    if name in TORN:
        whole.append("diagnostics=[]")
    said = json.loads(call("check", name, "--json", *words_for(name, *LONG, *whole)).out)
    assert said["stable"]
    steps, radius = said["steps_to"]["1e-3"], said["spectral_radius"]
    window = max(2, math.ceil(said["period"] / 2)) if said["period"] else 2
    window = min(window, steps)  # near critical damping oscillations vanish

    scene = scene_with(name, *whole)
    rests = equilibrium_state(scene_with(name, *whole, *STRAIGHT))[0]
    stepper = Stepper(scene)
    if not scene.experiment.rule.linear:  # Newton's iteration stops within the tolerance
        rests = stepper.advance(rests, 2 * steps)
    settled = body_of(scene, rests)
    state = shaken(scene, stepper.advance(initial_state(scene), at_rest(scene)))
    state = stepper.advance(state, 2 * steps)  # the slowest mode remains
    sizes = np.empty(steps + window)
    for n in range(len(sizes)):
        sizes[n] = np.abs(body_of(scene, state) - settled).max() * radius**-n
        state = stepper.advance(state)
    excess = sizes[-window:].max() / sizes[:window].max()
    assert abs(math.log(excess)) < 0.05 * math.log(1e3)


@pytest.mark.parametrize("name", in_turn(STEPS, 6))
def test_broken_bodies_stay_stable_and_converge_more_slowly(call, name):
    """The prediction is for the unbroken body, and the output states that; the operator of the torn
    one has the rate.

    Memory leaves no mode faster than √b. A particle that hangs by springs in one line is free to
    move across: its mode neither grows nor shrinks, and it does not move.
    """
    said = json.loads(call("check", name, "--json", *words_for(name)).out)
    assert " steps if no bond breaks; " in call("check", name, *words_for(name)).out
    scene = scene_with(name)
    stepper = Stepper(scene)
    state = stepper.advance(initial_state(scene), at_rest(scene) + 400)
    assert (state.broken_step > 0).any()
    found = torn_modes(name, state)
    torn, mode = abs(found).max(), slowest_oscillation(found)
    hangs = scene.experiment.rule.type == "springs" and torn > 1.0 - HANGING
    assert said["spectral_radius"] - 1e-9 < torn < (1.0 + HANGING if hangs else 1.0)
    window = math.ceil(mode.period) if mode else 1
    moves = []
    for _ in range(200 + window):
        before = body_of(scene, state)
        state = stepper.advance(state)
        moves.append(np.abs(body_of(scene, state) - before).max())
    shrunk = max(moves[200:]) / max(moves[:window])
    if hangs:
        assert shrunk < 0.5
    else:
        assert math.log(shrunk) / 200 == pytest.approx(math.log(torn), rel=0.05)


def torn_modes(name, state):
    """The eigenvalues of the torn body's step, from those of the rule's own."""
    solver = scene_with(name).experiment.solver
    forgetful = ["solver.memory=0.0", "solver.relaxation=1.0"]
    operator = step_operator(scene_with(name, *forgetful), state)
    own = spectrum(operator.augmented().matrix())
    return modes(own.eigenvalues, solver.relaxation, solver.memory)
