"""What `check` reports of an experiment without running it, and `run` before its first step:
stability, supports, memory and time.

Leaders of small mass: the symplectic Euler method is stable for ω ≤ 2. Supports: a part of the body
that can move as a rigid body resists nothing; where leaders leave it such a motion and the loads do
work along it, there is no equilibrium, and the steps never end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import (
    ExperimentError,
    PbdkitError,
    StabilityWarning,
    WarningText,
    of_category,
)
from pbdkit.lattice.neighbourhood import count_bonds
from pbdkit.lattice.raster import FOLLOWER, Floats, Mask
from pbdkit.linear.spectrum import NEUTRAL
from pbdkit.linear.stencil import NO_REMEDY, Bound, bounds_the_body, wave_bound
from pbdkit.memory import machine_memory
from pbdkit.model.motions import Newton
from pbdkit.plugin import Anchors, Calibrated
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.units import LENGTH
from pbdkit.scene.leaders import kinds_at, kinds_of_places
from pbdkit.scene.memory_estimate import LARGEST_ANEW, MIB, Sizes, sizes_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.engine_choice import choose, seconds_of
from pbdkit.stepping.leaders import NewtonForces
from pbdkit.stepping.state import initial_state

if TYPE_CHECKING:
    from pbdkit.stability.analysis import Analysis


NUDGE = 1e-3
"""By which they are moved, in lattice units."""


def too_light(scene: Scene) -> list[str]:
    """A warning for each group whose stiffest way, others standing still, is too stiff."""
    forces, found = NewtonForces(scene), []
    state = initial_state(scene) if forces.numbers else None
    for n in forces.numbers:
        motion = scene.leading[n].group.motion
        assert state
        assert isinstance(motion, Newton)
        least = motion.lightest(forces.stiffness(n, state, NUDGE))
        if motion.mass < least:
            found.append(
                f"leaders.{n}.motion.mass: {motion.mass:g} is too light, its swing may grow for "
                f"ever; steps are stable from {least:.4g} on"
            )
    return found


@dataclass(frozen=True)
class Forecast:
    """Counts, with followers at step 1; memory and output in MiB; about how many seconds the steps
    take, None for an equilibrium; the solver's relaxation and
    memory; what the analysis found, None where it cannot tell or it would take too long; with
    memory, the period in steps of the slowest mode that swings and by what it shrinks a step, None
    where nothing swings; by how much the body trails its equilibrium in the leaders' fastest steps,
    in lattice units, once that is steady and when these steps end, None where no leader moves
    steadily; how far the body's particles reach along each axis, in mm, None without `units`;
    whether what the analysis found is exact, or linearised at the start; whether it is estimated,
    1 - ρ to 1 %; warnings."""

    particles: int
    followers: int
    bonds: int
    memory_mib: float
    output_mib: float
    seconds: float | None
    relaxation: float
    memory: float
    spectral_radius: float | None
    smallest_eigenvalue: float | None
    largest_stable_relaxation: float | None
    stable: bool | None
    steps_to: dict[str, int | None]
    period: float | None
    decay: float | None
    exact: bool
    estimated: bool
    lag: float | None
    lag_reached: float | None
    size_mm: tuple[float, ...] | None
    warnings: list[str]

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return asdict(self)


LOOKED_AT = 2000
"""Particles up to which a run looks at what `check` knows of it (at most 0.9 s of a processor)."""
MOST_MOMENTS = 16
"""Of those at which numbers turn, to be looked at."""
ANALYSED = (
    *("spectral_radius", "smallest_eigenvalue", "largest_stable_relaxation", "stable", "steps_to"),
    *("exact", "estimated", "lag"),
)
"""What the analysis calls by the same names."""

WITHOUT = (
    "obstacles: stability and settling are told of the body without them, and whether they hold it "
    "is not looked at",
)


def forecast(scene: Scene) -> Forecast:
    """The forecast of a scene."""
    from pbdkit.stability.analysis import Analysis

    kinds = kinds_at(scene.raster, scene.leading, 1)
    analysis, solver = Analysis(scene), scene.experiment.stepping
    sizes = _sizes(analysis)
    swing = analysis.swing(solver.relaxation, solver.memory) if solver.memory else None
    waves = [] if analysis.spectrum else _growing_waves(scene, wave_bound(scene))
    return Forecast(
        particles=scene.raster.count,
        followers=int(np.count_nonzero(kinds == FOLLOWER)),
        bonds=count_bonds(scene.raster, scene.neighbourhood),
        memory_mib=round(sizes.memory / MIB, 3),
        output_mib=round(sizes.output / MIB, 3),
        seconds=_seconds(scene),
        relaxation=solver.relaxation,
        memory=solver.memory,
        period=swing.period if swing else None,
        decay=swing.decay if swing else None,
        lag_reached=analysis.trailing.reached if analysis.trailing else None,
        size_mm=_size_mm(scene),
        warnings=[
            *_doubts(scene),
            *_unheld(scene),
            *WITHOUT[: len(scene.barriers)],
            *analysis.warnings(),
            *_on_the_way(scene),
            *_too_short(analysis),
            *waves,
        ],
        **{name: getattr(analysis, name) for name in ANALYSED},
    )


def _size_mm(scene: Scene) -> tuple[float, ...] | None:
    if (units := scene.experiment.units) is None:
        return None
    body = scene.raster.reference(scene.raster.body_rows)
    return tuple((np.ptp(body, axis=0) * units.scale(LENGTH)).tolist())


def _seconds(scene: Scene) -> float | None:
    if not scene.experiment.solver.makes_steps:
        return None
    return seconds_of(scene, choose(scene))


def _sizes(analysis: Analysis) -> Sizes:
    """Of a large equilibrium by what serves it."""
    scene = analysis.scene
    count, grids = scene.raster.count, not scene.barriers
    if grids and count > LARGEST_ANEW and not scene.experiment.solver.makes_steps:
        grids = analysis.spectra.estimate.system(scene.experiment.steps) is not None
    return sizes_of(scene.experiment, scene.neighbourhood, count, grids=grids)


def quick_warnings(scene: Scene, bound: Bound | None) -> tuple[str, ...]:
    """What can be said in milliseconds, before a run, with its bound from plane waves."""
    return (*_doubts(scene), *_growing_waves(scene, bound))


def prediction(scene: Scene, bound: Bound | None) -> dict[str, Any]:
    """What the dataset keeps of the bound from plane waves; empty where there is none. `stable` is
    None where no wave grows and waves do not bound the body."""
    memory = scene.experiment.stepping.memory
    if bound is None:
        return {}
    return {
        "stable": bound.radius <= 1.0 + NEUTRAL and (bounds_the_body(scene) or None),
        "largest_stable_relaxation": bound.largest_stable_relaxation(memory),
        "smallest_eigenvalue": bound.smallest,
    }


def _too_short(analysis: Analysis) -> list[str]:
    """Where a run ends long before its loads have come to rest: nobody could see it."""
    experiment, settled = analysis.scene.experiment, analysis.steps_to["1e-3"]
    if not (experiment.loads and experiment.solver.makes_steps and settled):
        return []
    if experiment.stepping.settle or settled <= experiment.steps:
        return []
    return [
        f"steps: under its loads the body comes to rest in about {settled} steps, and the run has "
        f"{experiment.steps}; take solver: {{type: equilibrium}}, memory: auto, or more steps"
    ]


def _on_the_way(scene: Scene) -> list[str]:
    """Where steps diverge within the run with other numbers than the last."""
    from pbdkit.stability.analysis import Analysis

    courses, steps = scene.experiment.courses, scene.experiment.steps
    bends = sorted({min(bend, steps) for course in courses.values() for bend in course.bends})
    moments = [n for n in bends if any(c.at(n) != c.last for c in courses.values())]
    found = list[str]()
    for moment in moments[:MOST_MOMENTS] if scene.experiment.solver.makes_steps else ():
        if Analysis(scene.at(moment)).stable is False:
            now = (f"{'.'.join(at)} {course.at(moment):g}" for at, course in courses.items())
            found.append(
                f"{min(courses)[0]}: at step {moment} steps diverge, with {', '.join(now)}"
            )
    if len(moments) > MOST_MOMENTS:
        found.append(f"analysis: of {len(moments)} moments the first {MOST_MOMENTS} were looked at")
    return found


def _doubts(scene: Scene) -> list[str]:
    sizes = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.total)
    warnings = list(scene.warnings)
    followers = kinds_of_places(scene.raster, scene.leading, 1) == FOLLOWER
    if not scene.raster.communicator.any(followers.any()):
        warnings.append("leaders: everybody leads in step 1, nobody follows")
    for n, leading in enumerate(scene.leading):
        if leading.group.from_ > scene.experiment.steps:
            warnings.append(f"leaders.{n}: begins to lead after the run's last step")
    for n, load in enumerate(scene.experiment.loads):
        if load.from_ > scene.experiment.steps:
            warnings.append(f"loads.{n}: begins to act after the run's last step")
    warnings += of_category(StabilityWarning, too_light(scene))
    for n, barrier in enumerate(scene.barriers):
        if barrier.group.from_ > scene.experiment.steps:
            warnings.append(f"obstacles.{n}: begins after the run's last step")
    if not (scene.driven or scene.loads):
        warnings.append("leaders: there are none, nothing will move")
    if sizes.output > machine_memory():
        warnings.append(
            f"record: the output of {sizes.output / 2**30:.3g} GiB exceeds this machine's memory: "
            "record fewer steps to open it at once"
        )
    return warnings


def _growing_waves(scene: Scene, bound: Bound | None) -> list[str]:
    solver = scene.experiment.stepping
    if bound is None or bound.radius <= 1.0 + NEUTRAL:
        return []
    stable = bound.largest_stable_relaxation(solver.memory)
    if stable and not scene.experiment.solver.makes_steps:
        return []
    remedy = f"; it is stable below {stable:.4g}" if stable else NO_REMEDY
    grows = f"can diverge, some waves grow by {bound.radius:.4g} a step"
    text = f"solver.relaxation: {solver.relaxation:g} {grows}{remedy}"
    return [WarningText(text, StabilityWarning)]


def refuse_unheld_loads(scene: Scene) -> None:
    """Raises ExperimentError, as the run would, where loads push a part of the body on for ever and
    its equilibrium is asked for."""
    if scene.experiment.solver.makes_steps or not scene.loads:
        return
    from pbdkit.equilibrium.sparse import DRIFTS

    for part in pushed_parts(scene):
        named = f"{part.particles} particles (with number {part.first})"
        error = ExperimentError(DRIFTS.format(named), ("leaders",))
        raise scene.experiment.located(error)


def _unheld(scene: Scene) -> list[str]:
    """A warning for each part of the body that loads push on step by step."""
    if not (scene.loads and scene.experiment.solver.makes_steps):
        return []

    return [
        f"loads: nothing holds a part of {part.particles} particles (with number {part.first}) "
        "against them, so that it moves on in every step; let a leader hold it"
        for part in pushed_parts(scene)
    ]


def outlook(scene: Scene) -> list[str]:
    """What `check` warns of besides `quick_warnings` and is known in less than a second: whether
    loads find supports, and of small bodies what stands in the way of settling."""
    found = _unheld(scene)
    if scene.raster.count > LOOKED_AT or not scene.experiment.solver.makes_steps:
        return found
    from pbdkit.stability.analysis import Analysis

    analysis = Analysis(scene)
    with suppress(PbdkitError):  # where it is not known `check` says why
        found += [*analysis.obstructions(), *_too_short(analysis)]
    return found


def refuse_too_much_output(scene: Scene) -> None:
    """Raises ExperimentError where the records of a run cannot all be in memory at once."""
    sizes = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.total)
    if sizes.output > machine_memory():
        raise scene.experiment.located(
            ExperimentError(
                f"the records take {sizes.output / 2**30:.3g} GiB, more than this machine's "
                "memory: record fewer steps, or stream them into a file with `pbdkit run`, or in "
                "Python with run(..., output='run.nc')",
                ("record",),
            )
        )


MOST_PARTICLES = 20_000
"""Larger bodies are looked at as one part."""
IS_ZERO, DOES_WORK = 1e-13, 1e-9
"""Shares of the largest eigenvalue of the supports, and of the forces and their levers."""


@dataclass(frozen=True)
class PushedPart:
    """A part of the body that loads push on for ever: how many of its particles follow, and the
    number of the first of these."""

    particles: int
    first: int


def pushed_parts(scene: Scene) -> list[PushedPart]:
    """Return the parts that loads push on for ever at the last step, as far as supports tell:
    nothing is told of obstacles, and of frames and rules that resist rigid motions."""
    rule, frame = scene.experiment.rule, scene.experiment.frame
    if not scene.loads or scene.axes != 2 or scene.barriers:
        return []
    if not isinstance(rule, Calibrated) or isinstance(frame, Anchors):
        return []
    raster = scene.raster
    place = raster.place_of(raster.body_rows)
    x = raster.reference(raster.body_rows)
    step = scene.experiment.steps
    forces = scene.loads.at(step, np.float64).reshape(2, -1)[:, place].T.astype(np.float64)
    held = np.zeros((2, int(np.prod(raster.shape))), bool)
    for leading in scene.leading:
        for axis in leading.axes if leading.group.leads(step) else ():
            held[axis, leading.place] = True
    # Only linear rules turn without resistance, however far; frames that copy the body resist it.
    modes = 3 if rule.linear and (scene.frame is None or frame.weighs_cells) else 2
    return [
        PushedPart(len(following), raster.before + int(raster.body_rows[following[0]]) + 1)
        for rows in _parts(scene)
        if _is_pushed(x[rows], held[:, place[rows]].T, forces[rows], modes)
        and len(following := rows[~held[:, place[rows]].all(axis=0)])
    ]


def _parts(scene: Scene) -> Iterator[Indices]:
    """The body's particles, as rows of the body, of each part that bonds connect."""
    rows = scene.raster.body_rows
    if len(rows) > MOST_PARTICLES:
        yield np.arange(len(rows))
        return
    of_body = np.full(scene.raster.count, -1)
    of_body[rows] = np.arange(len(rows))
    ends = of_body[scene.bonds.ends]
    ends = ends[(ends >= 0).all(axis=1)]
    # Imported here: only bodies in several parts need it, and scipy takes long to import.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    graph = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(rows), len(rows)))
    count, label = connected_components(graph, directed=False)
    for n in range(count):
        yield np.flatnonzero(label == n)


def _is_pushed(x: Floats, held: Mask, forces: Floats, modes: int) -> bool:
    """Whether forces (particle, axis) do work along a rigid motion that is not `held` (particle,
    axis) at any particle."""
    middle, size = x.mean(axis=0), float(np.ptp(x, axis=0).max()) or 1.0
    lever = (x - middle) / size
    motions = np.zeros((len(x), 2, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -lever[:, 1], lever[:, 0]
    motions = motions[:, :, :modes]
    rows = motions[held]
    eigenvalues, vectors = np.linalg.eigh(rows.T @ rows)
    left = vectors[:, eigenvalues <= IS_ZERO * max(1.0, float(eigenvalues[-1]))]
    work = np.einsum("pa,pam->m", forces, motions) @ left
    return bool((np.abs(work) > DOES_WORK * np.abs(forces).sum()).any())
