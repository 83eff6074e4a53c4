"""Report of ``--version --verbose``: versions of Python, dependencies and plugins, and the
system."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import pbdkit
from pbdkit.hooks import installed_plugins
from pbdkit.memory import machine_memory

VARIABLES = re.compile(r"PBDKIT_\w+|\w+_NUM_THREADS|NUMBA_\w+")
"""Environment variables on which results or speed can depend."""
REQUIREMENT = re.compile(r"(?P<name>[A-Za-z0-9._-]+).*?(?:extra == ['\"](?P<extra>\w+)['\"])?$")
"""Name and extra of a requirement."""


def version_report() -> str:
    """Return the versions and the system in lines, for the report of a defect.

    No dependency is imported, so that the report is complete where one of them is broken.
    """
    rows = [*_system(), *_dependencies(), *_plugins(), *_environment()]
    width = max(len(name) for name, _ in rows)
    return "\n".join(
        [f"pbdkit {pbdkit.__version__}", *(f"  {name:<{width}}  {text}" for name, text in rows)]
    )


def _system() -> Iterator[tuple[str, str]]:
    yield "location", str(Path(pbdkit.__file__).parent)
    yield "python", f"{platform.python_version()} ({platform.python_implementation()})"
    yield "system", platform.platform()
    yield "processors", f"{os.cpu_count()} ({platform.machine()})"
    yield "memory", f"{machine_memory() / 2**30:.1f} GiB available"


def _dependencies() -> Iterator[tuple[str, str]]:
    """Generate the version of each dependency, and the extra of those that are not installed."""
    extras: dict[str, list[str]] = {}
    for requirement in requires("pbdkit") or []:
        found = REQUIREMENT.match(requirement)
        assert found is not None, requirement
        extras.setdefault(found["name"], []).extend([found["extra"]] if found["extra"] else [])
    extras.pop("pbdkit", None)
    for name, needed_by in extras.items():
        try:
            yield name, version(name)
        except PackageNotFoundError:
            remedy = f" (extra {' or '.join(needed_by)})" if needed_by else ""
            yield name, f"not installed{remedy}"


def _plugins() -> Iterator[tuple[str, str]]:
    for plugin in installed_plugins():
        yield plugin.distribution, f"{plugin.version}, plugin {plugin.unusable}".rstrip()


def _environment() -> Iterator[tuple[str, str]]:
    for name in sorted(filter(VARIABLES.fullmatch, os.environ)):
        yield name, os.environ[name]
