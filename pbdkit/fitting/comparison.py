"""Which model? The same data against several, by how well each foretells points that were left out.

Blocks of neighbouring points are left out together (Roberts et al. 2017, Ecography 40, 913): what
lies beside a left-out point would tell it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from pbdkit.fitting.least_squares import Loss, Solution, cost_of, solved
from pbdkit.fitting.problem import Problem
from pbdkit.stepping.state import Floats

BLOCKS = 32
"""So many along the longest way: of larger ones at an end, nothing else tells how it moves."""


@dataclass(frozen=True)
class Candidate:
    """A model by name: the mean square of left-out residuals over their noise and its standard
    error over blocks; by how much that is `behind` the best one's, block by block, and the error of
    this; the root mean square by which its predictions differ from the best one's, over the noise;
    and the parameters that fit, by path.

    1 is the noise alone. Who is behind by less than two errors is as good.
    """

    name: str
    left_out: float
    error: float
    behind: float
    behind_error: float
    differs: float
    values: dict[str, float]

    def __str__(self) -> str:
        return (
            f"{self.name}: left-out residuals² are {self.left_out:.3f} of the noise's, behind by "
            f"{self.behind:.3f} ± {self.behind_error:.3f}; {self.differs:.2g} of the noise away"
        )


@dataclass(frozen=True)
class Posed:
    """A candidate's problem and its solution."""

    name: str
    problem: Problem
    solution: Solution


def compared(posed: Sequence[Posed], folds: int, loss: Loss, seed: int) -> tuple[Candidate, ...]:
    """All against the same blocks of the points that each of them has, the best first. Raises
    UnconvergedError."""
    posed = _of_common_rows(posed, loss)
    blocks = [_blocks(o.places(), seed) for o in posed[0].problem.observations]
    scores = [_left_out(each, blocks, folds, loss) for each in posed]
    best = int(np.argmin([score.mean() for score in scores]))
    right = posed[best].solution.at.residuals
    weight = _mean_weight(posed[best].problem)
    found = [
        Candidate(
            each.name,
            *_mean(score),
            *_mean(score - scores[best]),
            float(np.sqrt(np.mean((each.solution.at.residuals - right) ** 2) / weight)),
            _values(each),
        )
        for each, score in zip(posed, scores, strict=True)
    ]
    return tuple(sorted(found, key=lambda candidate: candidate.left_out))


def _mean_weight(problem: Problem) -> float:
    """The mean weight of the numbers that were measured."""
    weights, counts = zip(*((o.weight, len(o.measured)) for o in problem.observations), strict=True)
    return float(np.average(weights, weights=counts))


def _mean(score: Floats) -> tuple[float, float]:
    """With its standard error."""
    return float(score.mean()), float(score.std(ddof=1) / np.sqrt(len(score)))


def _of_common_rows(posed: Sequence[Posed], loss: Loss) -> list[Posed]:
    """Each fitted to what all of them can predict."""
    groups = zip(*(each.problem.observations for each in posed), strict=True)
    common = [reduce(np.intersect1d, (o.rows for o in group)) for group in groups]
    found = []
    for each in posed:
        pairs = zip(each.problem.observations, common, strict=True)
        parts = tuple(o.part(np.isin(o.rows, rows)) for o, rows in pairs)
        problem = replace(each.problem, observations=parts)
        found.append(Posed(each.name, problem, solved(problem, each.solution.z, loss)))
    return found


def _values(posed: Posed) -> dict[str, float]:
    names = [u.parameter.path for u in posed.problem.unknowns]
    return dict(zip(names, map(float, posed.solution.z), strict=False))


def _left_out(posed: Posed, blocks: Sequence[NDArray[np.intp]], folds: int, loss: Loss) -> Floats:
    """The mean square residual of each block by what was fitted to the other folds, (block,)."""
    found = []
    observations = posed.problem.observations
    for fold in range(folds):
        chosen = [numbers % folds == fold for numbers in blocks]
        kept = tuple(o.part(~c) for o, c in zip(observations, chosen, strict=True))
        z = solved(replace(posed.problem, observations=kept), posed.solution.z, loss).z
        for n, (observation, c) in enumerate(zip(observations, chosen, strict=True)):
            if c.any():
                left = posed.problem.residuals_of(n, observation.part(c), z)
                own = blocks[n][c]
                parts = (left.reshape(-1, len(own))[:, own == block] for block in np.unique(own))
                found += [cost_of(part.ravel(), loss) / part.size for part in parts]
    return np.array(found) / _mean_weight(posed.problem)


def _blocks(places: Floats, seed: int) -> NDArray[np.intp]:
    """To which block each row belongs, numbered in an order drawn at random."""
    low = places.min(axis=0)
    side = max(float(np.ptp(places, axis=0).max()) / BLOCKS, 1e-300)
    cells = np.floor((places - low) / side * (1.0 - 1e-12)).astype(np.intp)
    _, numbers = np.unique(cells, axis=0, return_inverse=True)
    order = np.random.default_rng(seed).permutation(int(numbers.max()) + 1)
    return np.asarray(order[numbers.ravel()])
