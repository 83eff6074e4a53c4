"""Strengths from specimens that are torn, where no likelihood is known: a synthetic one.

Single specimens are torn at strengths all over the bounds, and then where the measurement is
likely. Mean and spread of ln peak follow from them by regression over the logarithms of the
parameters. What is compared is the mean of the measured ln peaks and the logarithm of their
standard deviation, which are about normal (S. Wood, Nature 466 (2010) 1102).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.specimens import Specimens, seeded
from pbdkit.fitting.strength_laws import Draws
from pbdkit.fitting.strength_specification import StrengthFit
from pbdkit.stepping.state import Floats

SHARES = 0.2, 0.2, 0.6
"""Of specimens: over the bounds, then twice where the measurement is likely."""
POINTS = 2**14
"""At which the likelihood is evaluated."""
LIKELY, WIDER = 8.0, 0.25
"""Logarithms below the largest likelihood that is still looked at, and by how much of itself the
box around these points is made wider."""
TURNS, MOST = 50, 3.0
"""Of the regression of the spread, and the largest step in ln of a variance."""
AMPLE = 1.25
"""The load of the experiment over the largest that was measured, at least."""


@dataclass(frozen=True)
class Peaks:
    """How ln peak is distributed over ln parameters in a box: its mean and the logarithm of its
    variance are quadratic; `skewness` and `kurtosis` are those of what is left."""

    low: Floats
    high: Floats
    mean: Floats
    log_variance: Floats
    inverse: Floats
    skewness: float
    kurtosis: float

    @classmethod
    def of(cls, logs: Floats, y: Floats) -> Peaks:
        """By the likelihood of normal numbers, mean and variance in turn."""
        nothing = np.zeros(0)
        ends = logs.min(axis=0), logs.max(axis=0)
        found = cls(*ends, nothing, nothing, nothing, 0.0, 3.0)
        x = found.terms(logs)
        gamma = np.zeros(x.shape[1])
        mean, *_ = np.linalg.lstsq(x, y, rcond=None)
        gamma[0] = np.log(np.mean((y - x @ mean) ** 2))
        for _ in range(TURNS):
            weight = np.exp(-x @ gamma)
            mean = np.linalg.solve((x.T * weight) @ x, x.T @ (weight * y))
            step, *_ = np.linalg.lstsq(x, (y - x @ mean) ** 2 * weight - 1.0, rcond=None)
            gamma += np.clip(step, -MOST, MOST)
        z = (y - x @ mean) * np.exp(-x @ gamma / 2.0)
        z = (z - z.mean()) / z.std()
        inverse = np.linalg.inv((x.T * np.exp(-x @ gamma)) @ x)
        more = float(np.mean(z**3)), float(np.mean(z**4))
        return replace(
            found,
            mean=mean,
            log_variance=gamma,
            inverse=inverse,
            skewness=more[0],
            kurtosis=more[1],
        )

    def terms(self, logs: Floats) -> Floats:
        """1, what is linear and what is quadratic, (point, term), over the box from -1 to 1."""
        x = 2.0 * (logs - self.low) / (self.high - self.low) - 1.0
        pairs = combinations_with_replacement(range(x.shape[1]), 2)
        return np.column_stack([np.ones(len(x)), x, *(x[:, a] * x[:, b] for a, b in pairs)])

    def likelihood(self, logs: Floats, y: Floats) -> Floats:
        """Its logarithm at points: the mean of the measured ln peaks y and ln of their standard
        deviation have the variances σ²/n and (κ - 1)/4n, and the covariance σ · skewness/2n; what
        few torn specimens leave open of mean and variance is added."""
        n, x = len(y), self.terms(logs)
        variance = np.exp(x @ self.log_variance)
        open_ = np.einsum("pi,ij,pj->p", x, self.inverse, x)
        share = 1.0 / n + open_ / variance
        width = (self.kurtosis - 1.0) / 4.0
        a = y.mean() - x @ self.mean
        b = np.log(y.std(ddof=1)) - x @ self.log_variance / 2.0 + width / (2.0 * n)
        v, w, c = variance * share, width * share, np.sqrt(variance) * self.skewness / 2.0 * share
        determinant = v * w - c**2
        away = (w * a**2 - 2.0 * c * a * b + v * b**2) / determinant
        return np.asarray(-(away + np.log(determinant)) / 2.0)


def simulated(fit: StrengthFit, experiment: Experiment, specimens: Specimens) -> Draws:
    """Strengths that go with the measured peaks, between the bounds, on which the logarithm is
    spread evenly. Raises ExperimentError."""
    if not fit.measured.failed.all():
        raise ExperimentError(
            "tests that ended before the specimen broke cannot be compared with torn specimens; "
            "leave them out",
            ("measured", "broke"),
        )
    if fit.measured.of == "factor":
        text = "torn specimens show forces and displacements, no factor"
        raise ExperimentError(text, ("measured", "of"))
    _refuse_short_load(specimens, float(fit.measured.values.max()))
    y = np.log(fit.measured.values)
    box = whole = np.log(list(fit.unknown.values())).T
    logs, peaks = np.zeros((0, len(fit.unknown))), np.zeros(0)
    for stage, share in enumerate(SHARES):
        more = _spread(box, int(share * fit.simulations), fit.seed + stage)
        found = _torn(fit, experiment, specimens, more, len(logs))
        logs, peaks = np.vstack([logs, more]), np.concatenate([peaks, found])
        inside = ((logs >= box[0]) & (logs <= box[1])).all(axis=1)
        model, points = Peaks.of(logs[inside], peaks[inside]), _spread(box, POINTS, fit.seed)
        logarithm = model.likelihood(points, y)
        near = points[logarithm > logarithm.max() - LIKELY]
        margin = WIDER * np.ptp(near, axis=0)
        box = np.clip([near.min(axis=0) - margin, near.max(axis=0) + margin], *whole)
    weights = np.exp(logarithm - logarithm.max())
    return Draws(np.exp(points), weights / weights.sum())


def _spread(box: Floats, count: int, seed: int) -> Floats:
    """Points all over a box, (point, parameter): Sobol's, scrambled."""
    from scipy.stats import qmc

    whole = qmc.Sobol(box.shape[1], seed=seed).random_base2(int(np.ceil(np.log2(count))))
    return np.asarray(box[0] + whole[:count] * (box[1] - box[0]))


def _torn(
    fit: StrengthFit, experiment: Experiment, specimens: Specimens, logs: Floats, begun: int
) -> Floats:
    """ln peak of one specimen a point."""
    found = []
    for n, point in enumerate(np.exp(logs).tolist()):
        there = experiment
        for path, value in zip(fit.unknown, point, strict=True):
            there = Parameter(path).put(there, value)
        specimen = specimens.torn(seeded(there, (fit.seed << 20) + begun + n))
        found.append(np.log(specimen.peak_of(fit.measured.of)))
    return np.array(found)


def _refuse_short_load(specimens: Specimens, largest: float) -> None:
    """Those that outlast the load count with what they bore by its end: that has to be far above
    what was measured."""
    if (elastic := specimens.elastic) is None:
        return
    of = specimens.peaks.of
    full = elastic.full.force if of == "force" else elastic.full.displacement
    if full < AMPLE * largest:
        raise ExperimentError(
            f"the experiment's load ends at a {of} of {full:.4g} while nothing breaks, and the "
            f"strongest specimen bore {largest:.4g}: let the leaders go "
            f"{AMPLE * largest / full:.3g} times as far, or farther",
            ("leaders",),
        )
