"""GPU engine (numba-cuda). Its kernels make many steps in a launch, and the state stays on the
device.

A thread moves one particle after the other. The lines of code are the same as in sweeps over rows,
but use flat arrays. Every place belongs to a group. Group 0 has no followers. The next groups, one
for each sublattice and kind of row, contain the particles that have all their neighbours. The last
groups, one for each sublattice, contain the particles that may lack neighbours. Threads are
synchronised between the operations of a step, so that no thread reads a value while another one
writes it.

The state is copied from the device at the end of a call. Kernels do not contract a product and a
sum to one operation with a single rounding (written against numba-cuda 0.30; see `_uncontracted`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from types import ModuleType
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from numba import cuda
from numba.core.errors import NumbaPerformanceWarning
from numpy.typing import NDArray

from pbdkit.errors import PbdkitError
from pbdkit.lattice.neighbourhood import bonds_in, plane_block
from pbdkit.lattice.raster import slot_step
from pbdkit.plugin import Slot
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import Function, Lines
from pbdkit.stepping.numba_engine import sweeps
from pbdkit.stepping.numba_engine.arrays import (
    Arrays,
    bits_for,
    call_arrays,
    changing_arrays,
    constant_arrays,
    kinds_of,
    lost_bits,
    state_arrays,
)
from pbdkit.stepping.numba_engine.cache import with_helpers_ready, words
from pbdkit.stepping.numba_engine.emitter import module_text
from pbdkit.stepping.numba_engine.plan import (
    Level,
    Passes,
    Plan,
    PlanWriter,
    attributing_errors,
    functions_of,
    levels_of,
)
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.program import precompute_steps, prepare, program_of
from pbdkit.stepping.state import State, unmoved_state
from pbdkit.stepping.step import Call

THREAD = ("me", "threads")
"""Names of two arguments of functions: the index of the thread, and the number of threads."""
Whole = Sequence[tuple[int, int]]
"""Type of the groups of particles that have all neighbours, as (sublattice, kind)."""


def find_groups(plan: Plan) -> tuple[NDArray[Any], Whole]:
    """Return the number of the group of each place of the rasters, and the groups of particles that
    have all neighbours."""
    raster, whole = plan.scene.raster, list[tuple[int, int]]()
    groups = np.zeros(raster.shape, np.int64)
    blocks = [raster.body_block(s) for s in range(raster.shape[0])]
    for s, block in enumerate(blocks):
        if block:
            kinds = kinds_of(plan.scene, block, plan.long)
            block.of(groups)[kinds == sweeps.GENERAL] = -1 - s
            for kind in (sweeps.PLAIN, sweeps.WITH_CELLS):
                if (kinds == kind).any():
                    whole.append((s, kind))
                    block.of(groups)[kinds == kind] = len(whole)
    np.copyto(groups, len(whole) - groups, where=groups < 0)
    return groups.astype(np.min_scalar_type(int(groups.max()))), whole


def breakable_bonds(plan: Plan) -> NDArray[np.uint8]:
    """Return 1 where a bond may break, in planes of bonds."""
    planes, shape = plan.scene.neighbourhood.planes, plan.scene.raster.shape
    breakable = np.zeros((len(planes), *shape[1:]), np.uint8)
    for n, plane in enumerate(planes):
        if block := plane_block(plan.scene.raster, plane, inside=plan.softens_cells):
            too = plan.model.breaks_frame_bonds()
            block.within(breakable[n])[...] = bonds_in(plan.scene.raster, block, plane, too)
    return breakable


def write_sweep(plan: Plan, level: Level, whole: Whole, events: Function | None) -> Function:
    """Return the function with which a thread moves its particles, one after the other."""
    out = Function(plan.shared, f"sweep{level.number}", *THREAD)
    out.add(0, *sweeps.parameters(plan, level), "base = 0", *_aliases(plan, level))
    for s, kind in whole:
        for k, slot in enumerate(plan.scene.neighbourhood.slots[s]):
            out.add(0, *_steps(plan, kind, s, k, slot))
    out.add(0, f"for j in {plan.over('flat_groups.size')}:", "    group = flat_groups[j]")
    if level.scene.experiment.rule.uses_reference:
        out.add(1, *_cells(plan))
    out.depth = 1
    if plan.tears:  # Neighbours of marked particles may be missing.
        for n, (s, _) in enumerate(whole, 1):
            out.add(0, f"if group == {n} and flat_torn[j]:", f"    group = {len(whole) + 1 + s}")
    for n, (s, kind) in enumerate(whole, 1):
        slots = plan.scene.neighbourhood.slots[s]
        words = [_words(plan, level, kind, s, k) for k in range(len(slots))]
        out.add(0, f"if group == {n}:", "    changed = 0")
        sweeps.write_whole(out, plan, level, s, words, "flat_lost[j]")
        if events:
            out.add(1, "if changed:", "    " + events.call(str(s), "j", "1"))
    out.add(0, f"if group > {len(whole)}:", f"    s, changed = group - {len(whole) + 1}, 0")
    sweeps.write_one(out, plan, level)
    if events:
        out.add(1, "if changed:", "    " + events.call("s", "j", "1"))
    return out


def write_bonds(plan: Plan) -> list[Function]:
    """Return the functions with which a thread updates and breaks its bonds, plane after plane. The
    last function calls the others."""
    out = Function(plan.shared, "judge_bonds", *THREAD)
    out.add(0, sweeps.parameters(plan, plan.levels[-1])[-1])
    out.add(0, "cells = flat_broken.size // len(ends)", "for n in range(len(ends)):")
    out.add(1, f"r = {plan.vector('end_rests[n, #]')}")
    rows = {"since": "broken", "broken_lengths": "lengths", "may": "breakable"}
    rows |= {f"b{m}": f"bond{m}" for m in range(plan.bonds)}
    rows |= {f"x{m}": f"limit{m}" for m in range(plan.limits)}
    out.add(1, *(f"{name} = flat_{of}[n * cells:(n + 1) * cells]" for name, of in rows.items()))
    out.add(1, f"for j in {plan.over('cells')}:", "    if may[j] and since[j] < 0:")
    out.add(3, "here = ends[n, 0] * cells + j", "there = here + end_steps[n]")
    out.add(3, *sweeps.bond_update(plan, "flat_u_@[there] - flat_u_@[here]", "here").write)
    out.add(3, *sweeps.marking_lines(plan, "n * cells + j", "here"))
    return [*sweeps.bond_functions(plan), out]


def _aliases(plan: Plan, level: Level) -> list[str]:
    """Return lines that assign the whole arrays to the names that the rows of a particle have in
    row sweeps."""
    n = level.number
    rows = {"h@": "u_@", "o@": "v_@" if level is plan.levels[-1] else f"z{n}_@"}
    if n:
        rows["z@"] = f"{level.source}_@"
    if plan.is_loaded(level):
        rows["g@"] = "load_@"
    lines = [line for row, of in rows.items() for line in plan.each(f"{row} = flat_{of}")]
    lines += [f"a{m} = w{m} = flat_own{m}" for m in range(len(level.seen.own))]
    return lines + [f"g{m} = flat_field{m}" for m in range(level.fields)]


def _cells(plan: Plan) -> list[str]:
    """Return lines for the cell indices of place j. The last index is `j + j0`."""
    lines, index = ["j0 = j % extent[-1] - j"], "j // extent[-1]"
    for axis, name in reversed(list(enumerate(plan.lead, 1))):
        lines.append(f"{name} = {index} % extent[{axis}]")
        index += f" // extent[{axis}]"
    return lines


def _steps(plan: Plan, kind: int, s: int, k: int, slot: Slot) -> list[str]:
    """Return lines for index offsets in flat arrays: from a particle to its neighbour, to the place
    at which their bond is stored, and to the cells beside the bond."""
    lines = [f"w{s}_{k} = away[{s}, {k}]"]
    if plan.bonds or plan.limits or plan.bonds_first:
        lines.append(f"v{s}_{k} = bonds_away[{s}, {k}]")
    if kind == sweeps.WITH_CELLS:
        lines += [f"q{s}_{k}_{side} = cells_away[{s}, {k}, {side}]" for side in (0, 1)]
    return lines


def _words(plan: Plan, level: Level, kind: int, s: int, k: int) -> sweeps.Words:
    place, owner = f"j + w{s}_{k}", f"j + v{s}_{k}"
    shares = (
        [f"flat_share[j + q{s}_{k}_{side}]" for side in (0, 1)] if kind == sweeps.WITH_CELLS else []
    )
    return sweeps.Words(
        f"flat_{level.source}_@[{place}]",
        [f"flat_{array}[{place}]" for array in plan.shown],
        shares,
        f"flat_bond{{n}}[{owner}]",
        f"flat_limit{{n}}[{owner}]",
        f"flat_broken[{owner}]",
    )


PLANES = re.compile(
    r"kind|share|body|ratios|mixed|broken|lengths|lost|torn|groups|breakable"
    r"|(u|v|z\d+|load)_[xyz]|(bond|own|was|field|limit)\d+"
)
"""Names of arrays with a value at every place."""


def steady_arrays(plan: Plan) -> tuple[Arrays, Whole]:
    """Return the constant arrays, and the groups with all neighbours."""
    shape, planes = plan.scene.raster.shape, plan.scene.neighbourhood.planes
    groups, whole = find_groups(plan)
    arrays = constant_arrays(plan) | {"groups": groups, "extent": np.array(shape, np.int64)}
    arrays["end_steps"] = np.array([slot_step(shape, plane.slot) for plane in planes], np.int64)
    if plan.bonds_first:
        arrays["breakable"] = breakable_bonds(plan)
    return arrays, whole


def flattened(arrays: Arrays) -> Arrays:
    """Return the arrays as kernels receive them; planes are flat views."""
    return {
        f"flat_{name}" if PLANES.fullmatch(name) else name: (
            array.reshape(-1) if PLANES.fullmatch(name) else array
        )
        for name, array in arrays.items()
    }


class ThreadWriter(PlanWriter):
    """Writer of the part of a step that one of many threads executes. Threads are synchronised
    between operations on different places."""

    _list = ""
    """Name of the list of particles over which the last loop was written, if no synchronisation was
    written after it."""

    def __init__(self, plan: Plan, out: Function, passes: Passes, wait: str) -> None:
        super().__init__(plan, out, passes)
        self._wait = wait

    def begin(self) -> None:
        """Write the first lines of operations, and lines that copy state variables before the step
        changes them."""
        self.out.add(1, *self.plan.opening("moment"))
        for m in self.plan.copied_values:
            self.out.add(1, f"for e in {self.plan.over(f'flat_own{m}.size')}:")
            self.out.add(2, f"flat_was{m}[e] = flat_own{m}[e]")

    def end(self) -> None:
        """Write lines that swap the arrays of the displacements before the step and after it."""
        u, v = (", ".join(self.each(f"flat_{name}_@")) for name in "uv")
        self.out.add(1, f"{u}, {v} = {v}, {u}")

    def wait(self) -> None:
        """Write a synchronisation of all threads, unless the last line written is a
        synchronisation."""
        if not self.out.lines[-1].endswith(self._wait):
            self.out.add(1, self._wait)
        self._list = ""

    def listed(self, name: str, *lines: str, ahead: bool = False) -> None:
        """Write a loop over the entries that belong to the thread."""
        if self._list not in ("", name):
            self.wait()
        self._list = name
        self.out.add(1, f"for e in {self.plan.over(f'{name}.size')}:")
        self.out.add(2, *lines)

    def judge_bonds(self) -> None:
        """Write the call of the pass over the bonds of the thread."""
        if self.passes.judge:
            self._call(self.passes.judge)

    def sweep(self, level: int) -> None:
        """Write the call of the sweep over the particles of the thread."""
        self._call(self.passes.sweeps[level])

    def follow(self, mapped: Callable[[str], Lines], planes: str, delay: int = 0) -> None:
        """Write a loop over the frame points of the thread."""
        self.wait()
        self.out.add(1, f"for f in {self.plan.over('points.size')}:")
        self.out.add(2, *mapped("flat_u" if delay else planes))
        self.out.add(2, *self.each(f"{planes}_@[points[f]] = t_@"))
        self.wait()

    def over_rows(self, name: str, write: Callable[[Function], None]) -> None:
        """Raise NotImplementedError: a GPU has no rows."""
        raise NotImplementedError(f"{name} on a GPU")

    def _call(self, function: Function) -> None:
        self.wait()
        self.out.add(1, function.call(*THREAD))
        self.wait()


def write_kernel(plan: Plan, whole: Whole, alone: bool) -> tuple[str, list[str]]:
    """Return the source of a module with ``run(step, count, ...)``, which makes `count` steps, and
    the names of the other arguments, which are arrays. With `alone` a single block is launched. It
    has to synchronise only its own threads, which takes much less time than a synchronisation of
    several blocks."""
    events = sweeps.write_events(plan) if plan.judged else None
    bonds = write_bonds(plan) if plan.bonds_first else []
    moves = [write_sweep(plan, level, whole, events) for level in plan.levels]
    functions = [*([events] if events else []), *bonds, *moves]
    run = Function(plan.shared, "run", "step", "count")
    run.add(0, "me, threads = cuda.grid(1), cuda.gridsize(1)")
    if not alone:
        run.add(0, "everyone = cuda.cg.this_grid()")
    run.add(0, "for moment in range(count):", "    step += 1")
    wait = "cuda.syncthreads()" if alone else "everyone.sync()"
    writer = ThreadWriter(plan, run, Passes(bonds[-1] if bonds else None, moves), wait)
    writer.begin()
    for operation in program_of(plan.scene):
        operation.emit(writer)
    writer.end()
    head = ["@kernel", f"def run({', '.join([*run.own, *run.used])}):"]
    return module_text(plan, functions, head, run), run.used


ALONE = 4096
"""Number of places up to which one block makes all steps (estimated, not measured)."""


@dataclass(frozen=True)
class GpuKernel:
    """Source of a kernel.

    `names` are the names of its arrays, and `alone` is true if it runs in a single block.
    """

    plan: Plan
    source: str
    names: list[str]
    arrays: Arrays
    alone: bool


def kernel_of(scene: Scene) -> GpuKernel:
    """Return the kernel that steps a scene."""
    plan = Plan(scene, levels_of(scene), parallel=False, gpu=True)
    steady, whole = steady_arrays(plan)
    start = unmoved_state(scene, scene.raster.shape[1:])
    inner = [name for n in range(len(plan.levels) - 1) for name in plan.each(f"z{n}_@")]
    arrays = {name: np.zeros(scene.raster.shape, start.u.dtype) for name in inner}
    arrays |= {f"was{m}": np.zeros_like(start.particle_values[m]) for m in plan.copied_values}
    if plan.judged:
        arrays["lost"] = np.zeros(scene.raster.shape, bits_for(scene))
    if plan.tears:
        arrays["torn"] = np.zeros(scene.raster.shape, np.uint8)
    named = flattened(steady | arrays) | changing_planes(plan, start)
    named |= flattened(call_arrays(plan, plan.program, Call(start), by_rows=False))
    alone = scene.raster.kind.size <= ALONE
    source, names = write_kernel(replace(plan, shared=("step", *named)), whole, alone)
    return GpuKernel(plan, source, names, {name: named[name] for name in names}, alone)


def changing_planes(plan: Plan, state: State) -> Arrays:
    """Return the arrays of a state that steps change."""
    planes = state_arrays(plan, state.u, state.previous, state)
    return flattened({name: array for name, array in planes.items() if array is not None})


DeviceFunction = Callable[..., Any]
UNROUNDED = re.compile(r"\b(add|sub|mul)\.f(32|64)\b")
"""Pattern of operations that the driver may contract, in the text of a kernel."""


def make_kernel(source: str, functions: Mapping[str, DeviceFunction], threads: int) -> Any:
    """Return the function `run` of a source, compiled when it is first launched, for blocks of at
    most `threads` threads."""
    scope = vars(ModuleType("kernel"))
    scope |= words(_on_device) | {name: _on_device(of) for name, of in functions.items()}
    # Linking with optimisation (`lto`) is off, since the driver could then contract operations.
    options = {} if is_simulated() else {"lto": False, "launch_bounds": threads}
    scope.update(cuda=cuda, part=_on_device, kernel=cuda.jit(**options))
    exec(compile(source, "<kernel>", "exec"), scope)
    return scope["run"]


def text_of(run: Any, arguments: tuple[Any, ...], device: tuple[int, int]) -> str:
    """Return the text of the kernel (PTX) for arguments of the given types, on devices with a given
    compute capability.

    Raises PbdkitError if products and sums could be contracted.
    """
    with _uncontracted():
        text, _ = cuda.compile(run.py_func, arguments, device=False, abi="numba", cc=device)
    return _checked(str(text))


def first_launch(run: Any, arguments: tuple[Any, ...]) -> None:
    """Launch the kernel once on one thread. The launch compiles the kernel.

    Raises PbdkitError if products and sums could be contracted.
    """
    with _uncontracted():
        launcher(run, 1, 1)(*arguments)
    if not is_simulated():
        for text in run.inspect_asm().values():
            _checked(text)


def launcher(run: Any, blocks: int, threads: int) -> Any:
    """Return a function that launches a kernel. The warning about too few blocks is suppressed."""
    with catch_warnings():
        simplefilter("ignore", NumbaPerformanceWarning)
        return run[blocks, threads]


def most_blocks(run: Any, threads: int) -> int:
    """Return the number of blocks of `threads` threads that can be resident on the device
    simultaneously."""
    (kernel,) = run.overloads.values()
    return int(kernel.max_cooperative_grid_blocks(threads))


def is_simulated() -> bool:
    """Return whether numba's simulator runs kernels in Python (NUMBA_ENABLE_CUDASIM)."""
    return bool(cuda.config.ENABLE_CUDASIM)


def _on_device(function: DeviceFunction) -> Any:
    """Compile a function for the device, to be inlined in kernels."""
    if is_simulated():
        return function
    _complete_ufuncs()
    return cuda.jit(device=True, forceinline=True)(with_helpers_ready(function))


@contextmanager
def _uncontracted() -> Iterator[None]:
    """Compile kernels in this context without contracting products and sums, so that they round as
    numpy does. For this the option fma=0 of libNVVM is set, for which numba-cuda 0.30 has no
    switch. Whether it has an effect is checked in the text of the kernel."""
    if is_simulated():
        yield
        return
    from numba.cuda.cudadrv import nvvm

    plain = nvvm.compile_ir
    nvvm.compile_ir = partial(plain, fma=0)
    try:
        yield
    finally:
        nvvm.compile_ir = plain


def _checked(text: str) -> str:
    if UNROUNDED.search(text):
        raise PbdkitError(
            "this version of numba-cuda contracts products and sums in spite of its settings: "
            "results would differ from those of the other engines; use numba-cuda 0.30, or "
            "`engine: auto`"
        )
    return text


@cache
def _complete_ufuncs() -> None:
    """Add the functions of numpy that numba-cuda 0.30 does not support in kernels, such as
    `np.sqrt`. They are taken from the library of the device or, if it does not have them, from
    numba."""
    from numba.cuda import mathimpl, ufuncs
    from numba.cuda.np import ufunc_db

    functions = ufuncs.ufunc_db()
    missing = [function for function in ufunc_db.get_ufuncs() if function not in functions]
    library = {of.__name__: of for *_, of in mathimpl.unarys}
    for function in missing:
        functions[function] = ufunc_db.get_ufunc_info(function)
        if of := library.get(function.__name__):
            lower = partial(_lowered, mathimpl.get_unary_impl_for_fn_and_ty, of)
            functions[function] = {"f->f": lower, "d->d": lower}


def _lowered(
    find: DeviceFunction, of: DeviceFunction, context: Any, builder: Any, sign: Any, own: Any
) -> Any:
    """Return the call of a function of the device's library, with the signature that numba
    expects."""
    return find(of, sign.args[0])(context, builder, sign, own)


THREADS = 256
"""Number of threads of a block if there are several blocks."""
MAX_THREADS = 1024
"""Number of threads of a single block."""
SIMULATED_THREADS = 8
"""Number of threads in numba's simulator."""


class GpuStepper(Engine):
    """Engine that steps a scene with its own kernel on the first GPU.

    A state that was not computed by this engine is copied to the device, and the state is copied
    back at the end of a call. All particles are moved in every step.
    """

    name = "gpu"

    def __init__(self, scene: Scene) -> None:
        self._scene = self._numbered = scene
        self._program = program_of(scene)
        self._last: State | None = None
        self._sent: Arrays = {}
        """Arrays of operations that are already on the device."""
        kernel = kernel_of(scene)
        self._plan, self._names = kernel.plan, kernel.names
        self._device: Arrays = {}
        self._send(kernel.arrays)
        with attributing_errors(self._plan.levels):
            threads = MAX_THREADS if kernel.alone else THREADS
            functions = functions_of(self._plan.levels)
            self._run = make_kernel(kernel.source, functions, threads)
            # A call without steps compiles the kernel, so that errors of the compiler occur here.
            first_launch(self._run, self._given(0, 0))
        self._launch = launcher(self._run, *self._blocks(kernel.alone))

    def advance(self, state: State, steps: int = 1) -> State:
        """Return the state after `steps` steps, in as few launches as the operations permit."""
        if state is not self._last:
            self._begin(state)
        end = state.step + steps
        while state.step < end:
            state = self._some_steps(state, end)
        self._fetch(state)
        self._last = state
        return state

    def renewed(self, state: State, rows: slice) -> None:
        """Mark the state as changed, so that the next call sends it to the device."""
        self._last = None

    def _blocks(self, alone: bool) -> tuple[int, int]:
        """Return the number of blocks, and the number of threads of each."""
        size = self._scene.raster.kind.size
        if is_simulated():
            return 1, SIMULATED_THREADS
        if alone:
            return 1, min(MAX_THREADS, -(-size // 32) * 32)
        return min(most_blocks(self._run, THREADS), -(-size // THREADS)), THREADS

    def _begin(self, state: State) -> None:
        """Copy all arrays that steps change to the device."""
        planes = changing_planes(self._plan, state)
        if self._plan.judged:
            planes |= flattened({"lost": lost_bits(self._scene, state)})
        if self._plan.tears:
            planes |= flattened({"torn": sweeps.torn_marks(self._scene, state)})
        self._send(planes)

    def _fetch(self, state: State) -> None:
        """Copy the values that steps have changed from the device to the arrays of a state."""
        for name, array in changing_planes(self._plan, state).items():
            if name in self._device:
                self._device[name].copy_to_host(array)

    def _some_steps(self, state: State, end: int) -> State:
        step = state.step + 1
        if any(operation.reads(state) for operation in self._program):
            self._fetch(state)
        call = prepare(self._program, state)
        if call.has_cuts:
            self._begin(state)
        self._renumber(self._scene.at(step))
        count = precompute_steps(self._program, call, end)
        self._send_call(call)
        with errors_attributed_to(self._scene.experiment.rule, f"at step {step}"):
            self._launch(*self._given(state.step, count))
        if count % 2:
            for u, v in zip(*(self._plan.each(f"flat_{side}_@") for side in "uv"), strict=True):
                self._device[u], self._device[v] = self._device[v], self._device[u]
        return replace(state, step=state.step + count, starts=call.starts or state.starts)

    def _renumber(self, scene: Scene) -> None:
        if scene is not self._numbered:
            self._send(changing_arrays(self._plan.renumbered(scene)))
            self._numbered = scene

    def _send_call(self, call: Call) -> None:
        """Copy the arrays of operations for a call to the device, except those that are already on
        it."""
        arrays = call_arrays(self._plan, self._program, call, by_rows=False)
        changed = {name: a for name, a in arrays.items() if self._sent.get(name) is not a}
        self._sent |= changed
        self._send(flattened(changed))

    def _send(self, arrays: Arrays) -> None:
        """Copy the constant arrays of the kernel to the device."""
        self._device |= {
            name: cuda.to_device(array) for name, array in arrays.items() if name in self._names
        }

    def _given(self, step: int, count: int) -> tuple[Any, ...]:
        return step, count, *(self._device[name] for name in self._names)
