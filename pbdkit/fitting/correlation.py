"""Correlation of residuals with distance, and its effect on standard errors.

Residuals of image correlation are correlated because subsets overlap and images are interpolated;
errors of a model are correlated too. With the correlation matrix R of the residuals and their
Jacobian J, the covariance of least squares is (JᵀJ)⁻¹ JᵀRJ (JᵀJ)⁻¹, and not (JᵀJ)⁻¹.

R is used only if the correlation is significant. Moran's statistic of regression residuals is the
mean product of residuals at neighbouring places divided by their mean square. Its expectation and
variance for independent noise are known exactly (Cliff and Ord 1981, Spatial Processes, 8.3).

The correlation is modelled by g exp(-(d/L)^p) at distance d > 0, where p is 1 or 2. The remaining
part 1 - g of the variance is independent. The parameters maximise the restricted likelihood, which
does not depend on the estimates of the fit (Patterson and Thompson 1971, Biometrika 58, 545; for
correlated data in space Cressie 1993, Statistics for Spatial Data, 2.6). Residuals themselves are
less correlated than the noise, because the fit follows a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pbdkit.array_types import Floats, Indices

if TYPE_CHECKING:
    import scipy.sparse

SIGNIFICANT = 2.326
"""Standard deviations by which Moran's statistic of independent residuals exceeds its expectation
in 1 % of cases."""
MIN_ROWS = 10
"""Smallest number of rows for which the correlation is tested."""
MAX_ROWS = 400
"""Largest number of rows from which the correlation is estimated."""
CLUSTER = 4
"""Number of adjacent rows that are selected together from a larger number of rows."""
MAX_SHARE = 0.999
"""Largest correlated fraction of the variance."""
POWERS = (1.0, 2.0)
"""Exponents p of the correlation."""
SHARES = (0.3, 0.7, 0.95)
"""Initial values of the correlated fraction."""
STARTS = 6
"""Number of initial values of the length."""
REGULAR = 1e-8
"""Relative tolerance of singular values of a part of a basis."""
FAR = 6.0
"""Value of (d / length)^power above which the correlation is negligible."""
MAX_PAIRS = 1_000_000
"""Largest number of pairs of correlated rows that are stored."""
CELLS_PER_LENGTH = 6.0
"""Number of cells of a raster in a correlation length."""
MAX_CELLS = 1500
"""Largest number of cells of a raster along a side."""


@dataclass(frozen=True)
class Correlation:
    """Correlation of residuals at a distance d > 0: share · exp(-(d / length)^power).

    Parameters
    ----------
    share : float
        Correlated fraction of the variance.
    length : float
        Correlation length, in the unit of the places.
    power : float
        Exponent.
    """

    share: float
    length: float
    power: float

    def smooth_part(self, distances: Floats) -> Floats:
        """Return the correlation divided by `share`."""
        return np.asarray(np.exp(-((distances / self.length) ** self.power)))

    def matrix(self, distances: Floats) -> Floats:
        """Return the correlation matrix of rows with given distances, (row, row)."""
        result = self.share * self.smooth_part(distances)
        np.fill_diagonal(result, 1.0)
        return result

    def product(self, columns: Floats, places: Floats) -> Floats:
        """Return Σ XᵀRX over components, (column, column).

        Parameters
        ----------
        columns : (component, row, column)
            Matrix X of each component. Different components are not correlated.
        places : (row, coordinate)
            Places of the rows.
        """
        combined = np.concatenate([*columns], axis=1)
        smooth = self._smoothed(combined, places).reshape(len(places), len(columns), -1)
        correlated = np.einsum("cni,ncj->ij", columns, smooth)
        independent = np.einsum("cni,cnj->ij", columns, columns)
        result = self.share * correlated + (1.0 - self.share) * independent
        return np.asarray(0.5 * (result + result.T))

    def effective_count(self, places: Floats) -> float:
        """Return the number of independent residuals with the same variance of the mean."""
        ones = np.ones((1, len(places), 1))
        return float(len(places) ** 2 / self.product(ones, places)[0, 0])

    def _smoothed(self, columns: Floats, places: Floats) -> Floats:
        """Multiply columns by the matrix of `smooth_part`, (row, column)."""
        from scipy.sparse import csr_array
        from scipy.spatial import KDTree

        tree, reach = KDTree(places), self.length * FAR ** (1.0 / self.power)
        if tree.count_neighbors(tree, reach) > MAX_PAIRS:
            return self._smoothed_on_raster(columns, places)
        pairs = tree.sparse_distance_matrix(tree, reach, output_type="ndarray")
        entries = (self.smooth_part(pairs["v"]), (pairs["i"], pairs["j"]))
        return np.asarray(csr_array(entries, shape=(len(places),) * 2) @ columns)

    def _smoothed_on_raster(self, columns: Floats, places: Floats) -> Floats:
        """Compute the same product, in which the rows in a cell of a raster have the same place."""
        from scipy.signal import fftconvolve

        low, extent = places.min(axis=0), float(np.ptp(places, axis=0).max())
        side = max(self.length / CELLS_PER_LENGTH, extent / MAX_CELLS)
        index = np.round((places - low) / side).astype(np.intp)
        shape = tuple(index.max(axis=0) + 1)
        offsets = np.meshgrid(*(np.arange(1 - n, n) for n in shape), indexing="ij")
        kernel = self.smooth_part(side * np.sqrt(np.sum(np.square(offsets), axis=0)))
        cell, result = np.ravel_multi_index(tuple(index.T), shape), np.empty_like(columns)
        for n, column in enumerate(columns.T):
            raster = np.bincount(cell, column, int(np.prod(shape))).reshape(shape)
            result[:, n] = fftconvolve(raster, kernel, mode="same").ravel()[cell]
        return result


def is_correlated(residuals: Floats, basis: Floats, places: Floats) -> bool:
    """Return whether residuals at neighbouring places are significantly correlated.

    Parameters
    ----------
    residuals : (component, row)
        Residuals.
    basis : (component, row, unknown)
        Rows of an orthonormal basis of the columns of the Jacobian.
    places : (row, coordinate)
        Places of the rows.
    """
    components, rows = residuals.shape
    if rows < MIN_ROWS or not residuals.any():
        return False
    weights = _neighbour_weights(places)
    smoothed = np.stack([weights @ part for part in basis])
    projected = np.einsum("cni,cnj->ij", basis, smoothed)
    # Traces of M W and (M W)² for the projection M = I - Q Qᵀ, with weights W and basis Q.
    trace = -float(np.trace(projected))
    square = (
        components * float(weights.power(2).sum())
        - 2.0 * float(np.square(smoothed).sum())
        + float(np.square(projected).sum())
    )
    freedom = components * rows - float(np.square(basis).sum())
    if freedom <= 1.0:
        return False
    products = float(sum(part @ (weights @ part) for part in residuals))
    statistic = products / float(np.square(residuals).sum())
    variance = 2.0 * (freedom * square - trace**2) / (freedom**2 * (freedom + 2.0))
    return bool(statistic - trace / freedom > SIGNIFICANT * np.sqrt(max(variance, 0.0)))


def _neighbour_weights(places: Floats) -> scipy.sparse.csr_array:
    """Return the symmetric matrix that is 1 for neighbouring rows, and otherwise 0."""
    from scipy.sparse import csr_array

    count = len(places)
    nearest = _nearest(places, 3 ** places.shape[1])  # As many as on a square grid.
    rows = np.repeat(np.arange(count), nearest.shape[1])
    is_pair = rows != nearest.ravel()
    pairs = np.stack([rows[is_pair], nearest.ravel()[is_pair]])
    pairs = np.unique(np.concatenate([pairs, pairs[::-1]], axis=1), axis=1)
    return csr_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(count, count))


def _nearest(places: Floats, count: int) -> Indices:
    """Return the rows nearest to each row, itself included, (row, count)."""
    from scipy.spatial import KDTree

    _, nearest = KDTree(places).query(places, min(count, len(places)))
    return np.asarray(nearest)


def estimate_correlation(residuals: Floats, basis: Floats, places: Floats) -> Correlation:
    """Estimate the correlation of residuals by restricted maximum likelihood.

    The parameters are those of `is_correlated`.
    """
    from scipy.optimize import minimize
    from scipy.spatial.distance import cdist

    rows = _selected_rows(places)
    components = len(residuals)
    left, sizes, _ = np.linalg.svd(basis[:, rows].reshape(components * len(rows), -1), False)
    regular = left[:, sizes > REGULAR * sizes.max(initial=0.0)]
    columns = np.concatenate(
        [
            np.column_stack([residuals[n, rows], part])
            for n, part in enumerate(regular.reshape(components, len(rows), -1))
        ],
        axis=1,
    )
    distances = cdist(places[rows], places[rows])
    low = 0.5 * float(np.median(np.sort(distances, axis=1)[:, 1]))
    high = float(np.ptp(places, axis=0).max())
    low = min(max(low, 1e-6 * high), 0.5 * high)

    def decode(x: Floats, power: float) -> Correlation:
        length = float(np.exp(np.clip(x[0], np.log(low), np.log(high))))
        return Correlation(min(1.0 / (1.0 + float(np.exp(-x[1]))), MAX_SHARE), length, power)

    def criterion(x: Floats, power: float) -> float:
        return _restricted(decode(x, power), distances, columns, components)

    starts = [
        np.array([np.log(length), np.log(share / (1.0 - share))])
        for length in np.geomspace(low, 0.5 * high, STARTS)
        for share in SHARES
    ]
    start = min(starts, key=lambda x: criterion(x, POWERS[0]))
    options = {"xatol": 0.02, "fatol": 0.01, "maxiter": 60}
    fits = [
        (minimize(criterion, start, (power,), "Nelder-Mead", options=options), power)
        for power in POWERS
    ]
    best, power = min(fits, key=lambda pair: float(pair[0].fun))
    return decode(best.x, power)


def _selected_rows(places: Floats) -> Indices:
    """Return rows from which the correlation is estimated: all, or clusters of adjacent rows."""
    if len(places) <= MAX_ROWS:
        return np.arange(len(places))
    centres = np.random.default_rng(0).choice(len(places), MAX_ROWS // CLUSTER, replace=False)
    return np.unique(_nearest(places, CLUSTER)[centres])


def _restricted(
    correlation: Correlation, distances: Floats, columns: Floats, components: int
) -> float:
    """Return -2 times the restricted log-likelihood, apart from a constant.

    Parameters
    ----------
    columns : (row, component · (1 + unknown))
        Residuals and basis of each component.
    """
    from scipy.linalg import cholesky, solve_triangular

    factor = cholesky(correlation.matrix(distances), lower=True)
    white = solve_triangular(factor, columns, lower=True)
    stacked = np.concatenate(np.split(white, components, axis=1))
    residuals, basis = stacked[:, 0], stacked[:, 1:]
    orthonormal, triangle = np.linalg.qr(basis)
    remainder = residuals - orthonormal @ (orthonormal.T @ residuals)
    freedom = max(1, stacked.shape[0] - basis.shape[1])
    return float(
        2.0 * components * np.log(np.diag(factor)).sum()
        + 2.0 * np.log(np.abs(np.diag(triangle))).sum()
        + freedom * np.log(float(remainder @ remainder) / freedom)
    )
