"""Forecast of a run before its first step: stability, supports, memory and time.

`pbdkit check` reports the forecast, and `pbdkit run` issues those of its warnings that are computed
quickly.

Two of the checks need an explanation. The steps of leaders with a mass are stable if their angular
frequency ω is at most 2, which is the limit of the symplectic Euler method with a step of 1. A part
of the body resists rigid-body motions only by means of its supports. If leaders do not constrain
such a motion and the loads do work along it, there is no equilibrium, and steps do not converge.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.errors import (
    ExperimentError,
    PbdkitError,
    StabilityWarning,
    WarningText,
    of_category,
)
from pbdkit.lattice.neighbourhood import count_bonds
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.linear.spectrum import NEUTRAL
from pbdkit.linear.stencil import Bound, bounds_the_body, stability_remedy, wave_bound
from pbdkit.memory import machine_memory
from pbdkit.model.motions import Newton
from pbdkit.plugin import Anchors, Calibrated, StoresEnergy
from pbdkit.plugin.units import LENGTH
from pbdkit.plugin.vector import vector
from pbdkit.scene.leader_groups import kinds_at, kinds_of_places
from pbdkit.scene.memory_estimate import LARGEST_REPEATED, MIB, Sizes, sizes_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.divergence import largest_offset
from pbdkit.stepping.engine_choice import choose, seconds_of
from pbdkit.stepping.leaders import NewtonForces
from pbdkit.stepping.rule_evaluation import Evaluator
from pbdkit.stepping.state import initial_state

if TYPE_CHECKING:
    from pbdkit.stability.analysis import Analysis


NUDGE = 1e-3
"""Displacement by which the stiffness against a leader group is measured, in lattice units."""


def too_light(scene: Scene) -> list[str]:
    """Warn of leader groups with a mass that is too small for stable steps, even if all other
    particles were fixed."""
    forces, warnings = NewtonForces(scene), []
    state = initial_state(scene) if forces.numbers else None
    for n in forces.numbers:
        motion = scene.leading[n].group.motion
        assert state
        assert isinstance(motion, Newton)
        lightest = motion.lightest(forces.stiffness(n, state, NUDGE))
        if motion.mass < lightest:
            warnings.append(
                f"leaders.{n}.motion.mass: {motion.mass:g} is too small, so that its oscillation "
                f"can grow without bound; steps are stable from a mass of {lightest:.4g} on"
            )
    return warnings


@dataclass(frozen=True)
class Forecast:
    """Forecast of a run.

    Results of the stability analysis are None if they do not exist or would take too long to
    compute.

    Parameters
    ----------
    particles, bonds
        Numbers of particles and bonds.
    followers
        Number of followers in step 1.
    memory_mib, output_mib
        Memory of the run and size of its output, in MiB.
    seconds
        Estimated duration of the steps; None for an equilibrium.
    relaxation, memory
        Parameters of the solver.
    spectral_radius, smallest_eigenvalue, largest_stable_relaxation, stable, steps_to
        See `pbdkit.Analysis`.
    period, decay
        Period in steps, and decay per step, of the slowest oscillating mode; None if there is no
        momentum or no mode oscillates.
    exact
        True if the analysis holds for the whole run. False if it is a linearisation at the start.
    estimated
        True if the spectrum is an estimate. The accuracy of 1 - ρ is then 1 %.
    lag, lag_reached
        Largest distance of a follower from its equilibrium in the steps in which the leaders move
        fastest, in lattice units. `lag` is the constant distance that is reached after long motion
        at this speed, and `lag_reached` the distance at the end of these steps. Both are None if no
        leader moves at constant speed.
    size_mm
        Extent of the body's particles along each axis in mm; None without `units`.
    warnings
        Warnings, a sentence each.
    """

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
        """Return the forecast as plain values for JSON."""
        return asdict(self)


QUICK_PARTICLES = 2000
"""Number of particles up to which `pbdkit run` makes the same analysis as `pbdkit check`, which
takes at most 0.9 s."""
MAX_CHANGES = 16
"""Maximum number of analyses with different values of time-dependent parameters."""
ANALYSIS_FIELDS = (
    *("spectral_radius", "smallest_eigenvalue", "largest_stable_relaxation", "stable", "steps_to"),
    *("exact", "estimated"),
)
"""Fields of a forecast that have the same names in the analysis."""

OBSTACLES_IGNORED = (
    "obstacles: stability and convergence are those of the body without them; supports by "
    "obstacles are not considered",
)
"""Warning for scenes with obstacles."""


def forecast(scene: Scene) -> Forecast:
    """Compute the forecast of a scene."""
    from pbdkit.stability.analysis import Analysis

    kinds = kinds_at(scene.raster, scene.leading, 1)
    analysis, solver = Analysis(scene), scene.experiment.stepping
    makes_steps = scene.experiment.solver.makes_steps
    sizes = _sizes(analysis)
    mode = analysis.oscillation(solver.relaxation, solver.memory) if solver.memory else None
    # Deformations change the eigenvalues of nonlinear rules. Their limit is that of plane waves, as
    # in the warnings of a run, if it is lower than that of the body at rest.
    nonlinear = not scene.experiment.rule.linear
    bound = wave_bound(scene) if nonlinear or not analysis.spectrum else None
    fields = {name: getattr(analysis, name) for name in ANALYSIS_FIELDS}
    limit = bound.largest_stable_relaxation(solver.memory) if bound else None
    if limit and (limit_at_rest := analysis.largest_stable_relaxation):
        fields["largest_stable_relaxation"] = min(limit, limit_at_rest)
    return Forecast(
        particles=scene.raster.count,
        followers=int(np.count_nonzero(kinds == FOLLOWER)),
        bonds=count_bonds(scene.raster, scene.neighbourhood),
        memory_mib=round(sizes.memory / MIB, 3),
        output_mib=round(sizes.output / MIB, 3),
        seconds=_seconds(scene),
        relaxation=solver.relaxation,
        memory=solver.memory,
        period=mode.period if mode else None,
        decay=mode.decay if mode else None,
        lag=analysis.distance,
        lag_reached=analysis.leader_distance.reached if analysis.leader_distance else None,
        size_mm=_size_mm(scene),
        warnings=[
            *_scene_warnings(scene),
            *_missing_supports(scene),
            *OBSTACLES_IGNORED[: len(scene.barriers)],
            # An equilibrium does not need the results of the analysis that take too long.
            *(analysis.warnings() if makes_steps else analysis.obstructions()),
            *_divergence_in_time(scene),
            *_too_short(analysis),
            *_growing_waves(scene, bound),
        ],
        **fields,
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
    """Estimate the sizes of a run. For the equilibrium of a large body they depend on the linear
    solver."""
    scene = analysis.scene
    count, grids = scene.raster.count, not scene.barriers
    if grids and count > LARGEST_REPEATED and not scene.experiment.solver.makes_steps:
        grids = analysis.spectra.estimate.system(scene.experiment.steps) is not None
    return sizes_of(scene.experiment, scene.neighbourhood, count, grids=grids)


def quick_warnings(scene: Scene, bound: Bound | None) -> tuple[str, ...]:
    """Return the warnings that are computed within milliseconds, given the bound of plane waves."""
    return (*_scene_warnings(scene), *_growing_waves(scene, bound))


def prediction(scene: Scene, bound: Bound | None) -> dict[str, Any]:
    """Return the attributes of the dataset that predict stability. They are computed from the bound
    of plane waves.

    Without a bound there are no attributes. `stable` is None if no plane wave grows, but plane
    waves do not bound the modes of the body.
    """
    memory = scene.experiment.stepping.memory
    if bound is None:
        return {}
    return {
        "stable": bound.radius <= 1.0 + NEUTRAL and (bounds_the_body(scene) or None),
        "largest_stable_relaxation": bound.largest_stable_relaxation(memory),
        "smallest_eigenvalue": bound.smallest,
    }


def _too_short(analysis: Analysis) -> list[str]:
    """Warn of a run that ends long before the body converges under its loads."""
    experiment, steps_needed = analysis.scene.experiment, analysis.steps_to["1e-3"]
    if not (experiment.loads and experiment.solver.makes_steps and steps_needed):
        return []
    if experiment.stepping.settle or steps_needed <= experiment.steps:
        return []
    return [
        f"steps: under its loads the body converges in about {steps_needed} steps, but the run has "
        f"{experiment.steps}; use solver: {{type: equilibrium}}, memory: auto, or more steps"
    ]


def _divergence_in_time(scene: Scene) -> list[str]:
    """Warn of steps that diverge for values that time-dependent parameters have before the end of
    the run."""
    from pbdkit.stability.analysis import Analysis

    time_dependent, steps = scene.experiment.time_dependent, scene.experiment.steps
    breakpoints = sorted(
        {min(knot, steps) for number in time_dependent.values() for knot in number.breakpoints}
    )
    moments = [n for n in breakpoints if any(c.at(n) != c.last for c in time_dependent.values())]
    warnings = list[str]()
    for moment in moments[:MAX_CHANGES] if scene.experiment.solver.makes_steps else ():
        if Analysis(scene.at(moment)).stable is False:
            values = (
                f"{'.'.join(at)} {number.at(moment):g}" for at, number in time_dependent.items()
            )
            warnings.append(
                f"{min(time_dependent)[0]}: at step {moment} steps diverge, with "
                f"{', '.join(values)}"
            )
    if len(moments) > MAX_CHANGES:
        warnings.append(
            f"analysis: only the first {MAX_CHANGES} of {len(moments)} changes in time were "
            "analysed"
        )
    return warnings


def _scene_warnings(scene: Scene) -> list[str]:
    sizes = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.total)
    warnings = list(scene.warnings)
    followers = kinds_of_places(scene.raster, scene.leading, 1) == FOLLOWER
    if not scene.raster.communicator.any(followers.any()):
        warnings.append("leaders: all particles are leaders in step 1; there are no followers")
    for n, leading in enumerate(scene.leading):
        if leading.group.from_ > scene.experiment.steps:
            warnings.append(f"leaders.{n}: starts after the last step of the run")
    for n, load in enumerate(scene.experiment.loads):
        if load.from_ > scene.experiment.steps:
            warnings.append(f"loads.{n}: starts after the last step of the run")
    warnings += of_category(StabilityWarning, too_light(scene))
    for n, barrier in enumerate(scene.barriers):
        if barrier.group.from_ > scene.experiment.steps:
            warnings.append(f"obstacles.{n}: starts after the last step of the run")
    if not (scene.driven or scene.loads):
        warnings.append(
            "leaders: the experiment has neither leaders nor loads, so that nothing moves"
        )
    if sizes.output > machine_memory():
        warnings.append(
            f"record: the output of {sizes.output / 2**30:.3g} GiB exceeds this machine's memory; "
            "record fewer steps to open it at once"
        )
    return [*warnings, *_stress_of_nonlinear_rules(scene)]


NONLINEAR = 0.01
"""Relative deviation of the energy of bonds from a quadratic one up to which linear elasticity is
accurate enough for stresses."""
STRAIN_OF_LOADS = 0.01
"""Strain at which rules are examined if the strain that loads cause is not known."""


def _stress_of_nonlinear_rules(scene: Scene) -> list[str]:
    """Warn of diagnostics that compute stresses by linear elasticity, if the bonds of the rule are
    not linear at the strains that leaders prescribe."""
    rule = scene.experiment.rule
    diagnostics = [
        (n, part.type)
        for n, part in enumerate(scene.experiment.diagnostics)
        if "material" in part.needs
    ]
    if not (diagnostics and isinstance(rule, StoresEnergy)):
        return []
    strain = max(_prescribed_strain(scene), STRAIN_OF_LOADS * bool(scene.loads))
    ratio = 1.0
    with suppress(Exception), np.errstate(all="ignore"):  # The run reports the error.
        ratio = _energy_ratio(scene, strain)
    if not abs(ratio - 1.0) > NONLINEAR:
        return []
    return [
        f"diagnostics.{n}: '{kind}' is computed from strains by the linear elasticity of the rule, "
        f"but at a strain of {strain:.2g}, as leaders or loads can cause, bonds of the rule "
        f"'{rule.type}' have {ratio:.3g} times the energy of linear elasticity; use "
        "'stress-strain', 'reaction' and 'strain-energy', which use the forces of the rule"
        for n, kind in diagnostics
    ]


def _prescribed_strain(scene: Scene) -> float:
    """Return the largest motion of a leader group, relative to the size of the body."""
    ends, raster = scene.raster.body_ends(), scene.raster
    local = [largest_offset(leading, scene.experiment.steps) for leading in scene.driven]
    offsets = np.max(raster.communicator.allgather(local), axis=0)
    return float(np.max(offsets, initial=0.0) / max(1e-300, np.abs(ends[1] - ends[0]).max()))


def _energy_ratio(scene: Scene, strain: float) -> float:
    """Return the energy of a bond at a strain, divided by the quadratic one with the same energy at
    small strains. Of all bonds, under tension and compression, the ratio that differs most from 1
    is returned."""
    evaluator, still = Evaluator(scene), vector(np.zeros(scene.axes))
    ratios = [1.0]
    for slots in scene.neighbourhood.slots:
        for slot, to in zip(slots, evaluator.everywhere(slots), strict=True):
            small, *large = (
                np.asarray(evaluator.energy(slot.rest * size, still, to)[0])
                for size in (SMALL * strain, strain, -strain)
            )
            ratios += [float(np.max(energy * SMALL**2 / small)) for energy in large]
    return max(ratios, key=lambda ratio: abs(ratio - 1.0))


SMALL = 1e-3
"""Fraction of a strain at which the energy is quadratic."""


def _growing_waves(scene: Scene, bound: Bound | None) -> list[str]:
    solver = scene.experiment.stepping
    if bound is None or bound.radius <= 1.0 + NEUTRAL:
        return []
    stable = bound.largest_stable_relaxation(solver.memory)
    if stable and not scene.experiment.solver.makes_steps:
        return []
    remedy = stability_remedy(stable, solver.memory)
    grows = f"can diverge, since some waves grow by {bound.radius:.4g} per step"
    text = f"solver.relaxation: {solver.relaxation:g} {grows}{remedy}"
    return [WarningText(text, StabilityWarning)]


def refuse_unheld_loads(scene: Scene) -> None:
    """Raise the ExperimentError that the run would raise if loads act on a part of the body without
    supports.

    The check applies only to the solver `equilibrium`, because a part without supports has no
    equilibrium under loads.
    """
    if scene.experiment.solver.makes_steps or not scene.loads:
        return
    from pbdkit.equilibrium.sparse import DRIFTS

    for part in pushed_parts(scene):
        text = f"{part.particles} particles (with number {part.first})"
        error = ExperimentError(DRIFTS.format(text), ("leaders",))
        raise scene.experiment.located(error)


def _missing_supports(scene: Scene) -> list[str]:
    """Warn of each part of the body that is not supported against the loads, so that they would
    displace it without bound."""
    if not (scene.loads and scene.experiment.solver.makes_steps):
        return []

    return [
        f"loads: a part of {part.particles} particles (with number {part.first}) is loaded, but "
        "not constrained, so that its displacement grows in every step; constrain it with a "
        "leader group"
        for part in pushed_parts(scene)
    ]


def further_warnings(scene: Scene) -> list[str]:
    """Return warnings that are computed within a second, in addition to `quick_warnings`.

    The warnings concern missing supports and, for small bodies, the reasons why steps do not
    converge.
    """
    warnings = _missing_supports(scene)
    if scene.raster.count > QUICK_PARTICLES or not scene.experiment.solver.makes_steps:
        return warnings
    from pbdkit.stability.analysis import Analysis

    analysis = Analysis(scene)
    with suppress(PbdkitError):  # `pbdkit check` reports the reason.
        warnings += [*analysis.obstructions(), *_too_short(analysis)]
    return warnings


def refuse_too_much_output(scene: Scene) -> None:
    """Raise ExperimentError if the records of a run would exceed the memory."""
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


MAX_PARTICLES = 20_000
"""Number of particles above which the body is assumed to be connected."""
IS_ZERO = 1e-13
"""Relative tolerance up to which an eigenvalue of the matrix of the supports counts as zero."""

DOES_WORK = 1e-9
"""Relative tolerance up to which the work of the forces counts as zero."""


@dataclass(frozen=True)
class PushedPart:
    """Part of the body that is not supported against the loads, so that they would displace it
    without bound.

    Parameters
    ----------
    particles
        Number of followers in the part.
    first
        Particle number of the first of these followers.
    """

    particles: int
    first: int


def pushed_parts(scene: Scene) -> list[PushedPart]:
    """Return the parts of the body that are not supported against the loads of the last step.

    Only leaders are considered as supports. The result is empty for scenes with obstacles, and if
    the frame or the rule resists rigid motions.
    """
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
    is_prescribed = np.zeros((2, int(np.prod(raster.shape))), bool)
    for leading in scene.leading:
        for axis in leading.axes if leading.group.leads(step) else ():
            is_prescribed[axis, leading.place] = True
    # Rotations are included only for rules under which large rotations meet no resistance, and
    # without frame points, because frames that copy the displacements of the body resist rotations.
    modes = 3 if rule.linear and (scene.frame is None or frame.weighs_cells) else 2
    return [
        PushedPart(len(followers), raster.particle_offset + int(raster.body_rows[followers[0]]) + 1)
        for rows in _parts(scene)
        if _is_pushed(x[rows], is_prescribed[:, place[rows]].T, forces[rows], modes)
        and len(followers := rows[~is_prescribed[:, place[rows]].all(axis=0)])
    ]


def _parts(scene: Scene) -> Iterator[Indices]:
    """Yield, for each connected part, the indices of its particles among the particles of the
    body."""
    rows = scene.raster.body_rows
    if len(rows) > MAX_PARTICLES:
        yield np.arange(len(rows))
        return
    body_row = np.full(scene.raster.count, -1)
    body_row[rows] = np.arange(len(rows))
    ends = body_row[scene.bonds.ends]
    ends = ends[(ends >= 0).all(axis=1)]
    # Imported here, because scipy takes long to import and is needed only if the body has several
    # parts.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    graph = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(rows), len(rows)))
    count, label = connected_components(graph, directed=False)
    for n in range(count):
        yield np.flatnonzero(label == n)


def _is_pushed(x: Floats, is_prescribed: Mask, forces: Floats, modes: int) -> bool:
    """Return whether forces do work along a rigid motion that is not constrained.

    Parameters
    ----------
    x, forces : (particle, axis)
        Positions and forces.
    is_prescribed : (particle, axis)
        Whether the displacement is prescribed.
    modes
        Number of rigid motions: 3 including the rotation, 2 without it.
    """
    middle, size = x.mean(axis=0), float(np.ptp(x, axis=0).max()) or 1.0
    lever = (x - middle) / size
    motions = np.zeros((len(x), 2, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -lever[:, 1], lever[:, 0]
    motions = motions[:, :, :modes]
    rows = motions[is_prescribed]
    eigenvalues, vectors = np.linalg.eigh(rows.T @ rows)
    unconstrained = vectors[:, eigenvalues <= IS_ZERO * max(1.0, float(eigenvalues[-1]))]
    work = np.einsum("pa,pam->m", forces, motions) @ unconstrained
    return bool((np.abs(work) > DOES_WORK * np.abs(forces).sum()).any())
