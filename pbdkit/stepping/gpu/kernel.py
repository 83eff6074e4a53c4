"""Kernels compiled for a GPU, by numba-cuda (written against 0.30; see `_uncontracted`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from types import ModuleType
from typing import Any
from warnings import catch_warnings, simplefilter

from numba import cuda
from numba.core.errors import NumbaPerformanceWarning

from pbdkit.errors import PbdkitError
from pbdkit.stepping.compiled.functions import with_helpers_ready
from pbdkit.stepping.compiled.kernel_cache import words

Function = Callable[..., Any]
UNROUNDED = re.compile(r"\b(add|sub|mul)\.f(32|64)\b")
"""What the driver may still contract, in the text of a kernel."""


def make_kernel(source: str, functions: Mapping[str, Function], threads: int) -> Any:
    """The function `run` of a kernel with this source, compiled when it is first launched; for
    blocks of so many threads at most."""
    scope = vars(ModuleType("kernel"))
    scope |= words(_on_device) | {name: _on_device(of) for name, of in functions.items()}
    # Linked at once: what links later would contract after all.
    options = {} if is_simulated() else {"lto": False, "launch_bounds": threads}
    scope.update(cuda=cuda, part=_on_device, kernel=cuda.jit(**options))
    exec(compile(source, "<kernel>", "exec"), scope)
    return scope["run"]


def text_of(run: Any, arguments: tuple[Any, ...], device: tuple[int, int]) -> str:
    """The kernel as a text of PTX for arguments of these types, on devices of a compute capability.

    Raises PbdkitError where products and sums could be contracted.
    """
    with _uncontracted():
        text, _ = cuda.compile(run.py_func, arguments, device=False, abi="numba", cc=device)
    return _checked(str(text))


def first_launch(run: Any, arguments: tuple[Any, ...]) -> None:
    """One launch on one thread, which compiles the kernel. Raises PbdkitError where products and
    sums could be contracted."""
    with _uncontracted():
        launcher(run, 1, 1)(*arguments)
    if not is_simulated():
        for text in run.inspect_asm().values():
            _checked(text)


def launcher(run: Any, blocks: int, threads: int) -> Any:
    """What launches a kernel. That few blocks use little of a GPU is no news."""
    with catch_warnings():
        simplefilter("ignore", NumbaPerformanceWarning)
        return run[blocks, threads]


def most_blocks(run: Any, threads: int) -> int:
    """How many blocks of so many threads are on the device at once."""
    (kernel,) = run.overloads.values()
    return int(kernel.max_cooperative_grid_blocks(threads))


def is_simulated() -> bool:
    """Whether numba runs kernels in Python: NUMBA_ENABLE_CUDASIM."""
    return bool(cuda.config.ENABLE_CUDASIM)


def _on_device(function: Function) -> Any:
    """A function that kernels call, made part of them."""
    if is_simulated():
        return function
    _complete_ufuncs()
    return cuda.jit(device=True, forceinline=True)(with_helpers_ready(function))


@contextmanager
def _uncontracted() -> Iterator[None]:
    """While this lasts kernels are compiled so that a product and a sum are rounded each, as numpy
    rounds them: libNVVM's option fma=0, which numba-cuda 0.30 has no switch for. Whether it has
    been heard the text of the kernel tells."""
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
            "this version of numba-cuda contracts products and sums, whatever it is told: results "
            "would not be those of the other engines; take numba-cuda 0.30, or `engine: auto`"
        )
    return text


@cache
def _complete_ufuncs() -> None:
    """Functions of numpy that numba-cuda 0.30 does not know in kernels, as `np.sqrt`: as the
    device's library has them, else as numba has them elsewhere."""
    from numba.cuda import mathimpl, ufuncs
    from numba.cuda.np import ufunc_db

    known = ufuncs.ufunc_db()
    missing = [function for function in ufunc_db.get_ufuncs() if function not in known]
    library = {of.__name__: of for *_, of in mathimpl.unarys}
    for function in missing:
        known[function] = ufunc_db.get_ufunc_info(function)
        if of := library.get(function.__name__):
            lower = partial(_lowered, mathimpl.get_unary_impl_for_fn_and_ty, of)
            known[function] = {"f->f": lower, "d->d": lower}


def _lowered(find: Function, of: Function, context: Any, builder: Any, sign: Any, own: Any) -> Any:
    """The call of a function of the device's library, as numba asks for it."""
    return find(of, sign.args[0])(context, builder, sign, own)
