"""The cache of kernels: a folder for each, under a key of everything that it was made of.

The folder has the source, what numba keeps beside it, and the digests of both. What does not agree
with its digests is never loaded but made anew; where nothing can be kept, or others could write
there, a kernel is made in memory. Elementwise functions are made ready for numba here, and their
source is part of the key.
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
from numba.core.registry import cpu_target
from numba.extending import overload, register_jitable

from pbdkit.plugin import CellStress, Here, Stiffness, Torn, dot, length, where
from pbdkit.plugin.vector import KINDS, Vector

Function = Callable[..., Any]
_ready: set[Function] = {where, dot}


def _is_vector(kind: Any) -> bool:
    return issubclass(getattr(kind, "instance_class", object), Vector)


def _written(kind: Any, arguments: str, component: str, whole: str = "Vector({})") -> Any:
    """A function of vectors, written out for their components: `component` with `@` for each."""
    names = kind.instance_class._fields
    parts = [component.replace("@", name) for name in names]
    scope: dict[str, Any] = {"Vector": kind.instance_class}
    function = eval(f"lambda {arguments}: {whole.format(', '.join(parts))}", scope)
    # numba wants the signature of the function that is overloaded, annotations included.
    function.__annotations__ = dict.fromkeys([*arguments.split(", "), "return"], "Any")
    return function


@overload(where)
def _where(condition: Any, yes: Any, no: Any) -> Any:
    # numpy's `where` on single numbers inside numba costs hundreds of times as much.
    if _is_vector(yes):
        return _written(yes, "condition, yes, no", "yes.@ if condition else no.@")

    def choose(condition: Any, yes: Any, no: Any) -> Any:
        return yes if condition else no

    return choose


@overload(dot)
def _dot(a: Any, b: Any) -> Any:
    products = " + ".join(f"a.{name} * b.{name}" for name in a.instance_class._fields)
    return _written(a, "a, b", "", products)


@overload(operator.neg)
def _neg(a: Any) -> Any:
    return _written(a, "a", "-a.@") if _is_vector(a) else None


def _arithmetic(sign: str) -> Function:
    """An operation on two vectors, or on a vector and a number."""

    def overloaded(a: Any, b: Any) -> Any:
        is_vector_a, is_vector_b = _is_vector(a), _is_vector(b)
        term = f"a{'.@' * is_vector_a} {sign} b{'.@' * is_vector_b}"
        return (
            _written(a if is_vector_a else b, "a, b", term) if is_vector_a or is_vector_b else None
        )

    return overloaded


for _operation, _sign in (("add", "+"), ("sub", "-"), ("mul", "*"), ("truediv", "/")):
    overload(getattr(operator, _operation))(_arithmetic(_sign))


def compiled(function: Function) -> Any:
    """The function for numba, with every Python function that it reaches made ready.

    `error_model="numpy"` lets divisions and roots vectorise; fastmath stays off, so that every
    operation rounds as numpy's does.
    """
    return numba.njit(error_model="numpy")(with_helpers_ready(function))


def with_helpers_ready(function: Function) -> Function:
    """Return the function with every Python function that it reaches compilable by numba."""
    for helper in _reached(function):
        if helper is not function and helper not in _ready:
            register_jitable(helper)
            _ready.add(helper)
    return function


def source_key(*functions: Function) -> str:
    """Return a digest of the source of functions and of all that they reach, constants included.

    Their location counts, too: a stored kernel finds its functions by their modules. If a function
    reads a value that cannot be identified, the key is new every time, so that a kernel is compiled
    again rather than out of date.
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
    except (OSError, TypeError):  # written where no file is, as at a prompt
        return repr((code.co_code, code.co_consts, code.co_names))


def _reached(function: Function) -> list[Function]:
    """The function and, once each, every Python function that it reaches by name."""
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
    # Sorted, since the order of a set differs from process to process.
    names = sorted({name for code in codes for name in code.co_names})
    values = {n: function.__globals__[n] for n in names if n in function.__globals__}
    values |= inspect.getclosurevars(function).nonlocals
    modules = [v for v in values.values() if isinstance(v, types.ModuleType)]
    for module in modules:
        if module.__name__.split(".")[0] not in ("numpy", "math", "numba"):
            # pbdkit's own are loaded when first used.
            members = {name: getattr(module, name) for name in names if hasattr(module, name)}
            values |= {f"{module.__name__}.{name}": value for name, value in members.items()}
            modules += [v for v in members.values() if isinstance(v, types.ModuleType)]
    return values


SOURCE, DIGESTS = "kernel.py", "digests.json"
_loaded: dict[tuple[Path, str], Any] = {}
"""Kernels of this process, by folder and key: reading one again takes several milliseconds."""


def load_kernel(source: str, functions: dict[str, Function], arguments: tuple[Any, ...]) -> Any:
    """The function `run` of a kernel with this source, made before or now, ready for arguments of
    these types; it is called with them once.

    The key covers the source of every function that rule and fracture model reach, so that an
    edited rule never runs an old kernel.
    """
    interpreted = bool(vars(numba.config)["DISABLE_JIT"])
    processor = cpu_target.target_context.codegen().magic_tuple()
    parts = [source, source_key(*functions.values(), length), vars(numba)["typeof"](arguments)]
    parts += [numba.__version__, np.__version__, sys.version, processor, interpreted]
    key = hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:32]
    if (index := (_asked_folder(), key)) not in _loaded:
        names = {name: compiled(function) for name, function in functions.items()}
        kernel = None if interpreted else _kept(source, key, names, arguments)
        _loaded[index] = kernel or _prepared(source, names, arguments)
    return _loaded[index]


def cache_folder() -> Path | None:
    """Return PBDKIT_CACHE_DIR, or `pbdkit` in the user's cache folder; None if it is not writable,
    or other users can write to it, whose code would be run."""
    folder = _asked_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        alone = not hasattr(os, "getuid") or (
            status.st_uid == os.getuid() and not status.st_mode & 0o022
        )
        return folder if alone and os.access(folder, os.W_OK | os.X_OK) else None
    except OSError:
        return None


def _asked_folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PBDKIT_CACHE_DIR") or Path(home) / "pbdkit")


def _kept(source: str, key: str, names: dict[str, Any], arguments: tuple[Any, ...]) -> Any:
    """The kernel as it lies in the cache, or as it is made and laid there; None where neither can
    be done."""
    if (cache := cache_folder()) is None:
        return None
    folder = cache / f"kernel_{key}"
    try:
        if kernel := _found(source, folder, names, arguments):
            return kernel
        with _alone(cache / f".{key}"):  # whoever wants the same meanwhile finds it then
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
    """A new one, laid into the folder."""
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making-") as name:
        directory = Path(name) / folder.name
        directory.mkdir()
        (directory / SOURCE).write_text(source, encoding="utf-8")
        run = _prepared(source, names, arguments, directory)
        (directory / DIGESTS).write_text(json.dumps(_digests(directory)), encoding="utf-8")
        if not _is_whole(folder):  # nobody else has been quicker
            shutil.rmtree(folder, ignore_errors=True)
            directory.replace(folder)
        return run


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """One process at a time, of those of one machine, so that none makes a kernel
    that another is making; where files cannot be locked, all at once."""
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
    """The kernel after its first call: compiled, or read from its folder."""
    file = str(folder / SOURCE) if folder else "<kernel>"
    module = ModuleType(folder.name if folder else "kernel")
    scope = vars(module)
    scope |= words(compiled) | names
    scope.update(njit=numba.njit, part=numba.njit(error_model="numpy"), prange=numba.prange)
    scope["KEPT"] = bool(folder)
    if folder:
        module.__file__ = file
        sys.modules[module.__name__] = module  # numba looks for what it has kept by this name
    exec(compile(source, file, "exec"), scope)
    module.run(*arguments)
    return module.run


def words(made: Callable[[Function], Any]) -> dict[str, Any]:
    """Return the names of every kernel, with functions converted by `made`."""
    kinds: dict[str, Any] = {kind.__name__: kind for kind in KINDS.values()}
    kinds |= {kind.__name__: kind for kind in (Here, Torn, CellStress, Stiffness)}
    numbers = {"int64": np.int64, "real": np.float32, "double": np.float64}
    return kinds | numbers | {"length": made(length), "namedtuple": namedtuple, "np": np}
