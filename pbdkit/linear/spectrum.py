"""Eigenvalues of the step operator of a scene that is small enough for a matrix, block by block of
coupled unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.signedinteger[Any]]

DENSE = 500
"""Matrices of up to so many rows are made dense."""


@dataclass(frozen=True)
class Entries:
    """A matrix as (row, column, value); entries of one place are added."""

    rows: NDArray[np.signedinteger[Any]]
    columns: NDArray[np.signedinteger[Any]]
    values: Floats
    shape: tuple[int, int]

    def plus(self, other: Entries, factor: float = 1.0) -> Entries:
        """The sum with `factor` times a matrix, in the shape of that."""
        rows = np.concatenate([self.rows, other.rows])
        columns = np.concatenate([self.columns, other.columns])
        values = np.concatenate([self.values, factor * other.values])
        return Entries(rows, columns, values, other.shape)

    def without(self, unknowns: Indices) -> Entries:
        """The matrix less some rows and columns."""
        kept = np.ones(self.shape[0], bool)
        kept[unknowns] = False
        number = np.cumsum(kept) - 1
        some = kept[self.rows] & kept[self.columns]
        size = int(np.count_nonzero(kept))
        at = number[self.rows[some]], number[self.columns[some]]
        return Entries(*at, self.values[some], (size, size))

    def matrix(self) -> Any:
        """Dense up to DENSE rows, else sparse."""
        if self.shape[0] > DENSE:
            return self.sparse()
        place = self.rows * self.shape[1] + self.columns
        return np.bincount(place, self.values, self.shape[0] * self.shape[1]).reshape(self.shape)

    def sparse(self) -> Any:
        """A scipy.sparse.csr_array."""
        import scipy.sparse

        return scipy.sparse.coo_array((self.values, (self.rows, self.columns)), self.shape).tocsr()


def identity_like(matrix: Any) -> Any:
    """1, dense or sparse as a square matrix is."""
    if isinstance(matrix, np.ndarray):
        return np.eye(len(matrix))
    from scipy.sparse import eye_array

    return eye_array(matrix.shape[0], format="csr")


def one_minus(matrix: Any) -> Any:
    """1 - a matrix, dense or sparse as it is."""
    found = identity_like(matrix) - matrix
    return found if isinstance(matrix, np.ndarray) else found.tocsr()


def connected(matrix: Any, *, strongly: bool) -> tuple[int, Indices]:
    """(count, label): the groups of unknowns that reach one another, along arrows or either way."""
    if not matrix.shape[0]:
        return 0, np.empty(0, np.intp)
    if not isinstance(matrix, np.ndarray):
        from scipy.sparse.csgraph import connected_components

        kind = "strong" if strongly else "weak"
        count, label = connected_components(matrix, connection=kind)
        return count, label
    reach = (matrix != 0.0) | np.eye(len(matrix), dtype=bool)
    if not strongly:
        return _touching(reach | reach.T)
    while True:
        further = reach.astype(np.float32) @ reach.astype(np.float32) > 0.0
        if (further == reach).all():
            break
        reach = further
    first = np.argmax(reach & reach.T, axis=1)  # the lowest unknown of each group names it
    names, label = np.unique(first, return_inverse=True)
    return len(names), label


def _touching(reach: NDArray[np.bool_]) -> tuple[int, Indices]:
    """The same where all lead both ways: each group from its lowest unknown outwards."""
    count, label = 0, np.full(len(reach), -1)
    while (unlabelled := label < 0).any():
        front = np.flatnonzero(unlabelled)[:1]
        count += 1
        while len(front):
            label[front] = count - 1
            front = np.flatnonzero(reach[front].any(axis=0) & (label < 0))
    return count, label


@dataclass
class Couplings:
    """Blocks (axis, axis) at (row, column), in parts, counted in particles; those of one place add.

    `shape` is in particles, `axes` how many space has.
    """

    shape: tuple[int, int]
    axes: int
    parts: list[tuple[Indices, Indices, Floats]] = field(default_factory=list)

    def add(self, rows: Indices, columns: Indices, blocks: Floats) -> None:
        """Adds blocks, (entry, axis, axis)."""
        if len(rows):
            self.parts.append((rows, columns, blocks))

    def add_scaled_identity(self, rows: Indices, factor: float) -> None:
        """Adds factor · 1 on the diagonal of some rows."""
        block = factor * np.eye(self.axes)
        self.add(rows, rows, np.broadcast_to(block, (len(rows), *block.shape)))

    def entries(self, to: Sequence[int] = (), of: Sequence[int] = ()) -> Entries:
        """Of the matrix from some axes `of` particles `to` others, (all of them, the same): with
        unknowns 2n (x) and 2n + 1 (y) of particle n in the plane, 3n to 3n + 2 in space, n for one
        axis."""
        to = to or range(self.axes)
        of = of or to
        shape = (len(to) * self.shape[0], len(of) * self.shape[1])
        rows, columns, blocks = self._joined()
        if len(to) + len(of) < 2 * self.axes:
            blocks = blocks[:, np.array(to)[:, None], of]
        entry, i, j = np.nonzero(blocks)
        values = blocks[entry, i, j]
        return Entries(len(to) * rows[entry] + i, len(of) * columns[entry] + j, values, shape)

    def _joined(self) -> tuple[Indices, Indices, Floats]:
        """Return all parts as one."""
        if not self.parts:
            nothing = np.empty(0, np.intp)
            return nothing, nothing, np.empty((0, self.axes, self.axes))
        rows, columns, blocks = (np.concatenate(values) for values in zip(*self.parts, strict=True))
        return rows, columns, blocks

    def couples(self, a: int, b: int) -> bool:
        """Whether anything leads from axis b to axis a."""
        return any(blocks[:, a, b].any() for _, _, blocks in self.parts)

    def is_isotropic(self) -> bool:
        """Whether all axes move alike."""
        return all(
            np.array_equal(blocks[:, 0, 0], blocks[:, a, a])
            for _, _, blocks in self.parts
            for a in range(1, self.axes)
        )

    def times(self, vectors: Floats) -> Floats:
        """The product with vectors, (particle, axis)."""
        rows, columns, blocks = self._joined()
        terms = np.einsum("eab,eb->ea", blocks, vectors[columns])
        return np.stack([np.bincount(rows, along, self.shape[0]) for along in terms.T], axis=1)


def frame_matrices(weights: Floats, axes: int) -> Floats:
    """(entry, axis, axis): a frame's weights as matrices."""
    return weights[:, None, None] * np.eye(axes) if weights.ndim == 1 else weights


MOST_PARTICLES, MOST_ENDS, MOST_ANSWERS, MANY = 50_000, 800_000, 2e8, 42
"""The most particles, ends of bonds, and answers of a rule: where somebody has more than MANY
neighbours each particle is asked what each neighbour does to each."""


def excess(scene: Scene) -> str:
    """What the scene has too much of, in words; empty where it is small enough."""
    particles, neighbourhood = scene.raster.count, scene.neighbourhood
    if particles > MOST_PARTICLES:
        return f"{particles} particles, {MOST_PARTICLES} at most"
    each = 2 * len(neighbourhood.planes) // len(neighbourhood.slots)
    most = min(MOST_ENDS // each, int(MOST_ANSWERS / each**2) if each > MANY else particles)
    if particles > most:
        return f"{particles} particles with {each} neighbours each, {most} at most"
    return ""


Complex = NDArray[np.complexfloating[Any, Any]]
NEUTRAL = 1e-9
"""Eigenvalues this near to 1 in modulus count as 1."""
STRAIGHT = 1e-6
"""Imaginary parts below this are rounding: a mode that turns by less a step does not swing."""


@dataclass(frozen=True)
class Swing:
    """A mode that swings: its period in steps, 2π / |arg μ|, and by what it shrinks a step, |μ|."""

    period: float
    decay: float


def modes(eigenvalues: Complex, relaxation: float, memory: float) -> Complex:
    """(2n,): both roots μ for each of n eigenvalues λ of the rule's own step; the λ themselves,
    relaxed, and zeros without memory."""
    half = (1.0 + memory - relaxation * (1.0 - eigenvalues)) / 2.0
    root = np.sqrt(half * half - memory + 0j)
    return np.concatenate([half + root, half - root])


def largest_stable_relaxation(eigenvalues: Complex, memory: float) -> float | None:
    """The w below which all modes λ shrink with this memory, those with λ = 1 apart.

    None where there is no such w > 0 (an eigenvalue above 1, |memory| ≥ 1) or no bound to it.
    """
    z = 1.0 - eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
    if not len(z) or z.real.min() < NEUTRAL or abs(memory) >= 1.0:
        return None
    stretched = z.imag * ((1.0 + memory) / (1.0 - memory))
    return float((2.0 * (1.0 + memory) * z.real / (z.real**2 + stretched**2)).min())


def slowest_swing(found: Complex) -> Swing | None:
    """The swing of the longest period among modes μ of a step; None where all have real μ."""
    swinging = found[np.abs(found.imag) > STRAIGHT]
    if not len(swinging):
        return None
    slowest = swinging[np.argmin(np.abs(np.angle(swinging)))]
    return Swing(float(2.0 * np.pi / np.abs(np.angle(slowest))), float(np.abs(slowest)))


def swings_below(relaxation: float, memory: float) -> float:
    """Real λ swing from here down, 1 - (1 - √b)² / w for 0 < b, as long as they are above
    1 - (1 + √b)² / w."""
    return 1.0 - float((1.0 - np.sqrt(memory)) ** 2) / relaxation


BEYOND = 1e-7
"""How far outside the spectrum the shift of the inverse iteration lies."""

DEAREST, VECTORS = 1e9, 20
"""So many multiplications are made at most for a spectrum, VECTORS a number beside each product."""


@dataclass(frozen=True)
class Spectrum:
    """`radius` = max |λ|, `smallest` = min Re λ, `largest` = max Re λ; `symmetric` whether all
    groups are; `eigenvalues` those that were computed: all of small groups, the extreme ones of
    others."""

    radius: float
    smallest: float
    largest: float
    symmetric: bool
    eigenvalues: Complex


class TooDearError(RuntimeError):
    """The eigenvalues lie too close together to be told apart with a bounded number of products."""


def spectrum(matrix: Any) -> Spectrum:
    """The extreme eigenvalues of a matrix, dense or sparse; all of them of small groups. Raises
    TooDearError where that would take long."""
    values, symmetric, meter = [np.empty(0, complex)], True, _Meter()
    for group in _groups(matrix):
        even = abs(group - group.T).max() <= 1e-12 * max(1.0, abs(group).max())
        symmetric &= bool(even)
        values.append(_extremes(group, bool(even), meter))
    return spectrum_of(np.concatenate(values), symmetric)


def spectrum_of(found: Complex, symmetric: bool) -> Spectrum:
    """The spectrum with these eigenvalues."""
    if not len(found):
        return Spectrum(0.0, 0.0, 0.0, True, found)
    real = found.real
    return Spectrum(float(abs(found).max()), float(real.min()), float(real.max()), symmetric, found)


def just_below(matrix: Any, edge: float) -> Complex:
    """Of each large group of a sparse matrix, the eigenvalue nearest to `edge` among those with a
    smaller real part, by a shifted inverse iteration; those of small groups `spectrum` has. Raises
    TooDearError where that would take long."""
    meter = _Meter()
    groups = _groups(matrix) if matrix.shape[0] > DENSE else ()
    large = (group for group in groups if group.shape[0] > DENSE)
    found = [meter.nearest(group, edge, symmetric=False, k=1, which="SR") for group in large]
    return np.concatenate([np.empty(0, complex), *found])


def has_symmetric_rows(matrix: Any) -> bool:
    """Whether positive factors of its rows make a sparse matrix symmetric: its eigenvalues are real
    then."""
    from scipy.sparse import diags_array
    from scipy.sparse.csgraph import breadth_first_order

    _, label = connected(matrix, strongly=False)
    factor = np.ones(matrix.shape[0])
    for root in np.unique(label, return_index=True)[1]:
        order, before = breadth_first_order(matrix, root, directed=False)
        others, known = order[1:], before[order[1:]]
        there, back = (np.ravel(matrix[i, j]) for i, j in ((known, others), (others, known)))
        if not (there * back > 0.0).all():
            return False
        for i, j, ratio in zip(others, known, there / back, strict=True):
            factor[i] = factor[j] * ratio
    even = diags_array(factor) @ matrix
    return bool(abs(even - even.T).max() <= 1e-9 * abs(even).max())


def _groups(matrix: Any) -> Iterator[Any]:
    """The strongly connected diagonal blocks, equal ones once."""
    count, label = connected(matrix, strongly=True)
    order = np.argsort(label, kind="stable")
    bounds = np.searchsorted(label[order], np.arange(count + 1))
    alone = np.diff(bounds) == 1
    values = matrix.diagonal()[order[bounds[:-1][alone]]].tolist()
    yield from (np.array([[v]]) for v in sorted(set(values)))
    seen = set()
    for n in np.flatnonzero(~alone):
        own = np.sort(order[bounds[n] : bounds[n + 1]])
        block = matrix[own][:, own]
        key = hash(_content(block))
        if key not in seen:
            seen.add(key)
            yield block


def _content(block: Any) -> tuple[Any, ...]:
    if isinstance(block, np.ndarray):
        return block.shape, block.tobytes()
    block.sort_indices()
    return block.shape, block.data.tobytes(), block.indices.tobytes()


class _Meter:
    """Counts the multiplications of an iteration, and ends it when they are too many."""

    def __init__(self) -> None:
        self._left = DEAREST

    def counted(self, size: int, cost: int, product: Callable[[Any], Any]) -> Any:
        """The product as a scipy.sparse.linalg.LinearOperator."""
        from scipy.sparse.linalg import LinearOperator

        def counted(x: Any) -> Any:
            self._left -= cost + VECTORS * size
            if self._left < 0:
                raise TooDearError
            return product(x)

        return LinearOperator((size, size), matvec=counted, dtype=float)

    def nearest(self, block: Any, end: float, *, symmetric: bool, **wanted: Any) -> Any:
        """The eigenvalues of a sparse block near `end`, by a shifted inverse iteration."""
        from scipy.sparse import eye_array
        from scipy.sparse.linalg import eigs, eigsh, splu

        size = block.shape[0]
        factors = splu((block - end * eye_array(size)).tocsc())
        inverse = self.counted(size, factors.L.nnz + factors.U.nnz, factors.solve)
        find = eigsh if symmetric else eigs
        return find(block, sigma=end, OPinv=inverse, return_eigenvectors=False, **wanted)


def _extremes(block: Any, symmetric: bool, meter: _Meter) -> Complex:
    if block.shape[0] <= DENSE:
        dense = block if isinstance(block, np.ndarray) else block.toarray()
        found = np.linalg.eigvalsh(dense) if symmetric else np.linalg.eigvals(dense)
        return found.astype(complex)
    if not symmetric:
        from scipy.sparse.linalg import eigs

        product = meter.counted(block.shape[0], block.nnz, block.dot)
        some = [eigs(product, k=6, which=w, return_eigenvectors=False) for w in ("LM", "LR", "SR")]
        return np.concatenate(some)
    # Shifted inverses just outside the spectrum: Gershgorin's discs bound it.
    diagonal = block.diagonal()
    spread = np.asarray(abs(block).sum(axis=1)).ravel() - abs(diagonal)
    ends = ((diagonal + spread).max() + BEYOND, (diagonal - spread).min() - BEYOND)
    how: dict[str, Any] = {"symmetric": True, "k": 2, "which": "LM", "tol": 1e-10}
    return np.concatenate([meter.nearest(block, end, **how) for end in ends]).astype(complex)
