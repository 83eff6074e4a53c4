"""Eigenvalues of the step operator. They are computed separately for each block of coupled
unknowns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.linear.block_matrix import DENSE, connected
from pbdkit.scene.scene import Scene

MAX_PARTICLES = 50_000
"""Largest number of particles for which the step operator is assembled."""

MAX_BOND_ENDS = 800_000
"""Largest number of bond ends, two for each bond."""

MAX_EVALUATIONS = 2e8
"""Largest number of evaluations of the rule. If particles have more than `LARGE_NEIGHBOURHOOD`
neighbours, the number of evaluations is proportional to the square of the number of neighbours."""

LARGE_NEIGHBOURHOOD = 42
"""Number of neighbours above which every particle is evaluated separately."""


def excess(scene: Scene) -> str:
    """Return the reason why a scene is too large for a step operator, or an empty string."""
    particles, neighbourhood = scene.raster.count, scene.neighbourhood
    if particles > MAX_PARTICLES:
        return f"{particles} particles exceed the maximum of {MAX_PARTICLES}"
    degree = 2 * len(neighbourhood.planes) // len(neighbourhood.slots)
    limit = min(
        MAX_BOND_ENDS // degree,
        int(MAX_EVALUATIONS / degree**2) if degree > LARGE_NEIGHBOURHOOD else particles,
    )
    if particles > limit:
        return f"{particles} particles with {degree} neighbours each exceed the maximum of {limit}"
    return ""


Complex = NDArray[np.complexfloating[Any, Any]]
NEUTRAL = 1e-9
"""Tolerance within which the modulus of an eigenvalue counts as 1."""
STRAIGHT = 1e-6
"""Imaginary parts below this are rounding errors. A mode with such an eigenvalue does not
oscillate."""


@dataclass(frozen=True)
class OscillatingMode:
    """An oscillating mode.

    Parameters
    ----------
    period
        Period in steps, 2π / |arg μ|.
    decay
        Factor by which the amplitude changes in a step, |μ|.
    """

    period: float
    decay: float


def modes(eigenvalues: Complex, relaxation: float, memory: float) -> Complex:
    """Return the eigenvalues μ of the step with relaxation and momentum, (2n,).

    Parameters
    ----------
    eigenvalues : (n,)
        Eigenvalues λ of the rule's own step.
    relaxation, memory
        Parameters w and b of the solver.

    Notes
    -----
    The result contains both roots of μ² - (1 + b - w (1 - λ)) μ + b = 0. Without momentum, one of
    them is 1 - w (1 - λ), and the other is zero.
    """
    half = (1.0 + memory - relaxation * (1.0 - eigenvalues)) / 2.0
    root = np.sqrt(half * half - memory + 0j)
    return np.concatenate([half + root, half - root])


def largest_stable_relaxation(eigenvalues: Complex, memory: float) -> float | None:
    """Return the relaxation below which all modes decay with the given momentum. Modes with λ = 1
    are ignored.

    Return None if no positive relaxation is stable, because an eigenvalue exceeds 1 or |memory| ≥
    1. Also return None if every relaxation is stable.
    """
    z = 1.0 - eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
    if not len(z) or z.real.min() < NEUTRAL or abs(memory) >= 1.0:
        return None
    stretched = z.imag * ((1.0 + memory) / (1.0 - memory))
    return float((2.0 * (1.0 + memory) * z.real / (z.real**2 + stretched**2)).min())


def slowest_oscillation(mu: Complex) -> OscillatingMode | None:
    """Return the oscillating mode with the longest period, given the eigenvalues μ of a step.
    Return None if all eigenvalues are real."""
    oscillating = mu[np.abs(mu.imag) > STRAIGHT]
    if not len(oscillating):
        return None
    slowest = oscillating[np.argmin(np.abs(np.angle(oscillating)))]
    return OscillatingMode(float(2.0 * np.pi / np.abs(np.angle(slowest))), float(np.abs(slowest)))


def oscillation_limit(relaxation: float, memory: float) -> float:
    """Return 1 - (1 - √b)² / w, for a momentum 0 < b < 1. Modes with a real λ below it oscillate.

    Modes with λ below 1 - (1 + √b)² / w, however, do not oscillate.
    """
    return 1.0 - float((1.0 - np.sqrt(memory)) ** 2) / relaxation


SHIFT_MARGIN = 1e-7
"""Distance between the shift of the inverse iteration and the bound of the spectrum."""

MAX_MULTIPLICATIONS = 1e9
"""Largest number of multiplications for one spectrum."""

KRYLOV_VECTORS = 20
"""Number of Krylov vectors. In addition to each matrix product, an iteration needs this number of
multiplications for each component of a vector."""


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues λ of a matrix.

    Parameters
    ----------
    radius, smallest, largest
        max |λ|, min Re λ and max Re λ.
    symmetric
        Whether all diagonal blocks are symmetric.
    eigenvalues
        The eigenvalues that were computed. These are all eigenvalues of small blocks, and the
        extreme eigenvalues of large blocks.
    """

    radius: float
    smallest: float
    largest: float
    symmetric: bool
    eigenvalues: Complex


class TooExpensiveError(RuntimeError):
    """The eigenvalues are so close together that their computation would exceed the maximum number
    of multiplications."""


def spectrum(matrix: Any) -> Spectrum:
    """Compute the extreme eigenvalues of a dense or sparse matrix, and all eigenvalues of its small
    blocks.

    Raises
    ------
    TooExpensiveError
        If more than `MAX_MULTIPLICATIONS` multiplications are needed.
    """
    values, symmetric, budget = [np.empty(0, complex)], True, _Budget()
    for block in _diagonal_blocks(matrix):
        is_symmetric = abs(block - block.T).max() <= 1e-12 * max(1.0, abs(block).max())
        symmetric &= bool(is_symmetric)
        values.append(_extremes(block, bool(is_symmetric), budget))
    return spectrum_of(np.concatenate(values), symmetric)


def spectrum_of(eigenvalues: Complex, symmetric: bool) -> Spectrum:
    """Return the spectrum with the given eigenvalues."""
    if not len(eigenvalues):
        return Spectrum(0.0, 0.0, 0.0, True, eigenvalues)
    real = eigenvalues.real
    return Spectrum(
        float(abs(eigenvalues).max()), float(real.min()), float(real.max()), symmetric, eigenvalues
    )


def just_below(matrix: Any, edge: float) -> Complex:
    """Compute, for each large block, the eigenvalue below `edge` that is nearest to it.

    Eigenvalues are compared by their real parts, and computed by a shifted inverse iteration. The
    eigenvalues of small blocks are in `Spectrum.eigenvalues`.

    Raises
    ------
    TooExpensiveError
        If more than `MAX_MULTIPLICATIONS` multiplications are needed.
    """
    budget = _Budget()
    blocks = _diagonal_blocks(matrix) if matrix.shape[0] > DENSE else ()
    large = (block for block in blocks if block.shape[0] > DENSE)
    eigenvalues = [budget.nearest(block, edge, symmetric=False, k=1, which="SR") for block in large]
    return np.concatenate([np.empty(0, complex), *eigenvalues])


def has_symmetric_rows(matrix: Any) -> bool:
    """Return whether a sparse matrix becomes symmetric if its rows are multiplied by some positive
    factors.

    Its eigenvalues are then real.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.csgraph import breadth_first_order

    _, label = connected(matrix, strongly=False)
    factor = np.ones(matrix.shape[0])
    for root in np.unique(label, return_index=True)[1]:
        order, predecessor = breadth_first_order(matrix, root, directed=False)
        nodes, parents = order[1:], predecessor[order[1:]]
        downward, upward = (np.ravel(matrix[i, j]) for i, j in ((parents, nodes), (nodes, parents)))
        if not (downward * upward > 0.0).all():
            return False
        for i, j, ratio in zip(nodes, parents, downward / upward, strict=True):
            factor[i] = factor[j] * ratio
    symmetrised = diags_array(factor) @ matrix
    return bool(abs(symmetrised - symmetrised.T).max() <= 1e-9 * abs(symmetrised).max())


def _diagonal_blocks(matrix: Any) -> Iterator[Any]:
    """Yield the strongly connected diagonal blocks. Of several equal blocks only one is yielded."""
    count, label = connected(matrix, strongly=True)
    order = np.argsort(label, kind="stable")
    bounds = np.searchsorted(label[order], np.arange(count + 1))
    single = np.diff(bounds) == 1
    values = matrix.diagonal()[order[bounds[:-1][single]]].tolist()
    yield from (np.array([[value]]) for value in sorted(set(values)))
    keys = set()
    for n in np.flatnonzero(~single):
        members = np.sort(order[bounds[n] : bounds[n + 1]])
        block = matrix[members][:, members]
        key = hash(_hashable(block))
        if key not in keys:
            keys.add(key)
            yield block


def _hashable(block: Any) -> tuple[Any, ...]:
    if isinstance(block, np.ndarray):
        return block.shape, block.tobytes()
    block.sort_indices()
    return block.shape, block.data.tobytes(), block.indices.tobytes()


class _Budget:
    """Counter of the multiplications in an iteration. If there are too many, it ends the iteration
    with TooExpensiveError."""

    def __init__(self) -> None:
        self._remaining = MAX_MULTIPLICATIONS

    def counted(self, size: int, cost: int, product: Callable[[Any], Any]) -> Any:
        """Return a scipy.sparse.linalg.LinearOperator that computes the product and counts its
        multiplications."""
        from scipy.sparse.linalg import LinearOperator

        def counted(x: Any) -> Any:
            self._remaining -= cost + KRYLOV_VECTORS * size
            if self._remaining < 0:
                raise TooExpensiveError
            return product(x)

        return LinearOperator((size, size), matvec=counted, dtype=float)

    def nearest(self, block: Any, end: float, *, symmetric: bool, **options: Any) -> Any:
        """Compute eigenvalues of a sparse block near `end`, by a shifted inverse iteration."""
        from scipy.sparse import eye_array
        from scipy.sparse.linalg import eigs, eigsh, splu

        size = block.shape[0]
        factors = splu((block - end * eye_array(size)).tocsc())
        inverse = self.counted(size, factors.L.nnz + factors.U.nnz, factors.solve)
        solver = eigsh if symmetric else eigs
        return solver(block, sigma=end, OPinv=inverse, return_eigenvectors=False, **options)


def _extremes(block: Any, symmetric: bool, budget: _Budget) -> Complex:
    if block.shape[0] <= DENSE:
        dense = block if isinstance(block, np.ndarray) else block.toarray()
        eigenvalues = np.linalg.eigvalsh(dense) if symmetric else np.linalg.eigvals(dense)
        return eigenvalues.astype(complex)
    if not symmetric:
        from scipy.sparse.linalg import eigs

        product = budget.counted(block.shape[0], block.nnz, block.dot)
        parts = [eigs(product, k=6, which=w, return_eigenvectors=False) for w in ("LM", "LR", "SR")]
        return np.concatenate(parts)
    # The shift lies just outside the spectrum, which is bounded by Gershgorin's discs.
    diagonal = block.diagonal()
    spread = np.asarray(abs(block).sum(axis=1)).ravel() - abs(diagonal)
    ends = ((diagonal + spread).max() + SHIFT_MARGIN, (diagonal - spread).min() - SHIFT_MARGIN)
    options: dict[str, Any] = {"symmetric": True, "k": 2, "which": "LM", "tol": 1e-10}
    return np.concatenate([budget.nearest(block, end, **options) for end in ends]).astype(complex)
