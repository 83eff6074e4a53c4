"""Strengths from synthetic repeats of known ones: bias, and how often intervals hold the truth.

    python tests/reliability/strength_coverage.py drawn --trials 2000
    python tests/reliability/strength_coverage.py torn --trials 200
    python tests/reliability/strength_coverage.py closed --trials 500
    python tests/reliability/strength_coverage.py simulated --trials 40

drawn: strengths of all bonds of a sheet are drawn and its first break is computed; with --law
weibull the intervals that are taken are put beside those of maximum likelihood (Wald) and of its
profile. torn: chains are torn by pbdkit, by the plugin's Weibull or by `scatter`. closed: the same
chains in closed form, and strengths found by simulation. simulated: sheets that bear more than at
their first break are torn, and strengths are found by simulation. A row a goal: `goal | measured`.
Exits with 1 where one is missed by more than chance does, three standard deviations.
"""

from __future__ import annotations

import argparse
import runpy
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

import numpy as np
from scipy.stats import chi2

import pbdkit
from pbdkit.fitting import strength as strength_simulation
from pbdkit.fitting.fit_file import Peaks, StrengthFit
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.strength import (
    LAWS,
    BondStrains,
    Breaks,
    ElasticResponse,
    MachineReading,
    Specimen,
    Specimens,
    fit_strength_of,
    fitted_strength,
    seeded,
    weibull_sums,
)
from pbdkit.model.reading import Source

TRUE = {"weibull": (0.02, 8.0), "uniform": (0.02, 0.3)}
BOUNDS = {"weibull": [[0.002, 0.5], [1.0, 60.0]], "uniform": [[0.002, 0.5], [0.02, 0.98]]}
BIAS, COVERAGE = 0.1, (0.935, 0.965)


def pulled(body: dict[str, Any], fracture: dict[str, Any], far: float) -> dict[str, Any]:
    """A body of springs, pulled along x."""
    return {
        "name": "pulled",
        "lattice": {"type": "square", "a": 1.0},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "body": body,
        "rule": {"type": "elastic", "poisson_ratio": 1 / 3},
        "frame": {"type": "natural"},
        "fracture": fracture,
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [far, 0]}},
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "increments": 400, "tolerance": 1e-6},
    }


BONDS, STEPS = 16, 120
"""Bonds of a chain, and steps in which it is torn."""
SHEET = {"type": "grid", "columns": 9, "rows": 6}
SMALL = {"type": "grid", "columns": 5, "rows": 3}


def fractures(law: str) -> dict[str, Any]:
    """With the true strengths."""
    first, second = TRUE[law]
    return {
        "weibull": {"type": "weibull", "scale": first, "modulus": second},
        "uniform": {"type": "strain", "failure": first, "scatter": second},
    }[law]


def built(law: str, parts: dict[str, Any]) -> pbdkit.Experiment:
    """With the plugin's class, installed or not."""
    plugin = runpy.run_path(str(ROOT / "plugins/pbdkit-weibull/pbdkit_weibull.py"))["Weibull"]
    return pbdkit.Experiment.build(Source("pulled", parts), [plugin])


def elastic_of(law: str, experiment: pbdkit.Experiment, of: str = "force") -> ElasticResponse:
    """The body before anything breaks."""
    for path in LAWS[law].paths:
        experiment = Parameter(path).put(experiment, LAWS[law].whole(path))
    return ElasticResponse.of(experiment, Peaks(peaks=(1.0, 1.0, 1.0), of=of))


def described(law: str, peaks: Any, **more: Any) -> StrengthFit:
    """Return the fit of such peaks."""
    return StrengthFit(
        kind="strength",
        experiment="",
        unknown=dict(zip(LAWS[law].paths, BOUNDS[law], strict=True)),
        measured=Peaks(peaks=tuple(peaks), of="force"),
        **more,
    )


def first_breaks(law: str, strains: BondStrains, count: int, numbers: Any) -> Any:
    """Load factors of as many specimens."""
    first, second = TRUE[law]
    size = count, len(strains.p)
    if law == "weibull":
        strengths = first * numbers.weibull(second, size)
    else:
        strengths = first * (1.0 + second * numbers.uniform(-1.0, 1.0, size))
    return np.array([strains.load_at(each).min() for each in strengths])


def estimated(law: str, strains: BondStrains, loads: Any) -> list[list[float]]:
    """(parameter, (value, low, high)) by the likelihood."""
    fit = described(law, loads)
    (a, b) = (fit.unknown[path] for path in LAWS[law].paths)
    draws = LAWS[law].draws(strains.merged(), Breaks(loads, np.ones(len(loads), bool)), (a, b))
    return _rows(fitted_strength(fit, LAWS[law].paths, draws, "likelihood", LAWS[law]))


def _rows(found: Any) -> list[list[float]]:
    return [[e.value, e.low, e.high] for e in found.values.values()]


def by_others(strains: BondStrains, loads: Any) -> dict[str, list[list[float]]]:
    """Return the same for the largest likelihood: Wald's intervals, by observed information in
    logarithms, and those of the profile."""
    n, merged = len(loads), strains.merged()
    wide = 6.0 / n**0.5
    log_m = np.linspace(np.log(8.0) - wide, np.log(8.0) + wide, 161)
    m = np.exp(log_m)
    sums, slopes = weibull_sums(merged, Breaks(loads, np.ones(n, bool)), m)
    total = np.logaddexp.reduce(sums, axis=1)
    profile = slopes.sum(axis=1) - n * total
    best = int(profile.argmax())
    log_s = (total - np.log(n)) / m
    bend = -np.gradient(np.gradient(profile, log_m), log_m)[best]
    # ln s given m has the error 1/(m √n); along the ridge it goes with ln m.
    ridge = np.gradient(log_s, log_m)[best]
    errors = np.array([(ridge**2 / bend + 1.0 / (m[best] ** 2 * n)) ** 0.5, bend**-0.5])
    middle = np.array([log_s[best], log_m[best]])
    grid = np.linspace(middle[0] - 6 * errors[0], middle[0] + 8 * errors[0], 201)
    joint = slopes.sum(axis=1) - n * m * grid[:, None] - np.exp(total - m * grid[:, None])
    wald = np.exp([middle, middle - 1.96 * errors, middle + 1.96 * errors]).T
    limit = chi2.ppf(0.95, 1) / 2
    ends = []
    for nodes, values in ((grid, joint.max(axis=1)), (log_m, profile)):
        inside = nodes[values > values.max() - limit]
        ends.append([inside[0], inside[-1]])
    held = np.column_stack([np.exp(middle), np.exp(ends)])
    return {"Wald": wald.tolist(), "profile": held.tolist()}


def report(law: str, found: Any, how: str, judged: bool = True) -> bool:
    """Print rows of (trial, parameter, (value, low, high)); return whether the goals are met,
    except for chance."""
    found, fine = np.array(found), True
    chance = 3.0 / len(found) ** 0.5
    for n, path in enumerate(LAWS[law].paths):
        true, (value, low, high) = TRUE[law][n], found[:, n].T
        bias = (value.mean() - true) / value.std(ddof=1)
        held = float(((low < true) & (true < high)).mean())
        print(f"{how}: bias of {path} < {BIAS} standard errors | {bias:+.3f} (± {chance / 3:.3f})")
        print(f"{how}: 95 % intervals of {path} hold it in 93.5 to 96.5 % | {held:.1%}", flush=True)
        room = chance * 0.95**0.5 * 0.05**0.5
        fine &= abs(bias) < BIAS + chance
        fine &= COVERAGE[0] - room <= held <= COVERAGE[1] + room
    return bool(fine or not judged)


def drawn(law: str, trials: int, count: int, numbers: Any) -> bool:
    """Strengths drawn, first breaks computed."""
    strains = elastic_of(law, built(law, pulled(SHEET, fractures(law), 0.3))).strains
    found: dict[str, list[Any]] = {"integrated": []}
    for _ in range(trials):
        loads = first_breaks(law, strains, count, numbers)
        found["integrated"].append(estimated(law, strains, loads))
        if law == "weibull":
            for name, rows in by_others(strains, loads).items():
                found.setdefault(name, []).append(rows)
    how = f"{law}, {count} specimens"
    fine = True
    for name, rows in found.items():
        fine &= report(law, rows, f"{how}, {name}", name == "integrated")
    return fine


def chains(law: str, rows: int, seed: int = 0) -> dict[str, Any]:
    """Chains side by side that do not feel each other."""
    far = TRUE[law][0] * BONDS * (1.5 if law == "weibull" else 1.0)
    pull = {"type": "velocity", "velocity": [far / STEPS, 0.0], "steps": STEPS}
    return pulled({"type": "grid", "columns": BONDS + 1, "rows": rows}, fractures(law), far) | {
        "seed": seed,
        "lattice": {"type": "rectangular", "a": 1.0, "b": 2.0},
        "neighbours": {"type": "coordination", "shells": 1},
        "rule": {"type": "barycentre"},
        "frame": {"type": "none"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": pull},
        ],
        "steps": STEPS,
        "solver": {"type": "equilibrium", "increments": STEPS, "tolerance": 1e-6},
    }


def torn(law: str, trials: int, count: int, numbers: Any) -> bool:
    """Chains torn by `pbdkit.run`: each fails in the step in which its first bond breaks, and the
    middle of that is what is measured."""
    strains = elastic_of(law, built(law, chains(law, 1)), "factor").strains
    found = []
    for _ in range(trials):
        ds = pbdkit.run(
            built(law, chains(law, count, int(numbers.integers(2**31)))), progress=False
        )
        row = ds.j.values[ds.bond_ends.values[:, 0] - 1]
        step = np.where(ds.broken_step > 0, ds.broken_step, STEPS)
        first = np.array([step[row == j].min() for j in np.unique(row)])
        found.append(estimated(law, strains, (first - 0.5) / STEPS))
    return report(law, found, f"{law}, {count} chains torn")


def simulated(law: str, trials: int, count: int, numbers: Any) -> bool:
    """Test by simulation of peaks."""
    experiment = built(law, pulled(SMALL, fractures(law), 0.3))
    elastic = elastic_of(law, experiment)
    source, found = Specimens.of(experiment, Peaks(peaks=(1, 1, 1), of="force"), elastic), []
    for n in range(trials):
        seeds = numbers.integers(2**31, size=count).tolist()
        peaks = [source.tear(seeded(experiment, seed)).peak.force for seed in seeds]
        fit = described(law, peaks, method="simulation", seed=n + 1)
        found.append(_rows(fit_strength_of(fit, experiment)))
    return report(law, found, f"{law}, {count} specimens, simulation")


@dataclass(frozen=True)
class Chains:
    """In the place of specimens: chains, torn in closed form."""

    peaks: Peaks
    elastic: None = None

    def tear(self, experiment: pbdkit.Experiment) -> Specimen:
        """Tear the specimen by the strengths of its bonds."""
        fracture, numbers = experiment.fracture, np.random.default_rng(experiment.seed)
        if fracture.type == "weibull":
            least = fracture.scale * numbers.weibull(fracture.modulus, BONDS).min()
        else:
            least = fracture.failure * (1 + fracture.scatter * numbers.uniform(-1, 1, BONDS).min())
        return Specimen(MachineReading(least, least), None, True)


def closed(law: str, trials: int, count: int, numbers: Any) -> bool:
    """Test by simulation of chains that need no run."""
    experiment, found = built(law, chains(law, 1)), []
    source = Chains(Peaks(peaks=(1, 1, 1), of="force"))
    for n in range(trials):
        seeds = numbers.integers(2**31, size=count).tolist()
        peaks = [source.tear(seeded(experiment, seed)).peak.force for seed in seeds]
        fit = described(law, peaks, method="simulation", seed=n + 1)
        draws = strength_simulation.fit_by_simulation(fit, experiment, source)
        found.append(_rows(fitted_strength(fit, LAWS[law].paths, draws, "simulation", LAWS[law])))
    return report(law, found, f"{law}, {count} chains, simulation")


def main() -> None:
    """One row a goal."""
    asked = argparse.ArgumentParser()
    asked.add_argument("which", choices=["drawn", "torn", "closed", "simulated"])
    asked.add_argument("--law", choices=[*LAWS], action="append")
    asked.add_argument("--trials", type=int, default=200)
    asked.add_argument("--specimens", type=int, default=30)
    asked.add_argument("--seed", type=int, default=1)
    given = asked.parse_args()
    warnings.simplefilter("ignore", pbdkit.PbdkitWarning)  # rows that do not feel each other
    print("goal | measured")
    fine = True
    for law in given.law or LAWS:
        numbers = np.random.default_rng(given.seed)
        ways = {"drawn": drawn, "torn": torn, "closed": closed, "simulated": simulated}
        way = ways[given.which]
        fine &= way(law, given.trials, given.specimens, numbers)
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    main()
