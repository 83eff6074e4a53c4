"""Cache of compiled kernels. Each kernel has a folder, the name of which is a digest of everything
that determines the kernel.

The folder contains the source, the files of numba, and the digests of both. If a file does not
match its digest, no file is loaded and the kernel is compiled again. If nothing can be stored, or
other users can write to the folder, a kernel is compiled in memory. This module also prepares
elementwise functions for numba; their source is included in the digest.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import operator
import os
import pickle
import shutil
import sys
import tempfile
import types
import uuid
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
from numba.core import imputils
from numba.core.registry import cpu_target
from numba.extending import (
    models,
    overload,
    register_jitable,
    register_model,
    typeof_impl,
)

from pbdkit.plugin import CellStress, Here, Stiffness, Torn, dot, length, where
from pbdkit.plugin.table import interpolate
from pbdkit.plugin.vector import KINDS, Vector

Function = Callable[..., Any]
_ready: set[Function] = {where, dot, interpolate}


def _is_vector(kind: Any) -> bool:
    return issubclass(getattr(kind, "instance_class", object), Vector)


def _written(kind: Any, arguments: str, component: str, whole: str = "Vector({})") -> Any:
    """Return a function of vectors that is written out component by component. `component` is the
    pattern of a component, with `@` for its name."""
    names = kind.instance_class._fields
    parts = [component.replace("@", name) for name in names]
    scope: dict[str, Any] = {"Vector": kind.instance_class}
    function = eval(f"lambda {arguments}: {whole.format(', '.join(parts))}", scope)
    # numba expects the signature of the overloaded function, including its annotations.
    function.__annotations__ = dict.fromkeys([*arguments.split(", "), "return"], "Any")
    return function


@overload(where)
def _where(condition: Any, yes: Any, no: Any) -> Any:
    # numpy's `where` on scalars would take hundreds of times as long in compiled code.
    if _is_vector(yes):
        return _written(yes, "condition, yes, no", "yes.@ if condition else no.@")

    def choose(condition: Any, yes: Any, no: Any) -> Any:
        return yes if condition else no

    return choose


@overload(dot)
def _dot(a: Any, b: Any) -> Any:
    products = " + ".join(f"a.{name} * b.{name}" for name in a.instance_class._fields)
    return _written(a, "a, b", "", products)


@overload(interpolate)
def _interpolate(x: Any, table: Any) -> Any:
    def value(x: Any, table: Any) -> Any:
        low, high = 0, table.shape[1] - 1
        if x >= table[0, high]:
            return table[1, high]
        if x <= table[0, 0]:
            return table[1, 0]
        while high - low > 1:
            middle = (low + high) // 2
            if table[0, middle] <= x:
                low = middle
            else:
                high = middle
        return table[2, low] * (x - table[0, low]) + table[1, low]

    return value


class Word(str):
    """Word that a parameter of a rule is chosen as. In kernels, its comparisons with `==` and `!=`
    are constants of the code."""

    __slots__ = ()


class WordType(numba.types.Opaque):
    """Type of one word in kernels."""

    def __init__(self, word: str) -> None:
        self.word = word
        super().__init__(name=f"Word({word!r})")


register_model(WordType)(models.OpaqueModel)


@typeof_impl.register(Word)
def _type_of_word(value: Word, _: Any) -> WordType:
    return WordType(str(value))


def _constant_word(context: Any, *_: Any) -> Any:
    return context.get_dummy_value()


vars(imputils)["lower_constant"](WordType)(_constant_word)


def _compared(is_equal: bool) -> Function:
    """Return the comparison of a word with a text in the code."""

    def true(a: Any, b: Any) -> Any:
        return True

    def false(a: Any, b: Any) -> Any:
        return False

    def overloaded(a: Any, b: Any) -> Any:
        if not (isinstance(a, WordType) and isinstance(b, numba.types.StringLiteral)):
            return None
        return true if (a.word == b.literal_value) is is_equal else false

    return overloaded


overload(operator.eq, prefer_literal=True)(_compared(is_equal=True))
overload(operator.ne, prefer_literal=True)(_compared(is_equal=False))


@overload(operator.neg)
def _neg(a: Any) -> Any:
    return _written(a, "a", "-a.@") if _is_vector(a) else None


def _arithmetic(sign: str) -> Function:
    """Return an operation on two vectors, or on a vector and a number."""

    def overloaded(a: Any, b: Any) -> Any:
        is_vector_a, is_vector_b = _is_vector(a), _is_vector(b)
        term = f"a{'.@' * is_vector_a} {sign} b{'.@' * is_vector_b}"
        return (
            _written(a if is_vector_a else b, "a, b", term) if is_vector_a or is_vector_b else None
        )

    return overloaded


for _operation, _sign in (("add", "+"), ("sub", "-"), ("mul", "*"), ("truediv", "/")):
    overload(getattr(operator, _operation))(_arithmetic(_sign))


INTERNAL: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options of functions that only compiled functions call. They take less time to compile, because
there are no wrappers for calls from Python and C."""


def compiled(function: Function, **options: Any) -> Any:
    """Return the function, compiled by numba together with every Python function that it calls.

    `error_model="numpy"` allows divisions and roots to be vectorised. fastmath is off, so that
    every operation is rounded as in numpy.
    """
    return numba.njit(error_model="numpy", **options)(with_helpers_ready(function))


def internal(function: Function) -> Any:
    """Return the compiled function for calls from compiled functions only."""
    return compiled(function, **INTERNAL)


def with_helpers_ready(function: Function) -> Function:
    """Return the function after all Python functions that it calls have been compiled by numba."""
    for helper in _reached(function):
        if helper is not function and helper not in _ready:
            register_jitable(helper)
            _ready.add(helper)
    return function


def source_key(*functions: Function) -> str:
    """Return a digest of the source of functions and of all that they call, constants included.

    The location of the functions is included, because a stored kernel imports its functions from
    their modules. If a function reads a value that cannot be identified, the key is unique, so that
    the kernel is compiled in every process.
    """
    digest = hashlib.sha256()
    for function in chain.from_iterable(map(_reached, functions)):
        names = sorted(_names(function).items())
        parts = [function.__module__, function.__qualname__, _source(function.__code__)]
        parts.append(repr((function.__defaults__, function.__kwdefaults__)))
        parts += [f"{name}={_content(value)}" for name, value in names]
        digest.update("\n".join(parts).encode())
    return digest.hexdigest()


def _content(value: Any) -> str:
    if isinstance(value, (bool, int, float, complex, str, tuple, type(None))):
        return repr(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, (types.FunctionType, types.BuiltinFunctionType, type, np.ufunc)):
        return getattr(value, "__qualname__", repr(value))
    if isinstance(value, types.ModuleType) or hasattr(value, "py_func"):
        return type(value).__name__
    return uuid.uuid4().hex


@cache
def _source(code: types.CodeType) -> str:
    try:
        return inspect.getsource(code)
    except (OSError, TypeError):  # The function was defined at a prompt and not in a file.
        return repr((code.co_code, code.co_consts, code.co_names))


def _reached(function: Function) -> list[Function]:
    """Return the function and every Python function that it calls by name, without repetitions."""
    functions = [function]
    for member in functions:
        for value in _names(member).values():
            reached = getattr(value, "py_func", value)
            if isinstance(reached, types.FunctionType) and reached not in functions:
                functions.append(reached)
    return functions


def _names(function: Function) -> dict[str, Any]:
    """Return the values of the names in a function, and in functions inside it: globals, closures,
    and members of modules."""
    codes = [function.__code__]
    for code in codes:
        codes += [c for c in code.co_consts if isinstance(c, types.CodeType)]
    # Names are sorted, since the order of a set differs between processes.
    names = sorted({name for code in codes for name in code.co_names})
    values = {n: function.__globals__[n] for n in names if n in function.__globals__}
    values |= inspect.getclosurevars(function).nonlocals
    modules = [v for v in values.values() if isinstance(v, types.ModuleType)]
    for module in modules:
        if module.__name__.split(".")[0] not in ("numpy", "math", "numba"):
            # Modules of pbdkit may be loaded only now, at their first use.
            members = {name: getattr(module, name) for name in names if hasattr(module, name)}
            values |= {f"{module.__name__}.{name}": value for name, value in members.items()}
            modules += [v for v in members.values() if isinstance(v, types.ModuleType)]
    return values


SOURCE = "kernel.py"
"""Name of the file with the source of a kernel."""
DIGESTS = "digests.json"
"""Name of the file with the digests of the other files."""
_loaded: dict[tuple[Path, str], Any] = {}
"""Kernels that this process has loaded, by folder and key. Loading a kernel again would take
several milliseconds."""


def load_kernel(source: str, functions: dict[str, Function], arguments: tuple[Any, ...]) -> Any:
    """Return the function `run` of a kernel, given its source. The kernel is loaded from the cache
    or compiled, and is called once with the arguments.

    The key covers the source of every function that rule and fracture model call, so that a kernel
    is never used for an edited rule.
    """
    interpreted = bool(vars(numba.config)["DISABLE_JIT"])
    processor = cpu_target.target_context.codegen().magic_tuple()
    parts = [source, source_key(*functions.values(), length), vars(numba)["typeof"](arguments)]
    parts += [numba.__version__, np.__version__, sys.version, processor, interpreted]
    key = hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:32]
    if (index := (_cache_folder(), key)) not in _loaded:
        names = {name: internal(function) for name, function in functions.items()}
        kernel = None if interpreted else _cached_kernel(source, key, names, arguments)
        _loaded[index] = kernel or _prepared(source, names, arguments)
    return _loaded[index]


def cache_folder() -> Path | None:
    """Return PBDKIT_CACHE_DIR, or `pbdkit` in the user's cache folder; None if it is not writable.
    Also None if other users can write to it, because code that they place there would be
    executed."""
    folder = _cache_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        alone = not hasattr(os, "getuid") or (
            status.st_uid == os.getuid() and not status.st_mode & 0o022
        )
        return folder if alone and os.access(folder, os.W_OK | os.X_OK) else None
    except OSError:
        return None


def _cache_folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PBDKIT_CACHE_DIR") or Path(home) / "pbdkit")


def _cached_kernel(source: str, key: str, names: dict[str, Any], arguments: tuple[Any, ...]) -> Any:
    """Return the kernel from the cache, or compile and store it; None if neither is possible."""
    if (cache := cache_folder()) is None:
        return None
    folder = cache / f"kernel_{key}"
    try:
        if kernel := _found(source, folder, names, arguments):
            return kernel
        # Another process that needs the same kernel waits until it is stored, and then loads it.
        with _alone(cache / f".{key}"):
            kernel = _found(source, folder, names, arguments)
            return kernel or _made(source, folder, names, arguments)
    except (OSError, pickle.PicklingError):
        return None


def _found(source: str, folder: Path, names: dict[str, Any], arguments: tuple[Any, ...]) -> Any:
    """Return the kernel in a folder; None if its files are invalid."""
    if _is_whole(folder):
        with suppress(Exception):
            return _prepared(source, names, arguments, folder)
    return None


def _made(source: str, folder: Path, names: dict[str, Any], arguments: tuple[Any, ...]) -> Any:
    """Compile a kernel, store it in the folder and return it."""
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making-") as name:
        directory = Path(name) / folder.name
        directory.mkdir()
        (directory / SOURCE).write_text(source, encoding="utf-8")
        run = _prepared(source, names, arguments, directory)
        (directory / DIGESTS).write_text(json.dumps(_digests(directory)), encoding="utf-8")
        if not _is_whole(folder):  # No other process has stored it in the meantime.
            shutil.rmtree(folder, ignore_errors=True)
            directory.replace(folder)
        return run


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Lock a path, so that a kernel is not compiled by two processes of a machine at the same time.
    There is no lock on file systems that do not support locks."""
    with path.open("w") as file:
        with suppress(ImportError, OSError):
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _is_whole(folder: Path) -> bool:
    """Return whether every file is unchanged since the kernel was compiled."""
    try:
        digests = json.loads((folder / DIGESTS).read_text(encoding="utf-8"))
        return bool(digests == _digests(folder))
    except (OSError, ValueError):
        return False


def _digests(folder: Path) -> dict[str, str]:
    files = (file for file in sorted(folder.rglob("*")) if file.is_file() and file.name != DIGESTS)
    return {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
    }


def _prepared(
    source: str, names: dict[str, Any], arguments: tuple[Any, ...], folder: Path | None = None
) -> Any:
    """Call the kernel once and return it. The call compiles the kernel or loads it from its
    folder."""
    file = str(folder / SOURCE) if folder else "<kernel>"
    module = ModuleType(folder.name if folder else "kernel")
    scope = vars(module)
    scope |= words(internal) | names
    part = numba.njit(error_model="numpy", **INTERNAL)
    scope.update(njit=numba.njit, part=part, prange=numba.prange)
    scope["CACHED"] = bool(folder)
    if folder:
        module.__file__ = file
        sys.modules[module.__name__] = module  # numba looks up its stored files by this name.
    exec(compile(source, file, "exec"), scope)
    module.run(*arguments)
    return module.run


def words(made: Callable[[Function], Any]) -> dict[str, Any]:
    """Return the names that every kernel uses, with their values. Functions are converted with
    `made`."""
    kinds: dict[str, Any] = {kind.__name__: kind for kind in KINDS.values()}
    kinds |= {kind.__name__: kind for kind in (Here, Torn, CellStress, Stiffness)}
    numbers = {"int64": np.int64, "real": np.float32, "double": np.float64}
    helpers = {"length": made(length), "namedtuple": namedtuple, "Word": Word, "np": np}
    return kinds | numbers | helpers
