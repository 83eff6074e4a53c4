"""Figures of whole processes: peak memory."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

IMPORTS = """
import pbdkit.api, pbdkit.io.netcdf, pbdkit.stepping.numba_engine.engine, pbdkit.cli.run
"""
PEAK = """
from pbdkit.simulation import peak_memory
print(peak_memory())
"""
RUN = """
import sys
from pbdkit.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
"""
SHEET = """
name: big
lattice: {type: square, a: 1.0}
body: {type: grid, columns: 10, rows: 10}
rule: {type: barycentre}
initial: {type: noise, amplitude: 0.01}
leaders:
  - {select: {edge: left}, motion: {type: hold}}
steps: 4
record: {every: 4}
solver: {type: stepping, engine: compiled, threads: 1}
"""


def bytes_a_particle(size: int) -> tuple[float, str]:
    """Above the imports, of a whole `pbdkit run` that writes its file."""
    with tempfile.TemporaryDirectory() as name:
        (folder := Path(name)).joinpath("sheet.yaml").write_text(SHEET)
        bodies = ["--set", f"body.columns={size}", "--set", f"body.rows={size}"]
        call = ["run", "sheet.yaml", "--quiet", "--force"]
        _peak(RUN, folder, *call)  # the kernel is compiled before
        large, small, imports = (
            _peak(RUN, folder, *call, *bodies),
            _peak(RUN, folder, *call),
            _peak(IMPORTS, folder),
        )
    particles = (size + 2) ** 2 - 4
    note = f"{(large - small) / particles:.0f} B above a run of 10 × 10"
    return (large - imports) / particles, note


def _peak(code: str, folder: Path, *arguments: str) -> int:
    call = [sys.executable, "-c", code + PEAK, *arguments]
    done = subprocess.run(call, cwd=folder, check=True, capture_output=True, text=True)
    return int(done.stdout.splitlines()[-1])
