"""Loads kernels, kept in a cache folder under a key of everything that they were made of."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections import namedtuple
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np

from pbdkit.interfaces import FollowerRule, FractureModel, Here, Vector, length
from pbdkit.stepping.compiled.functions import compiled, source_key

_loaded: dict[tuple[Path, str], Any] = {}
"""Kernels of this process, by folder and key: reading one again takes several milliseconds."""


def load_kernel(source: str, rule: FollowerRule, fracture: FractureModel | None) -> Any:
    """The function `run` of a kernel with this source, compiled before or now.

    The key of the file covers the source of every function that the rule and the fracture model
    reach, so that an edited rule never runs an old kernel.
    """
    functions: list[Any] = [rule.gather, rule.apply]
    if fracture:
        functions += [fracture.breaks, fracture.fictitious, length]
    parts = [source, source_key(*functions), numba.__version__, np.__version__, sys.version]
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    if (known := (_asked_folder(), key)) in _loaded:
        return _loaded[known]
    path = cache_folder() / f"kernel_{key}.py"
    if not path.exists():
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        temporary.write_text(source, encoding="utf-8")
        temporary.replace(path)
    names: dict[str, Any] = {
        "gather": compiled(rule.gather),
        "apply": compiled(rule.apply),
        "breaks": compiled(fracture.breaks) if fracture else None,
        "fictitious": compiled(fracture.fictitious) if fracture else None,
        "length": compiled(length),
    }
    _loaded[known] = _module(path, names).run
    return _loaded[known]


def cache_folder() -> Path:
    """PBDKIT_CACHE_DIR, or `pbdkit` in the user's cache folder; a temporary one where neither
    can be written."""
    folder = _asked_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="pbdkit-"))


def _asked_folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PBDKIT_CACHE_DIR") or Path(home) / "pbdkit")


def _module(path: Path, names: dict[str, Any]) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    given = {
        "Vector": Vector,
        "Here": Here,
        "namedtuple": namedtuple,
        "njit": numba.njit,
        "prange": numba.prange,
        "int64": np.int64,
        "float32": np.float32,
        "float64": np.float64,
    }
    vars(module).update(given | names)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module
