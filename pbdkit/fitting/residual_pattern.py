"""Remedies for a fit that does not converge, chosen by the pattern of its residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from pbdkit.array_types import Floats
from pbdkit.fitting.observations import FieldObservation, Observation

OUTLIER = 6.0
"""Smallest residual of an outlier, in standard deviations by the median of the magnitudes."""
OUTLIERS_SHARE = 0.5
"""Share of outliers in the sum of squares from which they are the reason."""
LARGE = 2.0
"""Residual in units of the noise from which the noise is too small, or the model incomplete."""
DEGREE = 3
"""Degree of the polynomials to which residuals are compared."""
SMOOTH = 0.5
"""Share of the sum of squares that a smooth field explains."""
TERM_SHARE = 0.2
"""Share of the explained sum of squares from which a term is named."""
BESIDE = 1.0
"""Largest distance from a boundary of points beside it, relative to the size of a cell."""
CONCENTRATED = 4.0
"""Ratio of medians of the squares from which residuals are concentrated in a place.

Scattered outliers do not change medians.
"""
BLOCKS = 5
"""Number of blocks along each axis."""
MIN_ROWS = 6
"""Smallest number of residuals in a block that is compared."""


def remedy_of(observations: Sequence[Observation], residuals: Sequence[Floats], loss: str) -> str:
    """Describe the residuals of the worst measurement, and name a remedy.

    Parameters
    ----------
    observations
        The measurements.
    residuals
        Residuals of each, divided by the noise.
    loss
        Loss of the fit.
    """
    squares = [float(np.mean(np.square(values))) for values in residuals]
    n = int(np.argmax(squares))
    observation, values = observations[n], residuals[n]
    name = f"measurement {n}: " if len(observations) > 1 else ""
    return name + (_small(values) or remedy_of_excess(observation, values, loss))


def remedy_of_excess(observation: Observation, values: Floats, loss: str) -> str:
    """Describe the residuals of a measurement that exceed its noise, and name a remedy.

    Parameters
    ----------
    observation
        The measurement.
    values
        Its residuals, divided by the noise.
    loss
        Loss of the fit.
    """
    places = np.tile(observation.places(), (len(values) // len(observation.rows), 1))
    text = ""
    if isinstance(observation, FieldObservation):
        text = _distortion(observation, values) or _boundary(observation, values)
    text = text or _block(values, places) or _outliers(values, places, loss)
    return text or _noise(observation, values)


def _at(place: Floats) -> str:
    return f"({', '.join(f'{coordinate:.3g}' for coordinate in place)})"


def _outliers(values: Floats, places: Floats, loss: str) -> str:
    size = OUTLIER * 1.4826 * np.median(np.abs(values))
    is_outlier = np.abs(values) > size
    share = np.square(values[is_outlier]).sum() / max(np.square(values).sum(), 1e-300)
    if loss != "linear" or share < OUTLIERS_SHARE:
        return ""
    worst = places[np.abs(values).argmax()]
    return (
        f"{is_outlier.sum()} of {len(values)} residuals are outliers, the largest at {_at(worst)}; "
        "set `loss: soft_l1`, or remove these rows"
    )


def _small(values: Floats) -> str:
    if np.sqrt(np.mean(np.square(values))) > LARGE:
        return ""
    return (
        "the residuals are as large as the noise, so that the data do not distinguish between the "
        "values of the unknowns; fit fewer parameters or `modes`, or narrow the bounds"
    )


def _distortion(observation: FieldObservation, values: Floats) -> str:
    """Compare the residuals with polynomials that are not among the distortions."""
    points, (low, high) = observation.evidence.points, observation.evidence.box
    x, y = (2.0 * (points - low) / np.maximum(high - low, 1e-300) - 1.0).T
    powers = [(p, n - p) for n in range(DEGREE + 1) for p in range(n, -1, -1)]
    if len(points) < 3 * len(powers):
        return ""
    columns = np.stack([x**p * y**q for p, q in powers], axis=1)
    named: list[str] = []
    explained = 0.0
    axes = observation.evidence.axes
    for axis, column in zip(axes, values.reshape(len(axes), -1), strict=True):
        amplitudes, *_ = np.linalg.lstsq(columns, column, rcond=None)
        explained += np.square(columns @ amplitudes).sum()
        sizes = np.square(columns * amplitudes).sum(axis=0)
        known = observation.evidence.terms[axis]
        terms = [
            list(powers[n])
            for n in np.argsort(-sizes)[:2]
            if sizes[n] > TERM_SHARE * np.square(values).sum() and powers[n] not in known
        ]
        named += [f"u{'xy'[axis]}: {terms}"] if terms else []
    share = explained / np.square(values).sum()
    if share < SMOOTH or not named:
        return ""
    return (
        f"{share:.0%} of the squared residuals are a smooth field, as of a camera or of bending "
        f"out of the plane; add the terms `distortion: {{{', '.join(named)}}}`"
    )


def _boundary(observation: FieldObservation, values: Floats) -> str:
    """Compare the residuals beside each measured boundary with all others."""
    squares = np.square(values.reshape(len(observation.evidence.axes), -1)).mean(axis=0)
    reach = BESIDE * np.abs(np.array(observation.scene.raster.cell.vectors)).max()
    for boundary in observation.boundaries:
        distances, _ = KDTree(boundary.leading.reference).query(observation.evidence.points)
        is_near = distances <= reach
        if not is_near.any() or is_near.all():
            continue
        if np.median(squares[is_near]) > CONCENTRATED * np.median(squares[~is_near]):
            middle = boundary.leading.reference.mean(axis=0)
            return (
                f"residuals are concentrated beside leader group {boundary.group} at "
                f"{_at(middle)}, which its {boundary.count} modes do not follow; use more `modes`, "
                "divide the group, or select particles farther inside"
            )
    return ""


def _block(values: Floats, places: Floats) -> str:
    """Compare the residuals of blocks of places."""
    low, size = places.min(axis=0), np.maximum(np.ptp(places, axis=0), 1e-300)
    cells = np.minimum((BLOCKS * (places - low) / size).astype(int), BLOCKS - 1)
    _, block = np.unique(cells, axis=0, return_inverse=True)
    block, squares = block.ravel(), np.square(values)
    sizes = [squares[block == n] for n in range(int(block.max()) + 1)]
    medians = np.array([np.median(own) if len(own) >= MIN_ROWS else 0.0 for own in sizes])
    worst = int(medians.argmax())
    if medians[worst] < CONCENTRATED * np.median(squares):
        return ""
    centre = places[block == worst].mean(axis=0)
    return (
        f"residuals are concentrated about {_at(centre)}; model what is there (a crack, a hole, "
        "another material), or remove these rows"
    )


def _noise(observation: Observation, values: Floats) -> str:
    ratio = np.sqrt(np.mean(np.square(values)))
    noise = ratio * observation.noise * observation.unit / np.sqrt(observation.weight)
    return (
        f"residuals are {ratio:.2g} times the noise everywhere; the model does not describe the "
        f"measurement, or the noise is larger: use another model, or `noise: {noise:.2g}`"
    )
