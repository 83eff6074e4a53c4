"""Test commands without extras, and with them: ``python tests/installs.py [--each]``.

The wheel is built from the source distribution of this checkout, and `twine` checks both. `pip
install` puts it into an environment of its own, in which commands work or name the extra that they
need. The extra `all` has a further environment, which holds what pip
adds for it and takes the rest from the first. `--each` does the same with every extra alone
instead: what one extra brings is of no use to what needs another. `gpu` is left out: it takes half
a gigabyte, and has a session of its own in noxfile.py. In each environment every row of `CASES` is
tried.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
BARE = "bare"
ALL = "all"
LEFT_OUT = (ALL, "gpu")
FILES = {
    "torn.yaml": """\
name: torn
lattice: {type: square, a: 1.0}
body: {type: grid, columns: 6, rows: 4}
rule: {type: barycentre}
fracture: {type: strain, failure: 0.05}
leaders:
  - {select: {edge: left}, motion: {type: hold}}
  - {select: {edge: right}, motion: {type: velocity, velocity: [0.05, 0.0], steps: 20}}
steps: 20
""",
    "sweep.yaml": "experiment: start\nvary: {seed: [1, 2]}\n",
    "field.csv": "x,y,ux,uy\n"
    + "".join(f"{x},{y},{0.01 * x},{-0.003 * y}\n" for x in range(7) for y in range(4)),
    "fit.yaml": """\
experiment:
  name: pulled
  lattice: {type: square, a: 1.0}
  body: {type: grid, columns: 7, rows: 4}
  neighbours: {type: chebyshev, shells: 1}
  rule: {type: elastic, poisson_ratio: 0.3}
  frame: {type: natural}
  leaders:
    - {select: {edge: left}, motion: {type: measured, file: field.csv}}
    - {select: {edge: right}, motion: {type: measured, file: field.csv}}
  steps: 1
  solver: {type: equilibrium}
unknown: {rule.poisson_ratio: [0.0, 0.49]}
measured: {file: field.csv, noise: 0.001}
modes: 1
""",
}
FILES["sampled.yaml"] = FILES["fit.yaml"] + "sampler: {walkers: 4, steps: 10}\n"
"""Files that the commands below use."""
INTERRUPTED = """
import os, signal, click
echo = click.echo

def interrupt_when_ready(text, **more):
    echo(text, **more)
    if text == "Ctrl-C ends it.":
        os.kill(os.getpid(), signal.SIGINT)

click.echo = interrupt_when_ready
from pbdkit.cli import main
main(["live", "start", "--no-browser"])
"""
"""`pbdkit live`, interrupted as soon as it serves."""


@dataclass(frozen=True)
class Case:
    """A command, or a text of Python, with the extras of which any one lets it work.

    Without them it ends with status 2 (Python: 1) and the words ``pip install 'pbdkit[EXTRA]'``
    with the first of them. `told` is what it prints where it works, and `status` how it ends then.
    """

    call: str
    extras: tuple[str, ...] = ()
    told: str = ""
    status: int = 0
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def arguments(self) -> list[str]:
        """Return the arguments after the name of the interpreter."""
        return ["-c", self.call] if "pbdkit." in self.call else ["-m", "pbdkit", *self.call.split()]


RESULTS = (
    Case("run start", told="complete"),
    Case("run torn.yaml", told="complete"),
)
"""Arguments with which the other commands are tried."""
CASES = (
    Case("check start", told="start: valid"),
    Case("resume start.nc --steps 220", told="complete"),
    Case("verify start.nc", told="unchanged since it was written"),
    Case("explain torn.nc", told="bonds broke"),
    Case("export start.nc", told="written"),
    Case("report start.nc", told="written"),
    Case("identify start", told="diffusion"),
    Case("experiments", told="paper/a"),
    Case("schema experiment", told="properties"),
    Case("init new.yaml", told="written"),
    Case("plugins list", told="barycentre"),
    Case("plugins new pbdkit-fresh", told="pbdkit-fresh"),
    Case("sweep sweep.yaml", told="2 of 2 members"),
    Case("fit fit.yaml", told="poisson_ratio"),
    Case("bench start --steps 2", told="numba is not installed: pip install 'pbdkit[fast]'"),
    Case("import pbdkit; print(pbdkit.open('start.nc').pbd)"),
    Case("import pbdkit; pbdkit.rerun(pbdkit.open('start.nc'), progress=False)"),
    Case("import pbdkit; pbdkit.run('material/bar', progress=False)"),
    Case("run start -o compiled.nc --set solver.engine=compiled", ("fast",), "engine: compiled"),
    Case("run start -o gpu.nc --set solver.engine=gpu", ("gpu",)),
    Case("plot start.nc", ("plot", "movie"), "start.png written"),
    Case("curve torn.nc broken-bonds", ("plot", "movie"), "written"),
    Case("fit fit.yaml -o f.json --plot fit.png", ("plot", "movie"), "fit.png written"),
    Case("bench start --steps 2 --plot b.png", ("plot", "movie"), "b.png written"),
    Case("import pbdkit; pbdkit.open('start.nc').pbd.plot()", ("plot", "movie")),
    Case("animate start.nc --every 50", ("movie",), "start.mp4 written"),
    Case("animate start.nc -o start.gif --every 50", ("movie", "plot"), "start.gif written"),
    Case("check modelling/strip", ("units",), "valid"),
    Case("check modelling/weakest-place", ("random",), "valid"),
    Case("fit sampled.yaml", ("sample", "random"), "sampler"),  # GSTools brings emcee, too
    Case("sweep sweep.yaml -o other --dask inproc://none", ("sweep",), "no scheduler", 2),
    Case(INTERRUPTED, ("live",), "Ctrl-C ends it"),
    Case("import pbdkit; pbdkit.live('start').close()", ("live",)),
    Case(
        "run start -o ranks.nc", ("mpi",), "no MPI library", 2, {"PMI_SIZE": "2", "PMI_RANK": "0"}
    ),
)
"""Cases that are tried, in this order."""


def main() -> int:
    """Make the environments, try the cases, and return 1 if one had an unexpected result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", action="store_true", help="Each extra alone in place of `all`.")
    each = parser.parse_args().each
    with tempfile.TemporaryDirectory(prefix="pbdkit-installs-") as name:
        folder = Path(name)
        wheel = _wheel(folder)
        bare = _environment(folder / BARE, None, str(wheel))
        known = _extras()
        extras = {e: {e} for e in known if e not in LEFT_OUT} if each else {ALL: known[ALL]}

        def try_in(extra: str) -> list[str]:
            own = bare
            if extra != BARE:
                own = _environment(folder / extra, bare, f"{wheel}[{extra}]")
            return _faults(extra, extras.get(extra, set()), own, folder / f"work-{extra}")

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            faults = [fault for found in pool.map(try_in, [BARE, *extras]) for fault in found]
    print("\n".join(faults) or f"bare, and with {', '.join(extras)}: as expected")
    return 1 if faults else 0


def _extras() -> dict[str, set[str]]:
    """The extras of the project; `all` with the names of those that it takes together."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional: dict[str, list[str]] = project["optional-dependencies"]
    (together,) = optional[ALL]
    return {name: {name} for name in optional} | {ALL: set(together[:-1].split("[")[1].split(","))}


def _wheel(folder: Path) -> Path:
    """Build the source distribution and from it the wheel, check both, and return the wheel."""
    subprocess.run([sys.executable, "-m", "build", "--outdir", folder, ROOT], check=True)
    built = sorted(folder.iterdir())
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *built], check=True)
    source, wheel = sorted(built, key=lambda path: path.suffix)
    assert (source.suffix, wheel.suffix) == (".gz", ".whl"), built
    return wheel


def _environment(folder: Path, base: Path | None, *wanted: str) -> Path:
    """Make an environment with the requested packages, on top of another, and return its
    interpreter."""
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    if base:
        for packages in folder.glob("lib/*/site-packages"):
            of_base = base.parent.parent / packages.relative_to(folder)
            (packages / "base.pth").write_text(f"{of_base}\n")
    _pip("--python", str(python), "install", *wanted)
    return python


def _pip(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pip", "-q", *arguments], check=True)


def _faults(name: str, extras: set[str], python: Path, folder: Path) -> list[str]:
    """Return a line for each case with an unexpected result with these extras."""
    folder.mkdir()
    for file, text in FILES.items():
        (folder / file).write_text(text)
    faults = []
    for case in (*RESULTS, *(c for c in CASES if c.extras or not extras)):
        works = not case.extras or not extras.isdisjoint(case.extras)
        python_call = case.arguments[0] == "-c" and case.call != INTERRUPTED
        status = case.status if works else 1 if python_call else 2
        told = case.told if works else f"pip install 'pbdkit[{case.extras[0]}]'"
        done = subprocess.run(
            [python, *case.arguments],
            cwd=folder,
            env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | case.environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        output = done.stdout + done.stderr
        if done.returncode != status or told not in output or "a bug in pbdkit" in output:
            last = (output.strip().splitlines() or [""])[-1]
            faults.append(f"{name}: {case.call}: status {done.returncode}, not {status} with "
                          f"{told!r}: {last}")  # fmt: skip
    shutil.rmtree(folder)
    return faults


if __name__ == "__main__":
    sys.exit(main())
