"""The choice of the engine that steps a scene, on how many threads, and why; and what stands in
the way of the others, found without loading them.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from importlib.util import find_spec

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.scene.scene import Scene
from pbdkit.stepping.leaders import last_event
from pbdkit.stepping.numba_engine.time_skewing import exceeds_cache, single_steps
from pbdkit.stepping.numpy_engine import Engine, Stepper
from pbdkit.stepping.program import reason_against
from pbdkit.stepping.step import Mode


def what_is_missing() -> str:
    """The package, the compiler or the device that is not there; empty where all are."""
    install = "pip install 'pbdkit[gpu]'"
    if not (find_spec("numba") and find_spec("numba_cuda")):
        return f"numba-cuda is not installed: {install}"
    from numba import cuda

    if cuda.config.ENABLE_CUDASIM:
        return ""
    if not cuda.is_available():
        return "there is no GPU, or no driver of NVIDIA's for it"
    return "" if cuda.cudadrv.nvvm.is_available() else f"CUDA's compiler is missing: {install}"


def what_gpus_lack(scene: Scene) -> str:
    """Why a scene cannot be stepped on a GPU; empty where it can."""
    return reason_against(scene, Mode.GPU)


PATIENCE_S = 3.0
"""Compiling pays where the numpy engine would take longer than about this (measured: importing
numba and loading a kernel .5 s, making a new one 1 to 5 s)."""
CALL_S, VALUE_S = 25e-6, 2.5e-9
"""What the numpy engine takes a step and slot, and a step, slot and particle (measured)."""
KERNEL_S = 2e-9
"""What kernels take a step and particle (measured: 1 to 2, with 4 or 8 neighbours in motion)."""
TWO_THREADS_PAY = 100_000
"""Particles from which a second thread pays, with a margin (measured: from 40 000)."""


@dataclass(frozen=True)
class Choice:
    """The engine's name, its threads, and the reason in words."""

    engine: str
    threads: int
    reason: str


def choose(scene: Scene) -> Choice:
    """What the experiment asks for, or what serves it best.

    `auto` never takes the GPU: how fast that is has not been measured. Raises ExperimentError where
    an engine is asked for that cannot be had.
    """
    solver = scene.experiment.stepping
    if solver.engine == "gpu":
        lacks = what_is_missing() or what_gpus_lack(scene) or what_kernels_lack(scene)
        _refuse(scene, lacks and f"the GPU engine cannot be had: {lacks}; take `engine: auto`")
        return Choice("gpu", 1, "asked for")
    hindrance = obstacle() or what_kernels_lack(scene)
    if solver.engine == "compiled":
        _refuse(scene, hindrance and f"the compiled engine cannot be had: {hindrance}")
    if solver.engine == "numpy":
        return Choice("numpy", 1, "asked for")
    seconds = _numpy_seconds(scene)
    if solver.engine == "auto" and seconds < PATIENCE_S:
        return Choice("numpy", 1, f"{_about(seconds)} in all: compiling would take longer")
    if hindrance:
        return Choice("numpy", 1, f"slower than it could be: {hindrance}")
    threads = solver.threads
    if threads == "auto":
        threads = processors() if scene.raster.total >= TWO_THREADS_PAY else 1
    reason = "asked for" if solver.engine == "compiled" else f"numpy would take {_about(seconds)}"
    return Choice("compiled", threads, reason + _about_passes(scene))


def _refuse(scene: Scene, refusal: str) -> None:
    if refusal:
        raise scene.experiment.located(ExperimentError(refusal, ("solver", "engine")))


def seconds_of(scene: Scene, choice: Choice) -> float:
    """About what the steps take at most, with neither compiling nor recording."""
    if choice.engine == "numpy":
        return _numpy_seconds(scene)
    return KERNEL_S * scene.raster.total * _most_steps(scene) / choice.threads


def make_engine(scene: Scene, choice: Choice) -> tuple[Engine, Choice]:
    """The engine, and what it came to: where `auto` meets a rule that does not compile, numpy."""
    if choice.engine == "numpy":
        return Stepper(scene), choice
    if choice.engine == "gpu":
        from pbdkit.stepping.cuda_engine import GpuStepper

        return GpuStepper(scene), choice
    from pbdkit.stepping.numba_engine.engine import CompiledStepper

    try:
        return CompiledStepper(scene, choice.threads), choice
    except PluginError as error:
        if scene.experiment.stepping.engine == "compiled":
            raise
        reason = f"slower than it could be: {str(error).splitlines()[0]}"
        return Stepper(scene), Choice("numpy", 1, reason)


def chosen_engine(scene: Scene) -> Engine:
    """The engine that serves a scene."""
    return make_engine(scene, choose(scene))[0]


def obstacle() -> str:
    """Why the compiled engine cannot be had; empty where it can."""
    return "" if find_spec("numba") else "numba is not installed: pip install 'pbdkit[fast]'"


def what_kernels_lack(scene: Scene) -> str:
    """Why no kernel can follow the courses of a scene's numbers; empty where one can, and where
    there are none."""
    experiment, constants = scene.experiment, scene.constants
    changing = {field for field, _ in experiment.courses}
    if changing <= {"solver"}:
        return reason_against(scene, Mode.SOLVER_COURSES) if changing else ""
    if reason := reason_against(scene, Mode.COURSES):
        return reason
    if constants.by_particle or constants.by_bond or (scene.cells and scene.cells.mixed):
        return "numbers differ from place to place and others change in time"
    for moment in sorted({bend for course in experiment.courses.values() for bend in course.bends}):
        if _differ_in_kernels(scene, scene.at(moment)):
            return "numbers change in time that are written into kernels"
    return ""


def _differ_in_kernels(scene: Scene, now: Scene) -> bool:
    """Whether a scene with other numbers has other constants in its kernels, inner rules
    included."""
    one, other = scene.constants, now.constants
    if (one.weights, one.fracture) != (other.weights, other.fracture):
        return True
    if scene.inner is None or now.inner is None:
        return False
    return _differ_in_kernels(scene.inner, now.inner)


def _about_passes(scene: Scene) -> str:
    """Why each step goes over the memory by itself, where several in a pass would gain."""
    why = exceeds_cache(scene) and single_steps(scene)
    return f"; one step a pass over the memory: {why}" if why else ""


def _numpy_seconds(scene: Scene) -> float:
    """What the numpy engine takes at most."""
    slots = sum(map(len, scene.neighbourhood.slots)) * (2 if scene.has_fracture else 1)
    a_step = slots * (CALL_S + VALUE_S * scene.raster.total / len(scene.neighbourhood.slots))
    return a_step * _most_steps(scene)


def _most_steps(scene: Scene) -> float:
    """Those asked for. A run that is to settle makes no more steps than a plain barycentre on a
    body of n cells that is held at one end, (2n)² (2/π)² ln(1 / tolerance)."""
    steps, settle = float(scene.experiment.steps), scene.experiment.stepping.settle
    if settle is None:
        return steps
    settled = (4 * max(scene.raster.whole_shape[1:]) / math.pi) ** 2 * -math.log(settle.tolerance)
    return min(steps, last_event(scene) + settled)


def _about(seconds: float) -> str:
    return f"about {seconds:.1g} s" if seconds < 10.0 else f"about {seconds:.0f} s"


def processors() -> int:
    """Those that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
