"""Choice of the engine and the number of threads for a scene, with the reason for the choice.
Engines that are not chosen are not imported."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from importlib.util import find_spec

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numba_engine.time_skewing import exceeds_cache, single_steps
from pbdkit.stepping.numpy_engine import Engine, Stepper
from pbdkit.stepping.program import last_event, reason_against
from pbdkit.stepping.step import Mode


def missing_for_gpu() -> str:
    """Return the package, compiler or device that a GPU engine lacks; empty if it lacks none."""
    install = "pip install 'pbdkit[gpu]'"
    if not (find_spec("numba") and find_spec("numba_cuda")):
        return f"numba-cuda is not installed: {install}"
    from numba import cuda

    if cuda.config.ENABLE_CUDASIM:
        return ""
    if not cuda.is_available():
        return "there is no NVIDIA GPU, or its driver is missing"
    return "" if cuda.cudadrv.nvvm.is_available() else f"the CUDA compiler is missing: {install}"


def gpu_obstacle(scene: Scene) -> str:
    """Return the reason why a scene cannot be stepped on a GPU; empty if it can."""
    return reason_against(scene, Mode.GPU)


PATIENCE_S = 3.0
"""If the numpy engine is estimated to need more than this time, in seconds, the compiled engine is
faster in total. It was measured that numba needs .5 s to be imported and to load a kernel, and 1 to
5 s to compile one."""
CALL_S = 25e-6
"""Time of the numpy engine for each step and slot, in seconds (measured)."""
VALUE_S = 2.5e-9
"""Time of the numpy engine for each step, slot and particle, in seconds (measured)."""
KERNEL_S = 2e-9
"""Time of kernels for each step and particle, in seconds (measured: 1 to 2 ns, with 4 or 8
neighbours in motion)."""
MIN_PARTICLES_OF_TWO_THREADS = 100_000
"""Number of particles from which two threads are faster than one. The measured value is 40 000; a
margin is added."""


@dataclass(frozen=True)
class Choice:
    """Name of an engine, number of threads, and the reason for the choice."""

    engine: str
    threads: int
    reason: str


def choose(scene: Scene) -> Choice:
    """Return the engine that the experiment requests, or the fastest.

    `auto` never selects the GPU: its speed has not been measured. Raises ExperimentError if a
    requested engine is not available.
    """
    solver = scene.experiment.stepping
    if solver.engine == "gpu":
        missing = missing_for_gpu() or gpu_obstacle(scene) or kernel_obstacle(scene)
        _refuse(
            scene, missing and f"the GPU engine is not available: {missing}; use `engine: auto`"
        )
        return Choice("gpu", 1, "requested")
    hindrance = obstacle() or kernel_obstacle(scene)
    if solver.engine == "compiled":
        _refuse(
            scene,
            hindrance and f"the compiled engine is not available: {hindrance}; use `engine: auto`",
        )
    if solver.engine == "numpy":
        return Choice("numpy", 1, "requested")
    seconds = _numpy_seconds(scene)
    if solver.engine == "auto" and seconds < PATIENCE_S:
        return Choice("numpy", 1, f"{_about(seconds)} in total; compiling would take longer")
    if hindrance:
        return Choice("numpy", 1, f"the compiled engine is not available: {hindrance}")
    threads = solver.threads
    if threads == "auto":
        threads = processors() if scene.raster.total >= MIN_PARTICLES_OF_TWO_THREADS else 1
    reason = "requested" if solver.engine == "compiled" else f"numpy would take {_about(seconds)}"
    return Choice("compiled", threads, reason + _about_passes(scene))


def _refuse(scene: Scene, refusal: str) -> None:
    if refusal:
        raise scene.experiment.located(ExperimentError(refusal, ("solver", "engine")))


def seconds_of(scene: Scene, choice: Choice) -> float:
    """Return an upper estimate of the time of the steps in seconds, without compilation and
    recording."""
    if choice.engine == "numpy":
        return _numpy_seconds(scene)
    return KERNEL_S * scene.raster.total * _max_steps(scene) / choice.threads


def make_engine(scene: Scene, choice: Choice) -> tuple[Engine, Choice]:
    """Return the engine and the choice. If the engine was chosen by `auto` and the compiled engine
    fails, both are replaced by the numpy engine."""
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
        reason = f"the compiled engine is not available: {str(error).splitlines()[0]}"
        return Stepper(scene), Choice("numpy", 1, reason)


def chosen_engine(scene: Scene) -> Engine:
    """Return the engine that is chosen for a scene."""
    return make_engine(scene, choose(scene))[0]


def obstacle() -> str:
    """Return the reason why the compiled engine is not available; empty if it is."""
    return "" if find_spec("numba") else "numba is not installed: pip install 'pbdkit[fast]'"


def kernel_obstacle(scene: Scene) -> str:
    """Return the reason why kernels do not support the time-dependent parameters of a scene; empty
    if they do, or if there are none."""
    fields = {field for field, _ in scene.experiment.time_dependent}
    mode = Mode.TIME_DEPENDENT_SOLVER if fields == {"solver"} else Mode.TIME_DEPENDENT
    return reason_against(scene, mode) if fields else ""


def _about_passes(scene: Scene) -> str:
    """Return the reason if several steps in a pass over the memory would be faster but are not
    possible; otherwise return an empty text."""
    why = exceeds_cache(scene) and single_steps(scene)
    return f"; one step per pass over the memory: {why}" if why else ""


def _numpy_seconds(scene: Scene) -> float:
    """Return an upper estimate of the time of the numpy engine in seconds."""
    slots = sum(map(len, scene.neighbourhood.slots)) * (2 if scene.has_fracture else 1)
    a_step = slots * (CALL_S + VALUE_S * scene.raster.total / len(scene.neighbourhood.slots))
    return a_step * _max_steps(scene)


def _max_steps(scene: Scene) -> float:
    """Return an upper estimate of the number of steps. It is the number of steps of the run. For a
    run until convergence it is (2n)² (2/π)² ln(1 / tolerance), the estimate for the barycentre rule
    on a body of n cells with one fixed end."""
    steps, criterion = float(scene.experiment.steps), scene.experiment.stepping.settle
    if criterion is None:
        return steps
    steps_to_convergence = (4 * max(scene.raster.whole_shape[1:]) / math.pi) ** 2 * -math.log(
        criterion.tolerance
    )
    return min(steps, last_event(scene) + steps_to_convergence)


def _about(seconds: float) -> str:
    return f"about {seconds:.1g} s" if seconds < 10.0 else f"about {seconds:.0f} s"


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
