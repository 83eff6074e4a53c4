"""Number of modes of measured boundaries, chosen by the data.

More modes follow a boundary more closely, and transfer more of its noise to the parameters. For
each leader group the number is chosen that minimises the corrected information criterion of Akaike,

    n ln(Σ r² / n) + 2 k + 2 k (k + 1) / (n - k - 1),

of n residuals r with k unknowns (Hurvich and Tsai 1989). The noise is that of the residuals, so
that the choice does not depend on the noise that is given. Parameters keep their values, because
the linearised problem has no bounds. The residuals of all numbers of modes
follow from one linearisation with the largest number: the columns of its Jacobian are those of all
modes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.fitting.observations import Boundary, FieldObservation, Observation
from pbdkit.fitting.problem import Loss, Problem, Solution, solved, weighted_system

MAX_CHOICES = 2
"""Maximum number of choices."""
INITIAL_COUNTS = (4, 12)
"""Numbers of modes of all groups from which the criterion is minimised."""
SWEEPS = 10
"""Maximum number of sweeps over all groups."""
RIDGE = 1e-12
"""Term added to the normal equations, relative to their diagonal."""


def solve(problem: Problem, start: Floats, loss: Loss) -> tuple[Problem, Solution]:
    """Solve the problem, and choose the numbers of modes.

    The numbers are chosen at the solution, and the problem is solved again until they are the same.

    Returns
    -------
    problem, solution
        The problem with these numbers, and its solution.

    Raises
    ------
    UnconvergedError
        If the iteration does not converge.
    """
    if loss == "cauchy":
        # The cost has several minima; that of a convex loss is near the lowest one.
        start = solved(problem, start, "soft_l1").z
    solution = solved(problem, start, loss)
    if not any(boundary.is_automatic for boundary in _boundaries(problem)):
        return problem, solution
    for _ in range(MAX_CHOICES):
        changed, start = choose_modes(problem, solution.z, loss)
        if _counts(changed) == _counts(problem):
            break
        problem, solution = changed, solved(changed, start, loss)
    return problem, solution


def least_size(problem: Problem) -> int:
    """Return the number of unknowns with the smallest number of modes."""
    extra = (
        (boundary.count - 1) * len(boundary.leading.axes)
        for boundary in _boundaries(problem)
        if boundary.is_automatic
    )
    return problem.size - sum(extra)


def choose_modes(problem: Problem, z: Floats, loss: Loss) -> tuple[Problem, Floats]:
    """Choose the numbers of modes at some values of the unknowns.

    Returns
    -------
    problem
        The problem with these numbers.
    z : (unknown,)
        The values of its unknowns. Coefficients of additional modes are 0.
    """
    largest = [boundary.largest for boundary in _boundaries(problem)]
    full, z = with_modes(problem, z, largest)
    matrix, values = weighted_system(full.at(z), loss)
    counts = _best_counts(_Candidates.of(full, z, matrix, values))
    return with_modes(full, z, counts)


def with_modes(problem: Problem, z: Floats, counts: list[int]) -> tuple[Problem, Floats]:
    """Return the problem with other numbers of modes, and its unknowns."""
    remaining, observations = iter(counts), list[Observation]()
    parts = [z[: problem.shared]]
    for observation, section in problem.own_slices():
        values = z[section]
        if isinstance(observation, FieldObservation):
            changed = tuple(
                replace(boundary, count=next(remaining)) for boundary in observation.boundaries
            )
            for old, new in zip(observation.boundaries, changed, strict=True):
                parts.append(new.coefficients_of(old, values[: old.size]))
                values = values[old.size :]
            observation = replace(observation, boundaries=changed)
        observations.append(observation)
        parts.append(values)
    return replace(problem, observations=tuple(observations)), np.concatenate(parts)


def _counts(problem: Problem) -> list[int]:
    return [boundary.count for boundary in _boundaries(problem)]


def _boundaries(problem: Problem) -> Iterator[Boundary]:
    for observation in problem.observations:
        if isinstance(observation, FieldObservation):
            yield from observation.boundaries


@dataclass(frozen=True)
class _Candidates:
    """Normal equations of the problem with all modes.

    Parameters
    ----------
    products : (unknown, unknown)
        JᵀJ, with columns of unit length.
    projection : (unknown,)
        Jᵀr, with the residuals r without modes.
    square, rows
        Sum of the squared residuals, and their number.
    always : (unknown,)
        Columns of unknowns that are neither parameters nor coefficients.
    modes
        For each boundary, the columns of each mode, (mode, axis).
    smallest
        Smallest number of modes of each boundary.
    """

    products: Floats
    projection: Floats
    square: float
    rows: int
    always: Indices
    modes: list[Indices]
    smallest: list[int]

    @classmethod
    def of(cls, problem: Problem, z: Floats, matrix: Floats, values: Floats) -> _Candidates:
        size = np.linalg.norm(matrix, axis=0)
        is_used = size > 0.0
        modes, smallest = [], []
        is_mode, is_parameter = np.zeros((2, problem.size), bool)
        is_parameter[: len(problem.unknowns)] = True
        for observation, section in problem.own_slices():
            first = section.start
            if isinstance(observation, FieldObservation):
                for boundary in observation.boundaries:
                    columns = np.arange(first, first := first + boundary.size)
                    modes.append(columns.reshape(-1, boundary.count).T)
                    smallest.append(1 if boundary.is_automatic else boundary.count)
                    is_mode[columns] = True
        values = values + matrix[:, is_mode] @ z[is_mode]  # the residuals without modes
        matrix = matrix / np.where(is_used, size, 1.0)
        products = matrix.T @ matrix
        products[np.diag_indices_from(products)] += RIDGE
        square, rows = float(values @ values), len(values)
        always = np.flatnonzero(is_used & ~is_mode & ~is_parameter)
        return cls(products, matrix.T @ values, square, rows, always, modes, smallest)

    def criterion(self, counts: list[int]) -> float:
        """Return the information criterion of some numbers of modes."""
        used = [columns[:count].ravel() for columns, count in zip(self.modes, counts, strict=True)]
        selected = np.concatenate([self.always, *used])
        n, k = self.rows, len(selected)
        if k >= n - 1:
            return np.inf
        projection = self.projection[selected]
        solution = np.linalg.solve(self.products[np.ix_(selected, selected)], projection)
        square = max(self.square - float(projection @ solution), 1e-300)
        return float(n * np.log(square / n) + 2.0 * k + 2.0 * k * (k + 1) / (n - k - 1))


def _best_counts(candidates: _Candidates) -> list[int]:
    """Minimise the criterion over the number of modes of one group after another.

    The best of the minima from several initial numbers is returned.
    """
    minima = []
    for first in INITIAL_COUNTS:
        pairs = zip(candidates.smallest, candidates.modes, strict=True)
        counts = [min(max(first, smallest), len(columns)) for smallest, columns in pairs]
        minima.append(_descend(candidates, counts))
    return min(minima)[1]


def _descend(candidates: _Candidates, counts: list[int]) -> tuple[float, list[int]]:
    best = candidates.criterion(counts)
    for _ in range(SWEEPS):
        previous = list(counts)
        for n, columns in enumerate(candidates.modes):
            for count in range(candidates.smallest[n], len(columns) + 1):
                trial = [*counts[:n], count, *counts[n + 1 :]]
                if (value := candidates.criterion(trial)) < best:
                    counts, best = trial, value
        if counts == previous:
            break
    return best, counts
