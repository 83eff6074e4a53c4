"""What a scene comes to on a GPU: the source of its kernel, and the arrays that it begins with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import Arrays, bits_for, state_arrays
from pbdkit.stepping.compiled.leading import leading_arrays
from pbdkit.stepping.compiled.levels import levels_of
from pbdkit.stepping.compiled.plan import Plan
from pbdkit.stepping.gpu.arguments import flattened, steady_arrays
from pbdkit.stepping.gpu.emitter import write_kernel
from pbdkit.stepping.state import State, unmoved_state

ALONE = 4096
"""Places up to which one block makes all steps, whose threads wait for each other in no time
(estimated, not measured)."""


@dataclass(frozen=True)
class Program:
    """`names` are those of the arrays that the kernel takes, and `alone` whether it is for one
    block."""

    plan: Plan
    source: str
    names: list[str]
    arrays: Arrays
    alone: bool


def program_of(scene: Scene) -> Program:
    """The kernel that steps a scene, not yet compiled."""
    plan = Plan(scene, levels_of(scene), parallel=False, gpu=True)
    steady, whole = steady_arrays(plan)
    start = unmoved_state(scene, scene.raster.shape[1:])
    inner = [name for n in range(len(plan.levels) - 1) for name in plan.each(f"z{n}_@")]
    arrays = {name: np.zeros(scene.raster.shape, start.u.dtype) for name in inner}
    arrays |= {f"was{m}": np.zeros_like(start.particle_values[m]) for m in plan.kept}
    if plan.judged:
        arrays["lost"] = np.zeros(scene.raster.shape, bits_for(scene))
    if plan.tears:
        arrays["torn"] = np.zeros(scene.raster.shape, np.uint8)
    if scene.loads:
        arrays |= dict.fromkeys(plan.each("load_@"), np.zeros(scene.raster.shape, start.u.dtype))
    found = flattened(steady | arrays) | changing_planes(plan, start)
    found |= leading_arrays(plan, [[]], {}, start.u.dtype)
    alone = scene.raster.kind.size <= ALONE
    source, names = write_kernel(replace(plan, shared=("step", *found)), whole, alone)
    return Program(plan, source, names, {name: found[name] for name in names}, alone)


def changing_planes(plan: Plan, state: State) -> Arrays:
    """What steps change of a state, where its arrays are."""
    held = state_arrays(plan, state.u, state.previous, state)
    return flattened({name: array for name, array in held.items() if array is not None})
