"""Finite-element model updating of the specimen with a hole: Poisson's ratio by least squares, and
Young's modulus by the force on the right end.

Two practices: `usual` prescribes what was measured at both ends; `alike` has what `pbdkit fit`
has: ends of 6 modes that are estimated too, a displacement along x in proportion to x², a loss, a
margin. Each is written plainly (a new assembly for every ν, differences) and well (stiffness by
parts that are assembled once, one factorisation for every ν, exact derivatives).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from finite_elements.specimen import (
    FORCE,
    NOISE,
    THICKNESS,
    Data,
    Plate,
    lame,
    lame_slope,
    read,
)
from scipy.optimize import least_squares
from skfem import condense, solve
from skfem.models.elasticity import linear_elasticity

BOUNDS, START, MODES, MARGIN = (0.0, 0.49), 0.245, 6, 0.5
SCALE = 1.345
"""Residual, in units of the noise, above which it counts less (Huber)."""


class Estimate(NamedTuple):
    value: float
    error: float


class Found(NamedTuple):
    """Poisson's ratio, Young's modulus in MPa, residuals over the noise, and how many states were
    computed; of `alike` also the strength of each term besides."""

    poisson: Estimate
    young: Estimate
    ratio: float
    states: int
    strengths: tuple[Estimate, ...] = ()


class Model:
    """The plate with ends that are displaced by `ends` (unknown, coefficient): displacements and
    their derivatives at the points of the measurement."""

    def __init__(self, n: int, data: Data, inset: float = 0.0) -> None:
        self.plate, self.states = Plate(n, inset), 0
        self.shows = self.plate.shows(data.points)
        self._last: tuple[bytes, Answers] | None = None

    def state(self, nu: float, ends: np.ndarray) -> np.ndarray:
        """Return all displacements for one displacement of the ends, with a newly assembled
        matrix."""
        self.states += 1
        found, _ = self._assembled(nu, ends)
        return found

    def _assembled(self, nu: float, ends: np.ndarray) -> tuple[np.ndarray, Any]:
        first, second = lame(nu)
        stiffness = linear_elasticity(first, second / 2.0).assemble(self.plate.basis)
        return solve(*condense(stiffness, x=ends, D=self.plate.led)), stiffness

    def reaction(self, nu: float, ends: np.ndarray) -> float:
        """Return the force of the right end along x, over Young's modulus and thickness."""
        found, stiffness = self._assembled(nu, ends)
        return float((stiffness @ found)[self.plate.pulled].sum())

    def answers(self, nu: float, ends: np.ndarray, weights: np.ndarray) -> Answers:
        """Solve for all columns of `ends` at once, and for the derivative of their weighted sum
        with respect to ν. The last solutions are kept, as residuals and derivatives are computed
        one after another."""
        key = np.append(weights, nu).tobytes()
        if self._last is None or self._last[0] != key:
            self.states += 1
            self._last = key, self._answers(nu, ends, weights)
        return self._last[1]

    def _answers(self, nu: float, ends: np.ndarray, weights: np.ndarray) -> Answers:
        plate, stiffness = self.plate, self.plate.stiffness(lame(nu))
        factors, slope = plate.factorised(stiffness), plate.stiffness(lame_slope(nu))
        fields = ends.copy()
        fields[plate.free] = factors.solve(-(stiffness @ ends)[plate.free])
        u = fields @ weights
        change = np.zeros_like(u)
        change[plate.free] = -factors.solve((slope @ u)[plate.free])
        carried = (stiffness @ fields)[plate.pulled].sum(axis=0)
        carried_slope = (slope @ u + stiffness @ change)[plate.pulled].sum()
        return Answers(self.shows @ fields, self.shows @ change, carried, carried_slope)


class Answers(NamedTuple):
    """Observed displacements for each coefficient of the ends (number, coefficient), ∂/∂ν of the
    whole (number,), and the same for the force of the right end."""

    seen: np.ndarray
    seen_slope: np.ndarray
    carried: np.ndarray
    carried_slope: float


def usual(n: int, *, plain: bool, inset: float, margin: float = MARGIN) -> Found:
    """Both ends, so far within, as they were measured; plain least squares."""
    every = read()
    data = every.inside(margin, inset)
    model = Model(n, data, inset)
    given, wanted = model.plate.measured(every), data.displacements.T.ravel()

    def differences(z):
        return (model.shows @ model.state(z[0], given) - wanted) / NOISE

    def answers(z):
        return model.answers(z[0], given[:, None], np.ones(1))

    if plain:
        found = least_squares(differences, [START], bounds=BOUNDS)
    else:
        found = least_squares(
            lambda z: (answers(z).seen[:, 0] - wanted) / NOISE,
            [START],
            jac=lambda z: answers(z).seen_slope[:, None] / NOISE,
            bounds=BOUNDS,
        )
    nu, variance = float(found.x[0]), 1.0 / float(found.jac[:, 0] @ found.jac[:, 0])
    ratio = float(np.sqrt(found.fun @ found.fun / (len(found.fun) - 1)))
    error = ratio * np.sqrt(variance)
    if plain:
        step = 1e-4
        ends = [model.reaction(nu + way * step, given) for way in (-1, 0, 1)]
        carried, slope = ends[1], (ends[2] - ends[0]) / (2.0 * step)
    else:
        carried, slope = float(answers(found.x).carried[0]), answers(found.x).carried_slope
    young = FORCE / THICKNESS / carried
    return Found(
        Estimate(nu, float(error)),
        Estimate(young, float(abs(young * slope / carried) * error)),
        ratio,
        model.states,
    )


def alike(n: int, *, plain: bool, terms: Terms | None = None) -> Found:
    """A fit like pbdkit's of the same name: z is ν, the coefficients of the ends, and the
    amplitudes of additional fields, by default x²."""
    every = read()
    data = every.inside(MARGIN)
    model = Model(n, data)
    modes, wanted = model.plate.modes(MODES), data.displacements.T.ravel()
    beside = (terms or bend)(data.points)
    led, ends = model.plate.led, slice(1, 1 + modes.shape[1])
    start = np.linalg.lstsq(modes[led], model.plate.measured(every)[led], rcond=None)[0]
    z = np.concatenate([[START], start, np.zeros(beside.shape[1])])
    low, high = np.full(len(z), -np.inf), np.full(len(z), np.inf)
    low[0], high[0] = BOUNDS
    how = {"loss": "soft_l1", "f_scale": SCALE, "x_scale": "jac", "bounds": (low, high)}
    if plain:

        def differences(z):
            seen = model.shows @ model.state(z[0], modes @ z[ends])
            return (seen + beside @ z[ends.stop :] - wanted) / NOISE

        found = least_squares(differences, z, **how)
        carried, gradient = _reaction(model, modes, found.x)
    else:

        def answers(z):
            return model.answers(z[0], modes, z[ends])

        def residuals(z):
            return (answers(z).seen @ z[ends] + beside @ z[ends.stop :] - wanted) / NOISE

        def jacobian(z):
            return np.column_stack([answers(z).seen_slope, answers(z).seen, beside]) / NOISE

        found = least_squares(residuals, z, jac=jacobian, ftol=1e-7, **how)
        at, gradient = answers(found.x), np.zeros(len(z))
        carried = float(at.carried @ found.x[ends])
        gradient[0], gradient[ends] = at.carried_slope, at.carried
    return _estimates(found, carried, gradient, model.states, ends.stop)


Terms = Callable[[np.ndarray], np.ndarray]


def bend(points: np.ndarray) -> np.ndarray:
    """x² along x, (number, 1), of x from -1 to 1 over the points' box."""
    along = relative_positions(points)
    return np.concatenate([along**2, np.zeros(len(along))])[:, None]


def relative_positions(points: np.ndarray) -> np.ndarray:
    """x from -1 to 1."""
    x = points[:, 0]
    return np.asarray(2.0 * (x - x.min()) / np.ptp(x) - 1.0)


def _estimates(found: Any, carried: float, gradient: np.ndarray, states: int, first: int) -> Found:
    """Errors are those of an M-estimator; scipy's Jacobian counts the loss in, which is undone."""
    counted = (1.0 + np.square(found.fun / SCALE)) ** 0.75
    covariance, ratio = _of_loss(found.jac * counted[:, None], found.fun)
    errors = np.sqrt(np.diag(covariance))
    young = FORCE / THICKNESS / carried
    part = float(np.sqrt(gradient @ covariance @ gradient)) / abs(carried)
    return Found(
        Estimate(float(found.x[0]), float(errors[0])),
        Estimate(young, young * part),
        ratio,
        states,
        tuple(Estimate(float(z), float(e)) for z, e in zip(found.x, errors, strict=True))[first:],
    )


def _of_loss(jacobian: np.ndarray, residuals: np.ndarray) -> tuple[np.ndarray, float]:
    """Covariance of an M-estimator (Huber), and residuals over their noise by their median."""
    ratio = 1.4826 * float(np.median(np.abs(residuals)))
    z = residuals / ratio / SCALE
    psi, slope = z / np.sqrt(1.0 + z * z), (1.0 + z * z) ** -1.5
    factor = np.mean(psi**2) * SCALE**2 / np.mean(slope) ** 2
    return np.linalg.inv(jacobian.T @ jacobian) * factor * max(1.0, ratio) ** 2, ratio


def _reaction(model: Model, modes: np.ndarray, z: np.ndarray) -> tuple[float, np.ndarray]:
    """The force on the right end and its derivatives; it is linear in the coefficients."""
    gradient, step = np.zeros(len(z)), 1e-4
    ends = modes @ z[1:-1]
    above, below = (model.reaction(z[0] + way * step, ends) for way in (1, -1))
    gradient[0] = (above - below) / (2.0 * step)
    gradient[1:-1] = [model.reaction(z[0], column) for column in modes.T]
    return float(gradient[1:-1] @ z[1:-1]), gradient
