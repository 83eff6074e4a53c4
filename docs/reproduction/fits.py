"""Fits of a parabola and of an exponential with three free parameters each."""

import numpy as np
from runs import Floats
from scipy.optimize import minimize_scalar


def fit_quality(y: Floats, degree: int) -> float:
    """Return R² of a polynomial fitted to a series."""
    x = np.arange(len(y))
    return _r_squared(y, np.polyval(np.polyfit(x, y, degree), x))


def exponential_quality(y: Floats) -> float:
    """Return R² of c + A exp(-r t) fitted to a series, with three free parameters as a parabola."""
    t = np.arange(len(y))

    def fitted(log_rate: float) -> Floats:
        basis = np.stack([np.exp(-np.exp(log_rate) * t), np.ones(len(t))], axis=1)
        return np.asarray(basis @ np.linalg.lstsq(basis, y)[0])

    def loss(log_rate: float) -> float:
        return -_r_squared(y, fitted(log_rate))

    return -float(minimize_scalar(loss, bounds=(np.log(1e-5), np.log(0.5)), method="bounded").fun)


def both(y: Floats, first: int, last: int) -> tuple[float, float]:
    """Return R² of a parabola and of an exponential over the steps first to last."""
    part = y[first : last + 1]
    return fit_quality(part, 2), exponential_quality(part)


def parabolic(pair: tuple[float, float]) -> bool:
    """Return whether the parabola fits well, and not worse than the exponential."""
    return pair[0] > 0.99 and pair[0] >= pair[1]


def both_text(y: Floats, top: int, middle: int = 150, last: int = 400) -> str:
    """Return a text with both R² over the whole decrease and its two parts."""
    parts = ((top, last), (top, middle), (middle, last))
    values = [both(y, low, high) for low, high in parts]
    (parabola, exponential), *others = values
    (low, high), *rest = parts
    return (
        "A parabola and an exponential, each with three parameters, were fitted to the decrease. "
        f"Their values of R² are {parabola:.5f} (parabola) and {exponential:.5f} (exponential) "
        f"over steps {low} to {high}; "
    ) + "; ".join(
        f"{p:.5f} and {e:.5f} over steps {low} to {high}"
        for (low, high), (p, e) in zip(rest, others, strict=True)
    )


def _r_squared(y: Floats, fitted: Floats) -> float:
    return float(1 - ((y - fitted) ** 2).sum() / ((y - y.mean()) ** 2).sum())
