"""Loads kernels, kept in a cache folder under a key of everything that they were made of.

A kernel has a folder of its own with its source, what numba keeps beside it, and the digests of
both. What does not agree with its digests is never loaded but made anew; where nothing can be kept,
or others could write there, a kernel is made in memory.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
import sys
import tempfile
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.registry import cpu_target

from pbdkit.interfaces import CellStress, Here, Stiffness, Torn, length
from pbdkit.interfaces.vector import KINDS
from pbdkit.stepping.compiled.functions import compiled, source_key

Function = Callable[..., Any]
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
    if (known := (_asked_folder(), key)) not in _loaded:
        names = {name: compiled(function) for name, function in functions.items()}
        kept = None if interpreted else _kept(source, key, names, arguments)
        _loaded[known] = kept or _ready(source, names, arguments)
    return _loaded[known]


def cache_folder() -> Path | None:
    """PBDKIT_CACHE_DIR, or `pbdkit` in the user's cache folder; None where it cannot be written, or
    others can write there too, whose code would be run."""
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
        if found := _found(source, folder, names, arguments):
            return found
        with _alone(cache / f".{key}"):  # whoever wants the same meanwhile finds it then
            found = _found(source, folder, names, arguments)
            return found or _made(source, folder, names, arguments)
    except (OSError, pickle.PicklingError):
        return None


def _found(source: str, folder: Path, names: dict[str, Any], arguments: tuple[Any, ...]) -> Any:
    """The kernel in a folder; None where what lies there is of no use, whatever it says."""
    if _is_whole(folder):
        with suppress(Exception):
            return _ready(source, names, arguments, folder)
    return None


def _made(source: str, folder: Path, names: dict[str, Any], arguments: tuple[Any, ...]) -> Any:
    """A new one, laid into the folder."""
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making-") as name:
        made = Path(name) / folder.name
        made.mkdir()
        (made / SOURCE).write_text(source, encoding="utf-8")
        run = _ready(source, names, arguments, made)
        (made / DIGESTS).write_text(json.dumps(_digests(made)), encoding="utf-8")
        if not _is_whole(folder):  # nobody else has been quicker
            shutil.rmtree(folder, ignore_errors=True)
            made.replace(folder)
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
    """Whether every file is as it was when the kernel was made."""
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


def _ready(
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
    """What every kernel may name, with functions as they are `made` for whoever runs it."""
    kinds: dict[str, Any] = {kind.__name__: kind for kind in KINDS.values()}
    kinds |= {kind.__name__: kind for kind in (Here, Torn, CellStress, Stiffness)}
    numbers = {"int64": np.int64, "real": np.float32, "double": np.float64}
    return kinds | numbers | {"length": made(length), "namedtuple": namedtuple, "np": np}
