"""The scene of a part, which each process builds of its own rows and what is near."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.solvers import Equilibrium, Solver, Stepping
from pbdkit.interfaces import AppliesTwice, Cell, FollowerRule
from pbdkit.interfaces.frame import Indices
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.divided_rows import deep_halo, deep_subdomains
from pbdkit.ranks.subdomain import Subdomain, bounds_of, subdomains, widest_halo
from pbdkit.ranks.survey import survey
from pbdkit.registry.blame import blaming
from pbdkit.scene.ground import Ground
from pbdkit.scene.others import Others, Stretch
from pbdkit.scene.places import Floats, Mask
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.scene.sizes import TooLargeError


class Cut(NamedTuple):
    """What cuts a scene into parts for a solver; and how wide halos are at most, where neighbours
    and frame points of a step reach so many rows, neighbours alone so many, of parts of so many
    rows and more, and of so many parts."""

    subdomains: Callable[[Scene, int], list[Subdomain]]
    widest: Callable[[int, int, int, int], int]


CUTS: dict[type[Solver], Cut] = {
    Stepping: Cut(subdomains, widest_halo),
    Equilibrium: Cut(deep_subdomains, deep_halo),
}


class ElsewhereError(PbdkitError):
    """Another process has given up."""


class OtherRanks(Others):
    """The other processes. Where one gives up, all others do at their next call."""

    def __init__(self, ranks: Ranks) -> None:
        self._ranks, self.size, self.on_machine = ranks, ranks.size, ranks.on_machine()
        self._own = self._framed = 0, 0

    def at(self, stretch: Stretch, own: tuple[int, int], framed: tuple[int, int]) -> None:
        """What this process builds, and of which lines of sites it counts what it finds, and knows
        whom frame points follow."""
        self.stretch, self._own, self._framed = stretch, own, framed

    def every(self, value: Any) -> list[Any]:
        """By rank."""
        found = self._ranks.every((True, value))
        if not all(goes_on for goes_on, _ in found):
            raise ElsewhereError("another process has given up")
        return [one for _, one in found]

    def least(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """By rank."""
        self.every(None)
        return self._ranks.least(numbers)

    def is_own(self, lines: Indices) -> Mask:
        """As it was told."""
        return (lines >= self._own[0]) & (lines < self._own[1])

    def sees_frame(self, lines: Indices) -> Mask:
        """As it was told."""
        return (lines >= self._framed[0]) & (lines < self._framed[1])

    @contextmanager
    def together(self) -> Iterator[None]:
        """What is raised in the block, in any process, ends it in all of them: by ElsewhereError
        where it is not this one's."""
        try:
            yield
        except ElsewhereError:
            raise
        except BaseException:
            self._ranks.every((False, None))
            raise
        self.every(None)


def built(ranks: Ranks, experiment: Experiment) -> Scene:
    """The scene of a process's own rows and what is near; of the whole where parts cannot be built
    alone: where frame points follow particles far away, and to say what is wrong as one process
    does. Raises what `build_scene` does, in all processes."""
    if experiment.frame.local:
        error: Exception | None = None
        try:
            others = OtherRanks(ranks)
            with others.together():
                return _built(ranks, experiment, others)
        except Exception as raised:
            error = None if isinstance(raised, ElsewhereError) else raised
        bug = error is not None and not isinstance(error, PbdkitError)
        if ranks.any(bug or _is_too_large(experiment)):
            if isinstance(error, ExperimentError):
                error = experiment.located(error)
            ranks.raise_first(error)
    with ranks.agreeing():
        return build_scene(experiment)


def _is_too_large(experiment: Experiment) -> bool:
    """Whether the whole is too large for one process."""
    try:
        Ground(experiment)
    except TooLargeError:
        return True
    except PbdkitError:
        pass
    return False


def _built(ranks: Ranks, experiment: Experiment, others: OtherRanks) -> Scene:
    ground = Ground(experiment, others)
    if not (known := survey(ground, others, ranks.rank)):
        raise ground.nothing()
    bounds = bounds_of(known.rows, ranks.size)
    begin, end = bounds[ranks.rank : ranks.rank + 2]
    search, reach = _search(ground), ground.neighbourhood.reach_in_cells[0]
    each, least = _levels(experiment.rule) * (reach + search), int(np.diff(bounds).min())
    cut = CUTS[type(experiment.solver)]
    halo = cut.widest(each, reach, least, ranks.size)

    def around(rows: int) -> Stretch:
        return known.stretch(begin - rows, end + rows)

    others.at(around(halo + search + reach), around(0).lines, around(halo).lines)
    scene = build_scene(experiment, others)
    if any(
        p.low < p.begin - halo or p.high > p.end + halo for p in cut.subdomains(scene, ranks.size)
    ):
        raise ExperimentError("its points follow particles farther away than it says", ("frame",))
    return scene


def _levels(rule: FollowerRule) -> int:
    """So many times what a step reaches a particle sees at most: masses see one step farther."""
    levels = 2
    while isinstance(rule, AppliesTwice):
        with blaming(rule, "when asked for its inner rule", "rule"):
            levels, rule = levels + 1, rule.inner()
    return levels


def _search(ground: Ground) -> int:
    """So many rows from a frame point at most are the particles that are nearest to it, and those
    twice as far as the frame is deep, in site indices."""
    cell: Cell = ground.cell
    steps = [math.hypot(*v) / p for v, p in zip(cell.vectors, cell.period, strict=True)]
    farthest = ground.layers * sum(steps) + sum(math.hypot(*v) for v in cell.vectors)
    vectors: Floats = np.array(cell.vectors)
    height = 1.0 / float(np.linalg.norm(np.linalg.inv(vectors)[:, 0]))
    near = math.ceil(farthest / height) if ground.layers else 0
    return 1 + max(near, math.ceil(2 * ground.layers / cell.period[0]))
