"""What the loads of the first break tell of the strengths of bonds, by law of these.

A specimen bears the load λ where all its bonds do: with probability Π_b (1 - F(ε_b(λ))). So the
likelihood of repeats is known, without any run (weakest link: W. Weibull, J. Appl. Mech. 18 (1951)
293). Location μ and scale σ of ln strength (Weibull: μ = ln s, σ = 1/m) or of strength (uniform)
are given the density dμ dσ/σ and the likelihood is integrated. Where all bonds are strained alike
specimens are of a location-scale family too, and intervals from the integrated likelihood hold
what they say exactly, however few specimens there are (J. Berger, Statistical Decision Theory,
1985, section 6.6).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.fitting.first_break import BondStrains
from pbdkit.scene.places import Mask
from pbdkit.stepping.state import Floats

COARSE, FINE = 40, 64
"""Nodes along a parameter: to find where the likelihood is, and to integrate it."""
NEGLIGIBLE = 18.0
"""Below the largest logarithm: less than 2e-8 of it."""
DRAWS = 20_000
DEPTH = 1e-8
"""The share of the weakest specimen's strain that counts as none."""
Bounds = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Breaks:
    """Load factors of specimens, (specimen,), and whether each broke there or bore more."""

    load: Floats
    broke: Mask


@dataclass(frozen=True)
class Draws:
    """Parameters that go with the measurement, (draw, parameter), and how much each counts."""

    values: Floats
    weights: Floats


class StrengthLaw(ABC):
    """A distribution of strengths with two parameters, by their paths in an experiment."""

    paths: ClassVar[tuple[str, str]]

    @staticmethod
    @abstractmethod
    def whole(path: str) -> float:
        """The number at a path with which no bond breaks."""

    @abstractmethod
    def draws(self, strains: BondStrains, breaks: Breaks, bounds: Bounds) -> Draws:
        """From the integrated likelihood between bounds."""

    @staticmethod
    @abstractmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """The coefficient of variation of strengths."""


class WeibullLaw(StrengthLaw):
    """F(ε) = 1 - exp(-(ε/s)^m)."""

    paths = ("fracture.scale", "fracture.modulus")

    @staticmethod
    def whole(path: str) -> float:
        """A scale out of reach, and hardly any scatter."""
        return 1e60 if path == "fracture.scale" else 1000.0

    @staticmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """√(Γ(1 + 2/m)/Γ(1 + 1/m)² - 1)."""
        from scipy.special import gammaln

        return np.asarray(np.sqrt(np.expm1(gammaln(1 + 2 / second) - 2 * gammaln(1 + 1 / second))))

    def draws(self, strains: BondStrains, breaks: Breaks, bounds: Bounds) -> Draws:
        """For a modulus, Σ_specimens Σ_b ε^m / s^m is gamma-distributed with the number of
        failures; moduli are drawn from what is left when that is integrated."""
        from scipy.special import gammainc, gammaincinv

        count = int(breaks.broke.sum())

        def logarithm(log_m: Floats) -> tuple[Floats, Floats]:
            """Of the density of ln m, and of the sum."""
            m = np.exp(log_m)
            sums, slopes = weibull_sums(strains, breaks, m)
            total = np.logaddexp.reduce(sums, axis=1)
            density = slopes[:, breaks.broke].sum(axis=1) - log_m - count * total
            inside = [gammainc(count, np.exp(np.minimum(total - m * np.log(end), 700.0)))
                      for end in bounds[0]]  # fmt: skip
            with np.errstate(divide="ignore"):
                return density + np.log(np.maximum(inside[0] - inside[1], 0.0)), total

        nodes = _nodes(bounds[1])
        (nodes,) = _where(logarithm(nodes)[0], nodes)
        density, total = logarithm(nodes)
        order = (np.arange(DRAWS) + 0.5) / DRAWS
        share = np.exp(density - density.max())
        within = np.concatenate([[0.0], np.cumsum((share[1:] + share[:-1]) / 2)])
        log_m = np.interp(order, within / within[-1], nodes)
        m, log_total = np.exp(log_m), np.interp(log_m, nodes, total)
        low, high = (gammainc(count, np.exp(np.minimum(log_total - m * np.log(end), 700.0)))
                     for end in reversed(bounds[0]))  # fmt: skip
        # A low-discrepancy sequence beside `order`: the same draws whenever the fit is made.
        other = (np.arange(DRAWS) * 0.6180339887498949 + 0.5) % 1.0
        log_s = (log_total - np.log(gammaincinv(count, low + other * (high - low)))) / m
        return Draws(np.stack([np.exp(log_s), m], axis=1), np.full(DRAWS, 1.0 / DRAWS))


def weibull_sums(strains: BondStrains, breaks: Breaks, m: Floats) -> tuple[Floats, Floats]:
    """For each modulus and load ln Σ_b ε^m, and the logarithm of its rate by the load, (modulus,
    specimen)."""
    with np.errstate(divide="ignore"):
        strain = np.log(strains.at(breaks.load))
        rate = np.where(strain > -np.inf, strains.rate(breaks.load), 1.0)
    top = strain.max(axis=1, keepdims=True)
    sums, slopes = np.empty((2, len(m), len(strain)))
    for n, each in enumerate(m):
        share = np.exp(each * (strain - top)) * strains.count
        sums[n] = np.log(share.sum(axis=1)) + each * top[:, 0]
        grows = (share * rate * np.exp(-np.maximum(strain - top, -700.0))).sum(axis=1)
        slopes[n] = np.log(each * grows) + (each - 1.0) * top[:, 0]
    return sums, slopes


class UniformLaw(StrengthLaw):
    """Uniform within f (1 ± s): from a = f (1 - s), w = 2 f s wide."""

    paths = ("fracture.failure", "fracture.scatter")

    @staticmethod
    def whole(path: str) -> float:
        """A strain out of reach, the same for all."""
        return 1e60 if path == "fracture.failure" else 0.0

    @staticmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """s/√3."""
        return np.asarray(second / np.sqrt(3.0))

    def draws(self, strains: BondStrains, breaks: Breaks, bounds: Bounds) -> Draws:
        """On a grid of ln w and of how far a lies below what the weakest specimen bore."""
        strain, rate = strains.at(breaks.load), strains.rate(breaks.load)
        lowest = float(strain[breaks.broke].max(axis=1).min())

        def logarithm(depth: Floats, log_w: Floats) -> Floats:
            a, w = lowest - np.exp(depth)[:, None], np.exp(log_w)[None, :]
            matters = strain.max(axis=0) > a.min()
            parts = strain[:, matters], rate[:, matters], strains.count[matters], breaks.broke
            found = np.array([[_uniform(*parts, x, y) for y in w[0]] for x in a[:, 0]])
            f, s = a + w / 2, w / np.maximum(2 * a + w, 1e-300)
            inside = (a > 0.0) & (f >= bounds[0][0]) & (f <= bounds[0][1])
            inside &= (s >= bounds[1][0]) & (s <= bounds[1][1])
            return np.where(inside, found + depth[:, None], -np.inf)

        depth = np.log(lowest) + np.linspace(np.log(DEPTH), -1e-9, COARSE)
        widths = 2 * bounds[0][0] * bounds[1][0], 2 * bounds[0][1] * bounds[1][1]
        log_w = _nodes(widths)
        depth, log_w = _where(logarithm(depth, log_w), depth, log_w)
        found = logarithm(depth, log_w)
        a, w = np.meshgrid(lowest - np.exp(depth), np.exp(log_w), indexing="ij")
        weights = np.exp(found - found.max()).ravel()
        values = np.stack([a + w / 2, w / (2 * a + w)], axis=-1).reshape(-1, 2)
        return Draws(values[weights > 0.0], weights[weights > 0.0] / weights.sum())


def _uniform(strain: Floats, rate: Floats, count: Floats, broke: Mask, a: float, w: float) -> float:
    """The logarithm of the likelihood, -inf where a specimen bore what no bond does."""
    z = (strain - a) / w
    if z.max() >= 1.0 or z[broke].max(axis=1).min() <= 0.0:
        return -np.inf
    left = 1.0 - np.maximum(z, 0.0)
    rates = np.where(z > 0.0, count * rate / left, 0.0)[broke].sum(axis=1) / w
    return float(np.log(rates).sum() + (np.log(left) @ count).sum())


def _nodes(ends: tuple[float, float]) -> Floats:
    """The logarithms from end to end."""
    return np.linspace(np.log(ends[0]), np.log(ends[1]), COARSE)


def _where(found: Floats, *nodes: Floats) -> tuple[Floats, ...]:
    """Finer nodes along each axis over where the logarithms are not negligible."""
    if not np.isfinite(found).any():
        raise ExperimentError(
            "no strengths between the bounds go with these peaks: take wider ones, and look "
            "whether the peaks are in the experiment's units",
            ("unknown",),
        )
    kept = found > found.max() - NEGLIGIBLE
    finer = []
    for axis, each in enumerate(nodes):
        some = np.flatnonzero(kept.any(axis=tuple({*range(kept.ndim)} - {axis})))
        low, high = max(some[0] - 1, 0), min(some[-1] + 1, len(each) - 1)
        finer.append(np.linspace(each[low], each[high], FINE))
    return tuple(finer)


LAWS: dict[str, StrengthLaw] = {"weibull": WeibullLaw(), "uniform": UniformLaw()}
OF_FRACTURE = {"weibull": "weibull", "strain": "uniform"}
"""The law of the strengths of a fracture model, by its type."""
