"""What the processes of a run record: each of its own particles; the first writes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from pbdkit.interfaces import Diagnostic
from pbdkit.ranks.divided_driver import Division
from pbdkit.ranks.joining import Share, joined
from pbdkit.results.layout import Column, Values, When, when_measured
from pbdkit.results.measured import Measured
from pbdkit.results.moment import StateMoment
from pbdkit.results.recorder import Recorder, columns_of
from pbdkit.results.sink import KeepingSink, Sink
from pbdkit.results.tables import Tables
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import State
from pbdkit.storage.pieced_array import PiecedArray
from pbdkit.storage.standing import Standing


class DividedRecorder(Recorder):
    """Records a part. Diagnostics that are not `local` measure the whole state, which the first
    process gathers for them."""

    def __init__(self, division: Division, sink: PartSink) -> None:
        super().__init__(division.scene, sink)
        self._joining = sink
        self._division, self._ranks = division, division.ranks
        whole = division.whole
        self._wholes = (Tables(whole), Measured(whole)) if whole else None
        self._whole: State | None = None
        diagnostics = division.scene.experiment.diagnostics
        self._gathered = {when_measured(d) for d in diagnostics if not d.local}
        self._local = {when_measured(d) for d in diagnostics if d.local}

    def begin(self, history: Iterable[Values] | None = None) -> None:
        """A history is that of the whole, which the first process has."""
        super().begin(None if history is None else ())
        if history is not None:
            self._joining.take(history)

    def observe(self, state: State, *, last: bool = False, within: float | None = None) -> None:
        """As one process does, which has no increments `within` steps. What one refuses all of them
        do."""
        if state.step <= self.seen.step and not last:
            return
        recorded = last or self._scene.experiment.records(state.step)
        measured = {When.STEP, When.RECORD} if recorded else {When.STEP}
        if measured & self._gathered:
            self._whole = self._division.gathered(state)
        if measured & self._local:
            self._division.halo.look_back(state)
        with self._ranks.agreeing(), np.errstate(all="ignore"):
            values = self._taken(state, last)
        self._put(state, values)

    def finish(self, state: State, outcome: Any, prediction: dict[str, Any]) -> None:
        """As one process does."""
        self._whole = self._division.gathered(state) if When.END in self._gathered else None
        if When.END in self._local:
            self._division.halo.look_back(state)
        super().finish(state, outcome, prediction)

    def _diagnosed(self, when: When, moment: StateMoment) -> Values:
        values = self._measured.diagnosed(when, moment, _is_local)
        if self._wholes and self._whole and when in self._gathered:
            tables, measured = self._wholes
            whole = moment.of(self._whole, tables)
            values |= measured.diagnosed(when, whole, lambda d: not _is_local(d))
        return values

    def _inside_out(self, state: State) -> str | None:
        """Only where some part has turned over is the whole looked at."""
        if not self._ranks.any(super()._inside_out(state) is not None):
            return None
        whole = self._division.gathered(state)
        if whole is None:
            return None
        tables = self._wholes[0] if self._wholes else Tables(build_scene(self._scene.experiment))
        return StateMoment(whole, tables).cells.inside_out()


def _is_local(diagnostic: Diagnostic) -> bool:
    return diagnostic.local


class PartSink(KeepingSink):
    """Takes the parts of all processes, and puts them into the sink that the first one has."""

    def __init__(self, division: Division, inner: KeepingSink) -> None:
        self._ranks = division.ranks
        self._inner = inner if self._ranks.first else None
        self._own = {"particle": division.part.rows}
        if division.scene.experiment.shows_bonds:
            rows, ends = division.part.rows, division.scene.bonds.ends[:, 0]
            self._own["bond"] = slice(*np.searchsorted(ends, (rows.start, rows.stop)).tolist())
        counts = {dim: own.stop - own.start for dim, own in self._own.items()}
        self._lengths = {dim: self._ranks.every(count) for dim, count in counts.items()}
        self._sizes = {dim: sum(lengths) for dim, lengths in self._lengths.items()}
        diagnostics = division.scene.experiment.diagnostics
        self._not_local = {v.name for d in diagnostics if not d.local for v in d.variables()}
        columns = columns_of(division.scene)
        self._parts = {c.name: found for c in columns if (found := self._parted(c))}

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """With the sizes of the whole."""
        self._first(lambda inner: inner.begin(columns, sizes | self._sizes, planned))

    def take(self, history: Iterable[Values]) -> None:
        """Entries of the whole, which the first process has."""

        def put(inner: Sink) -> None:
            for values in history:
                inner.put(values)

        self._first(put)

    def _parted(self, column: Column) -> tuple[str, int] | None:
        """The dimension of which processes have parts, and which axis of an entry it is; None where
        each has all."""
        dims = column.dims[1:] if column.grows else column.dims
        along = [n for n, dim in enumerate(dims) if dim in self._own]
        if not along or column.name in self._not_local:
            return None
        return dims[along[0]], along[0]

    def put(self, values: Values) -> None:
        """Parts are joined; of all else that of the first process counts."""
        whole = dict(values)
        for name in [name for name in values if name in self._parts]:
            dim, axis = self._parts[name]
            part = np.asarray(values[name])[(*(slice(None),) * axis, self._own[dim])]
            if name == "bond":  # a part counts its own
                part += sum(self._lengths[name][: self._ranks.rank]) + 1 - part[:1]
            whole[name] = joined(self._ranks, part, axis, self._lengths[dim])
        self._first(lambda inner: inner.put(whole), whole)

    def due(self) -> bool:
        """As the first process finds it."""
        return bool(self._ranks.told(self._inner is not None and self._inner.due()))

    def keep(self, standing: Standing) -> None:
        """One for all, with the state of the whole."""
        self._first(lambda inner: inner.keep(standing), standing.arrays)

    def suspend(self, standing: Standing) -> None:
        """As it is kept."""
        self._first(lambda inner: inner.suspend(standing), standing.arrays)

    def note_end(self, standing: Standing) -> None:
        """As it is kept."""
        self._first(lambda inner: inner.note_end(standing), standing.arrays)

    def finish(self, attributes: dict[str, str]) -> None:
        """Says on how many processes it was run."""
        self._first(lambda inner: inner.finish(attributes | {"ranks": str(self._ranks.size)}))

    def abandon(self) -> None:
        """Only the first process has anything to remove."""
        if self._inner:
            self._inner.abandon()

    def _first(
        self, call: Callable[[KeepingSink], None], joining: Mapping[str, Any] | None = None
    ) -> None:
        """Calls the sink, in the first process; what goes wrong there is raised in all. Others send
        their shares of what is joined meanwhile."""
        with self._ranks.agreeing():
            if self._inner:
                try:
                    call(self._inner)
                finally:
                    for array in (joining or {}).values():
                        if isinstance(array, PiecedArray):
                            array.drain()
            else:
                for share in (joining or {}).values():
                    if isinstance(share, Share):
                        share.send(self._ranks)
