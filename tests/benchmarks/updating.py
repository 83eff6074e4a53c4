"""Compare `pbdkit fit plate-with-hole` with finite-element model updating of the same specimen.

    python tests/benchmarks/updating.py [--turns N] [--plain]

Values with their errors, discretisation errors of both, and times of whole calls, from the file to
values and errors, taken in turns on one thread. Each lattice of pbdkit has for its rival the
coarsest mesh of quadratic elements with displacements that are at least as exact. `--plain` also
times elements that are assembled again for every state, with derivatives by differences. Needs
scikit-fem.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import yaml
from finite_elements.specimen import FILE, HEIGHT, LENGTH, Plate, lame, read
from finite_elements.updating import MARGIN, Estimate, Found, alike, usual
from pairing import of_times
from scipy.interpolate import RegularGridInterpolator

import pbdkit

SPACINGS, SHIPPED = (1.0, 0.5, 0.25), 0.25
MESHES, FINEST = (2, 4, 6, 8, 12, 16), 40
INSETS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)
FASTER, WITHIN, POISSON = 10.0, 1.96, 0.308
RATIO = "rule.poisson_ratio"


class Off(NamedTuple):
    """Discretisation errors: root mean square of displacements at the points of the measurement and
    the largest, in mm; of the force on the right end, as a share of it."""

    mean: float
    largest: float
    force: float


def described(a: float) -> dict[str, Any]:
    """The shipped fit on a lattice of that spacing."""
    fit = yaml.safe_load(FILE.with_suffix(".yaml").read_text("utf-8"))
    fit["experiment"]["lattice"]["a"] = a
    fit["measured"]["file"] = str(FILE)
    for leader in fit["experiment"]["leaders"]:
        leader["motion"]["file"] = str(FILE)
    return fit


def own(a: float) -> Found:
    """Return the estimates of pbdkit."""
    found = pbdkit.fit(described(a))
    poisson, young = found.values[RATIO], found.youngs_modulus
    assert young
    return Found(
        Estimate(poisson.value, poisson.error / poisson.growth),
        Estimate(young.value, young.error / young.growth),
        found.ratio,
        found.as_dict()["evaluations"],
    )


def end(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth displacement of the ends, as large as the measured one."""
    s, far = 2.0 * y / HEIGHT - 1.0, x / LENGTH
    ux = 0.02 + far * (0.042 + 0.002 * s**2) + 1e-3 * s**3
    return np.stack([ux, 2e-3 - 4e-3 * far - 1.2e-3 * s + 2e-4 * s**2], axis=-1)


def on_lattice(a: float) -> tuple[np.ndarray, float]:
    """Return pbdkit's displacements at the points, (axis · point,), and the force on the right
    end."""
    experiment, y = described(a)["experiment"], np.arange(0.0, HEIGHT + a / 2, a)
    for leader, x in zip(experiment["leaders"], (0.0, LENGTH), strict=True):
        at = np.column_stack([np.full_like(y, x), y])
        moved = {"points": at.tolist(), "displacements": end(x, y).tolist()}
        leader["motion"] = {"type": "measured", **moved}
    experiment["rule"]["poisson_ratio"] = POISSON
    experiment["diagnostics"] = [
        {"type": "displacement"},
        {"type": "reaction", "youngs_modulus": 1.0},
    ]
    experiment["solver"] = {"type": "equilibrium", "tolerance": 1e-9}
    ds = pbdkit.run(experiment, progress=False)
    at, u = ds.reference.values, ds.u.values[-1]
    sites = np.round(at / a).astype(int)
    grid = np.full((*(sites.max(axis=0) + 1), 2), np.nan)
    grid[tuple(sites.T)] = u
    axes = tuple(a * np.arange(n) for n in grid.shape[:2])
    found = RegularGridInterpolator(axes, grid)(read().inside(MARGIN).points)
    return found.T.ravel(), float(ds.reaction.values[-1, 1, 0])


@cache
def on_mesh(n: int) -> tuple[np.ndarray, float]:
    """Return the displacements and the force of finite elements."""
    plate = Plate(n)
    stiffness, at = plate.stiffness(lame(POISSON)), plate.basis.doflocs
    both = end(*at)
    u = np.where(plate.along_x, both[:, 0], both[:, 1])
    u[plate.free] = 0.0
    u[plate.free] = plate.factorised(stiffness).solve(-(stiffness @ u)[plate.free])
    shown = plate.shows(read().inside(MARGIN).points) @ u
    return shown, float((stiffness @ u)[plate.pulled].sum())


def off(found: tuple[np.ndarray, float]) -> Off:
    """Against the finest mesh; where a point has no value it is left out."""
    right, force = on_mesh(FINEST)
    rest = found[0] - right
    rest = rest[np.isfinite(rest)]
    return Off(float(np.sqrt(np.mean(rest**2))), float(np.abs(rest).max()), found[1] / force - 1.0)


def rivals() -> dict[float, tuple[Off, int]]:
    """Return, for each spacing, the error and the coarsest mesh that is as exact."""
    of_meshes = {n: off(on_mesh(n)) for n in MESHES}
    for n, error in of_meshes.items():
        print(f"error of quadratic elements, {n} over the height | {worded(error)}", flush=True)
    found = {}
    for a in SPACINGS:
        error = off(on_lattice(a))
        print(f"error of pbdkit, spacing {a} mm | {worded(error)}", flush=True)
        found[a] = error, next(n for n in MESHES if of_meshes[n].mean <= error.mean)
    return found


def worded(of: Off | Found) -> str:
    """In a cell of the table."""
    if isinstance(of, Off):
        return (
            f"displacements {1e3 * of.mean:.3f} µm rms, {1e3 * of.largest:.2f} µm at most; "
            f"force {100 * of.force:+.3f} %"
        )
    return (
        f"ν {of.poisson.value:.4f} ± {of.poisson.error:.4f}, E {of.young.value:.0f} ± "
        f"{of.young.error:.0f} MPa, residual {of.ratio:.2f} of the noise, {of.states} states"
    )


def values() -> Iterator[str]:
    """Rows of what is found."""
    for inset in INSETS:
        yield f"usual updating, ends prescribed {inset} mm within | " + worded(
            usual(8, plain=False, inset=inset)
        )
    for n in MESHES[1:]:
        right = alike(n, plain=False)
        yield f"elements with all that pbdkit has, {n} over the height | {worded(right)}"
    for a in SPACINGS:
        found = own(a)
        apart = [
            (mine.value - theirs.value) / mine.error
            for mine, theirs in ((found.poisson, right.poisson), (found.young, right.young))
        ]
        goal = f"pbdkit, spacing {a} mm: within {WITHIN} errors of the finest of these"
        yield (
            f"{goal} | {worded(found)}: ν off by {apart[0]:+.2f}, E by {apart[1]:+.2f} "
            "standard errors"
        )


def times(works: dict[str, Callable[[], object]], turns: int) -> dict[str, list[float]]:
    """Seconds of each in turns, after one that does not count where there are several."""
    found: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(turns + (turns > 1)):
        for name, work in works.items():
            begun = time.perf_counter()
            work()
            if turn or turns == 1:
                found[name].append(time.perf_counter() - begun)
    return found


def two_parameters(turns: int) -> str:
    """A row: a whole call of the program, from its start, with 25 000 particles."""
    fit = described(0.25)
    region = {"half": {"type": "rectangle", "width": LENGTH / 2, "height": HEIGHT}}
    rule = fit["experiment"]["rule"] | {"stiffness": {"otherwise": 1.0, "half": 1.0}}
    fit["experiment"] |= {"regions": region, "rule": rule}
    fit["unknown"] |= {"rule.stiffness.half": [0.5, 2.0]}
    with TemporaryDirectory() as name:
        file = Path(name, "two.yaml")
        file.write_text(yaml.safe_dump(fit), "utf-8")
        call = [sys.executable, "-m", "pbdkit", "fit", str(file), "--quiet", "--force"]
        work = partial(subprocess.run, [*call, "-o", str(file.with_suffix(".json"))], check=True)
        found = min(times({"": work}, turns)[""])
    return f"2 parameters, 25 000 particles, whole call: 2 s | {found:.2f} s"


def compared(a: float, n: int, turns: int, plain: bool) -> Iterator[str]:
    """Rows of times: the mesh of n elements against the lattice."""
    works: dict[str, Callable[[], object]] = {
        "pbdkit": partial(own, a),
        "as pbdkit has it, written well": partial(alike, n, plain=False),
        "usual, written well": partial(usual, n, plain=False, inset=2.0),
        "usual, plain": partial(usual, n, plain=True, inset=2.0),
    }
    found = times(works, turns)
    if plain:
        found["as pbdkit has it, plain"] = times({"": partial(alike, n, plain=True)}, 1)[""]
    mine = found.pop("pbdkit")
    for name, theirs in found.items():
        ratio = min(theirs) / min(mine)
        spread = ""
        if len(theirs) > 1:
            one = of_times(theirs, mine)
            spread = f" ({one.low:.2f}-{one.high:.2f})"
        yield (
            f"spacing {a} mm against {n} elements over the height, {name}: at least {FASTER:g} × | "
            f"{ratio:.2f} ×{spread}: {min(theirs):.2f} s against {min(mine):.2f} s"
        )


def main() -> None:
    """Print all rows of the comparison."""
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--turns", type=int, default=5)
    asked.add_argument("--plain", action="store_true")
    given = asked.parse_args()
    print("goal | measured")
    print(two_parameters(given.turns), flush=True)
    rivals_of = rivals()
    for row in values():
        print(row, flush=True)
    for a, (_, n) in rivals_of.items():
        plain = given.plain and a == SHIPPED
        for row in compared(a, n, given.turns, plain):
            print(row, flush=True)


if __name__ == "__main__":
    main()
