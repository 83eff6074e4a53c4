"""Measure the same sheet in other programs, each in a virtual environment and a process of its
own."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any

from sheets import Running, moving

HERE = Path(__file__).parent / "peers"
HOME = Path(tempfile.gettempdir()) / "pbdkit-peers"
PEERS = {
    "pyPBD": ("pypbd", "pypbd_sheet.py"),
    "warp": ("warp-lang", "warp_sheet.py"),
    "taichi": ("taichi", "taichi_sheet.py"),
}
SIZES = (100, 1000)
INSTALL_S, MEASURE_S = 240, 240


def peers() -> list[dict[str, Any]]:
    """ns a particle and iteration; the best of three processes of each, taken in turns."""
    pythons = {name: python_with(package) for name, (package, _) in PEERS.items()}
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for _ in range(3):
        for size in SIZES:
            for name, (_, script) in PEERS.items():
                for what, ns in _run_peer(pythons[name], script, size).items():
                    _keep(found, name, what, size, ns)
            for precision in ("float64", "float32"):
                _keep(found, "pbdkit", f"barycentre, {precision}", size, _own(size, precision))
    return list(found.values())


def _keep(found: dict[Any, Any], name: str, what: str, size: int, ns: Any) -> None:
    row = found.setdefault((name, what), {"program": name, "what": what})
    before = row.get(str(size))
    row[str(size)] = ns if before is None or isinstance(ns, str) else min(before, ns)


def _own(size: int, precision: str) -> float:
    from pairing import best

    steps = 10**7 // size**2
    solver = {"type": "stepping", "precision": precision}
    return best(Running(moving(size, solver=solver), steps)) / steps / size**2 * 1e9


def python_with(*packages: str) -> str:
    """The interpreter of an environment with these packages; empty where they do not install."""
    folder = HOME / "-".join(packages)
    python = folder / "bin" / "python"
    if not (folder / "installed").exists():
        try:
            venv.create(folder, with_pip=True, clear=True)
            call = [str(python), "-m", "pip", "install", "--quiet", *packages, "numpy"]
            subprocess.run(call, check=True, capture_output=True, timeout=INSTALL_S)
        except (subprocess.SubprocessError, OSError) as error:
            print(f"{', '.join(packages)}: not installed: {error}", file=sys.stderr)
            return ""
        (folder / "installed").touch()
    return str(python)


def _run_peer(python: str, script: str, size: int) -> dict[str, Any]:
    if not python:
        return {"": "does not install"}
    call = [python, str(HERE / script), str(size)]
    try:
        done = subprocess.run(call, check=True, capture_output=True, text=True, timeout=MEASURE_S)
    except subprocess.SubprocessError as error:
        print(f"{script} {size}: {error}", file=sys.stderr)
        return {"": "fails"}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found
