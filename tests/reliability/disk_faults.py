"""Inject a fault at each call by which a command reads or writes its files, or allocates memory.

    python tests/reliability/disk_faults.py [--command run,export] [--kind eio,kill] [--every N]
                                            [--first N] [--least BYTES] [--messages]

A library of C (faults.c) is compiled and preloaded. Counted are the calls of a command on files
below its folder: write, pwrite, fsync, fdatasync, link, rename, unlink, ftruncate, mkdir, rmdir,
mmap and open. The calls of SQLite within a commit are among them. The kinds of faults are

    eio       the n-th call fails with EIO
    enospc    the n-th call and all later ones that need room fail with ENOSPC
    short     the n-th call writes half of its bytes, as POSIX allows
    kill      SIGKILL before the n-th call
    power     a power cut before the n-th call; contents and names that were not synced are lost
    torn      the same, but names and a random part of the contents are on the disk
    memory    the n-th allocation of 64 KiB or more, and all later ones, return NULL
    block     the n-th allocation of 64 KiB or more returns NULL, later ones succeed

Each trial is a fork of one process that has imported everything. Power cuts are derived from one
recorded execution. A trial holds if the exit status is documented, one message names the place, the
earlier output is unchanged unless the new one is complete, no other file remains, and the same
command (`resume` for an unfinished run) then comes to the output of the undisturbed command, bit
for bit. A crash in a library that has no memory is listed with the name of the library; all other
conditions apply to it too. The exit status is 1 if a trial did not hold.
"""

from __future__ import annotations

import argparse
import csv
import gc
import hashlib
import json
import os
import random
import re
import secrets
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from faults import Disk, arm, changes, load

MEMORY_KINDS = ("memory", "block")
POWER_KINDS = ("power", "torn")
KINDS = ("eio", "enospc", "short", "kill", *POWER_KINDS, *MEMORY_KINDS)
MEMORY = Path("/dev/shm")
"""A file system that need not wait for a disk."""
LEAST = 2**16
"""Number of bytes of the smallest allocation that fails."""

FAULTS = load(__file__) if __name__ == "__main__" else None
if FAULTS:
    from trials import BASE, BREAKING, differences, ended, network, often, started

    import pbdkit
    from pbdkit.cli import main
    from pbdkit.errors import PbdkitError
    from pbdkit.io.run_store import status_of
    from pbdkit.io.seal import SealedFile
    from pbdkit.io.sinks import OverlappingSink

SMALL = {
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "steps": 3,
    "diagnostics": [{"type": "pe1"}],
}
SWEEP = {"vary": {"solver.relaxation": [0.5, 1.0]}, "keep": {"variables": ["pe1"], "times": "last"}}
FIT = {
    "experiment": {
        "name": "plate",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "rectangle", "width": 8.0, "height": 4.0},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "velocity", "velocity": [0.1, 0.0], "steps": 1},
            },
        ],
        "steps": 1,
        "solver": {"type": "equilibrium"},
    },
    "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
    "measured": {"file": "field.csv", "noise": 1e-3},
}
STORES = re.compile(
    r"out\.nc\.run(-wal|-shm|-journal|-records)?|s(/lock|/sweep\.sqlite.*|/set-aside.*)?"
)
"""Files that an exit of 6 may leave: an unfinished run, members that are finished."""
LOGS = re.compile(r".*\.sqlite-(wal|shm)|s/set-aside.*")
"""Files that SQLite leaves if it cannot close a database, and recovers later; and files that a
sweep sets aside if it cannot read a database."""


PROJECT = re.compile(r"\.pbdkit-mine\..*")
"""Folder of a project that a killed process was writing."""


@dataclass
class Command:
    """One command, in a folder that is prepared for it; `output` is what it writes."""

    words: list[str]
    output: str
    prepare: Callable[[], None] = lambda: None
    before: Callable[[], object] = lambda: None
    """First action in the process of the command."""
    same: Callable[[Path, Path], list[str]] = field(
        default=lambda one, other: _same_bytes(one, other)
    )
    partial: int | None = None
    """Exit status of a result in which a part is missing that the next command adds."""
    again: Callable[[], list[str]] | None = None
    """The command by which one comes to the result after a fault; by default the same one."""


def _same_bytes(one: Path, other: Path) -> list[str]:
    if one.is_dir():
        names = [sorted(str(p.relative_to(top)) for p in top.rglob("*")) for top in (one, other)]
        if names[0] != names[1]:
            return [f"holds {names[0]}"]
        files = [p for p in one.rglob("*") if p.is_file()]
        return [
            f"{p}: other bytes"
            for p in files
            if p.read_bytes() != (other / p.relative_to(one)).read_bytes()
        ]
    return [] if one.read_bytes() == other.read_bytes() else [f"{one}: other bytes"]


def _same_run(one: Path, other: Path) -> list[str]:
    if not _same_bytes(one, other):  # without gaps that depend on the commits
        return []
    try:
        return differences(one, other)
    except Exception as error:  # whatever a broken file leads to
        return [f"{type(error).__name__}: {error}"]


def _same_sweep(one: Path, other: Path) -> list[str]:
    if not _same_bytes(one, other):
        return []
    try:
        for path in (one, other):
            if findings := _unsealed(path):
                return findings
        with pbdkit.open(one) as first, pbdkit.open(other) as second:
            first.attrs["created"] = second.attrs["created"]
            return [] if first.identical(second) else [f"{one}: other values"]
    except Exception as error:  # as above
        return [f"{type(error).__name__}: {error}"]


def _unsealed(path: Path) -> list[str]:
    """Return a finding if a file differs from its checksums, or has none."""
    try:
        with SealedFile(path) as file:
            file.check()
            return [] if file.seal else [f"{path}: has no seal"]
    except Exception as error:  # as above
        return [f"{type(error).__name__}: {error}"]


def _same_page(one: Path, other: Path) -> list[str]:
    """Compare the pages except for the time of day."""
    texts = [re.sub(r'"created": ?"[^"]*"', "", p.read_text()) for p in (one, other)]
    return [] if texts[0] == texts[1] else [f"{one}: another text"]


def steady(seed: int) -> None:
    """Let random names and measured times be the same in each execution of a command, so that equal
    states of the folder are recognized. The time of day stands still, by faults.c."""
    draw, ticks = random.Random(seed), count()
    secrets.token_bytes = lambda size=16: draw.randbytes(size)  # type: ignore[misc]
    secrets.token_hex = lambda size=16: draw.randbytes(size).hex()  # type: ignore[misc]
    time.perf_counter = lambda: 1e-3 * next(ticks)


def quietly(*words: str, before: Callable[[], object] = lambda: None) -> tuple[int, str]:
    """A command without faults, in the current folder."""
    log = Path.cwd().with_name("log")

    def work() -> None:
        steady(1)
        before()
        main([*words])

    code = ended(started(work, log))
    return code, log.read_text(errors="replace")


def _experiment(**more: Any) -> None:
    Path("e.json").write_text(json.dumps(BASE | BREAKING | SMALL | more))


def _result(*more: str) -> None:
    _experiment()
    code, said = quietly("run", "e.json", "-o", "in.nc", *more)
    assert code == 0, said


def _beside(name: str) -> Callable[[], None]:
    """Make a result, and an earlier file that another is to replace."""

    def prepare() -> None:
        _result()
        Path(name).write_text("earlier")

    return prepare


def _each_step() -> None:
    """The run is kept after each step."""
    often()
    # The class is changed in the child alone, which ends with the trial.
    OverlappingSink.due = lambda self: True  # type: ignore[method-assign]


def _unfinished(begin: Callable[[], object] = _each_step) -> None:
    """A run that is killed at its second commit."""
    from pbdkit.io.run_store import UnfinishedRun

    _experiment()
    keep, left = UnfinishedRun.keep, [2]

    def killed() -> None:
        begin()

        def keeping(*given: Any) -> None:
            left[0] -= 1
            if not left[0]:
                os._exit(9)
            keep(*given)

        UnfinishedRun.keep = keeping  # type: ignore[method-assign]

    code, said = quietly("run", "e.json", "-o", "out.nc", before=killed)
    assert code == 9, (code, said)


def _resume() -> list[str]:
    """After a fault of a run: resumed where anything is kept, else run."""
    if status_of(Path("out.nc")) or Path("out.nc").exists():
        return ["resume", "out.nc"]
    return RUN


def _lengthened() -> list[str]:
    """After a fault of a run that is continued beyond its end."""
    return ["resume", "out.nc"] if status_of(Path("out.nc")) else LONGER


def _on_network(begin: Callable[[], object] = lambda: None) -> Callable[[], None]:
    """Begin on a disk of another machine, where SQLite has a journal."""

    def before() -> None:
        begin()
        network()

    return before


def _fitting() -> None:
    with Path("field.csv").open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["x", "y", "ux", "uy"])
        lines.writerows(
            [x, y, 0.0125 * x, -0.003 * (y - 2.0)] for x in range(1, 8) for y in range(1, 4)
        )
    Path("f.json").write_text(json.dumps(FIT))
    Path("out.json").write_text("{}")
    Path("out.png").write_text("earlier")


def _sweeping() -> None:
    _experiment()
    Path("s.json").write_text(json.dumps({"experiment": "e.json"} | SWEEP))


def _earlier_run() -> None:
    _experiment(steps=2)
    assert quietly("run", "e.json", "-o", "out.nc")[0] == 0
    _experiment()


def _finished() -> None:
    _experiment()
    assert quietly("run", "e.json", "-o", "out.nc")[0] == 0


RUN = ["run", "e.json", "-o", "out.nc", "--quiet"]
LONGER = ["resume", "out.nc", "--steps", "5"]
SWEEPING = ["sweep", "s.json", "-o", "s", "--workers", "1"]
FITTING = ["fit", "f.json", "-o", "out.json", "--force"]
PLOTTED = ["--plot", "out.png"]
DRAWING = ["--force", "--size", "2", "2", "--dpi", "40"]


def commands() -> dict[str, Command]:
    """Every command that writes, by a name."""
    found = {
        "run": Command([*RUN, "--force"], "out.nc", _earlier_run, lambda: often(1e9), _same_run),
        "store": Command(RUN, "out.nc", _experiment, _each_step, _same_run, _resume),
        "resume": Command(
            ["resume", "out.nc"], "out.nc", _unfinished, _each_step, _same_run, _resume
        ),
        "longer": Command(LONGER, "out.nc", _finished, _each_step, _same_run, _lengthened),
        "sweep": Command(SWEEPING, "s/sweep.nc", _sweeping, same=_same_sweep, partial=5),
        "store in a journal": Command(
            RUN, "out.nc", _experiment, _on_network(_each_step), _same_run, _resume
        ),
        "resume in a journal": Command(
            ["resume", "out.nc"],
            "out.nc",
            lambda: _unfinished(_on_network(_each_step)),
            _on_network(_each_step),
            _same_run,
            _resume,
        ),
        "sweep in a journal": Command(
            SWEEPING, "s/sweep.nc", _sweeping, _on_network(), same=_same_sweep, partial=5
        ),
        "fit": Command(FITTING, "out.json", _fitting),
        "fit --plot": Command([*FITTING, *PLOTTED], "out.png", _fitting),
        "init": Command(["init", "out.yaml"], "out.yaml"),
        "init --from": Command(
            ["init", "out.yaml", "--from", "modelling/measured-boundary"], "out.yaml"
        ),
        "plugins new": Command(["plugins", "new", "pbdkit-mine"], "pbdkit-mine"),
    }
    drawn = {"plot": ("png", "svg", "pdf"), "animate": ("gif", "mp4")}
    made = [(command, suffix, DRAWING) for command, ends in drawn.items() for suffix in ends]
    made += [("curve", "svg", ["--force"]), ("export", "vtkhdf", ["--force"])]
    for command, suffix, options in (*made, ("report", "html", ["--force"])):
        output = f"out.{suffix}"
        words = [command, "in.nc", "-o", output, *options]
        same = _same_page if command == "report" else _same_bytes
        found[f"{command} {suffix}"] = Command(words, output, _beside(output), same=same)
    return found


HEADS = "calls | trials | held | broken | crashes in a library"


@dataclass
class Outcome:
    """The trials of one command with one kind of fault."""

    calls: int = 0
    trials: int = 0
    broken: int = 0
    crashes: Counter[str] = field(default_factory=Counter)
    """Crashes in libraries without memory, by the library."""
    messages: Counter[str] = field(default_factory=Counter)

    def row(self) -> str:
        """Return a row of the table."""
        held = self.trials - self.broken
        numbers = (self.calls, self.trials, held, self.broken, self.crashes.total())
        return " | ".join(map(str, numbers))


class Bench:
    """The trials of one command."""

    def __init__(self, command: Command, root: Path, least: int) -> None:
        self.command, self._root, self._least = command, root, least
        self._start, self._whole, self._folder = root / "start", root / "whole", root / "trial"
        self._log, self._record = root / "log", root / "record"
        self._known: dict[str, list[str]] = {}
        """Findings of the next command, by the state of the folder before it."""
        self._start.mkdir(parents=True)
        os.chdir(self._start)
        command.prepare()
        self._fresh(self._whole)
        with suppress(SystemExit):  # in this process, which finds all of it loaded from then on
            main([*command.words])
        self._fresh(self._whole)
        assert quietly(*command.words, before=command.before)[0] == 0
        assert Path(command.output).exists()
        gc.freeze()  # so that the processes that are forked copy less memory

    def _fresh(self, folder: Path) -> None:
        os.chdir(self._root)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self._start, folder)
        os.chdir(folder)

    def _carried_out(self, kind: str, number: int) -> tuple[int, str]:
        """Return the exit status and the output of the command with a fault."""

        def work() -> None:
            steady(0)
            self.command.before()
            log = str(self._record)
            arm(FAULTS, self._folder, kind, number, least=self._least, log=log)
            main([*self.command.words])

        code = ended(started(work, self._log), 120.0)
        return code, self._log.read_text(errors="replace")

    def tried(self, kind: str, first: int, every: int) -> Outcome:
        """Carry out the trials, and print what does not hold."""
        outcome = Outcome()
        states = self._power_cuts if kind in POWER_KINDS else self._faults
        for number, code, said in states(outcome, kind, first, every):
            outcome.trials += 1
            outcome.messages[said.strip()] += 1
            findings = list(self._judged(kind, code, said, outcome))
            outcome.broken += bool(findings)
            for text in findings:
                print(f"  {kind}, call {number} of {outcome.calls}: {text}", flush=True)
        return outcome

    def _faults(
        self, outcome: Outcome, kind: str, first: int, every: int
    ) -> Iterator[tuple[int, int, str]]:
        """Generate number, exit status and output of each trial."""
        self._fresh(self._folder)
        code, said = self._carried_out(kind, 0)
        outcome.calls = FAULTS.faults_calls()
        assert code == 0, said
        for number in range(first, outcome.calls + 1, every):
            self._fresh(self._folder)
            yield number, *self._carried_out(kind, number)

    def _power_cuts(
        self, outcome: Outcome, kind: str, first: int, every: int
    ) -> Iterator[tuple[int, int, str]]:
        """Repeat one recorded execution up to each call, and write what is on the disk then."""
        self._fresh(self._folder)
        disk = Disk(self._folder)
        code, said = self._carried_out("record", 0)
        outcome.calls = FAULTS.faults_calls()
        assert code == 0, said
        whole = Disk(self._folder)
        left = changes(self._record)
        change = next(left, None)
        os.chdir(self._root)
        for number in range(1, outcome.calls + 2):  # the last power cut is after the last call
            while change and change.number < number:
                disk.repeat(change)
                change = next(left, None)
            if number < first or (number - first) % every:
                continue
            shutil.rmtree(self._folder, ignore_errors=True)
            if kind == "power":
                disk.lost(self._folder)
            else:
                disk.torn(self._folder, random.Random(number))
            os.chdir(self._folder)
            yield number, 0 if number > outcome.calls else -signal.SIGKILL, ""
            os.chdir(self._root)
        assert disk.content("-shm") == whole.content("-shm"), "the record is not complete"

    def _judged(self, kind: str, code: int, said: str, outcome: Outcome) -> Iterator[str]:
        killed = code == -signal.SIGKILL and kind in ("kill", *POWER_KINDS)
        if kind in MEMORY_KINDS and code < 0:
            outcome.crashes[said.strip().splitlines()[-1] if said.strip() else str(code)] += 1
            killed = True
        yield from self._answered(kind, 0 if killed else code, said)
        yield from self._standing(0 if killed else code, killed, said)
        if code:
            state = self._state()
            if state not in self._known:
                self._known[state] = list(self._completed())
            yield from self._known[state]

    def _answered(self, kind: str, code: int, said: str) -> Iterator[str]:
        """Check the exit status and the message."""
        lines = [line for line in said.splitlines() if line.startswith("pbdkit")]
        partial = (self.command.partial,) if kind in MEMORY_KINDS else ()
        if code not in ((0,) if kind == "short" else (0, 6, *partial)):
            yield f"exit {code}: {said[-300:]}"
        if "a bug in pbdkit" in said or "Traceback" in said:
            yield f"message {said[-300:]}"
        if "is damaged" in said.replace("where it is damaged", ""):
            yield f"a sound file is called damaged: {said[-300:]}"
        if code == 6 and len(lines) != 1:
            yield f"not one message: {said!r}"
        elif code == 6 and "memory" not in said and not any(n in said for n in self._names()):
            yield f"no place: {said!r}"

    def _names(self) -> list[str]:
        """Return the names that a message may give as the place."""
        paths = (*self._start.rglob("*"), *self._whole.rglob("*"))
        return [path.name for path in paths] + [self.command.output]

    def _standing(self, code: int, killed: bool, said: str) -> Iterator[str]:
        """Check what is in the folder after the command. A warning may name a file that cannot be
        removed."""
        output = Path(self.command.output)
        whole, earlier = self._whole / output, self._start / output
        if not killed:
            left = [p for p in self._left() if not (LOGS if code == 0 else STORES).fullmatch(p)]
            if left and not all(f"{p}: cannot be removed" in said for p in left):
                yield f"exit {code}, left behind: {left}"
        if code and code == self.command.partial:
            yield from _unsealed(output)
        elif output.exists() and not (
            (killed or code) and earlier.exists() and not _same_bytes(output, earlier)
        ):
            yield from (f"exit {code}, and {text}" for text in self.command.same(output, whole))
        elif not output.exists() and earlier.exists():
            yield "the earlier file is gone"
        elif not output.exists() and not code and not killed:
            yield "exit 0, and no output"

    def _left(self) -> list[str]:
        """Return the files in the folder that the undisturbed command does not leave."""
        names = [
            {str(p.relative_to(top)) for p in top.rglob("*")} for top in (self._folder, self._whole)
        ]
        return sorted(names[0] - names[1])

    def _state(self) -> str:
        """Return a checksum of all names and contents in the folder, without those of the memory
        that processes share, and without numbers of processes in hidden names."""
        found = hashlib.sha256()
        for path in sorted(self._folder.rglob("*")):
            data = b"" if path.is_dir() or path.name.endswith("-shm") else path.read_bytes()
            name = re.sub(r"\.\d+\.[0-9a-f]{32}", "", str(path))
            found.update(f"{name} {len(data)} ".encode() + data)
        return found.hexdigest()

    def _completed(self) -> Iterator[str]:
        """The next command comes to the same result."""
        output = Path(self.command.output)
        whole = self._whole / output
        was_whole = output.exists() and not self.command.same(output, whole)
        try:
            words = self.command.again() if self.command.again else self.command.words
        except PbdkitError as error:
            yield f"then {error}"
            return
        code, said = quietly(*words, before=self.command.before)
        if code and not (code == 2 and was_whole):  # the output exists, and is complete
            yield f"then {words[0]}: exit {code}: {said[-300:]}"
            return
        yield from (f"then {text}" for text in self.command.same(output, whole))
        left = [p for p in self._left() if not LOGS.fullmatch(p)]
        if code == 0 and left and not all(PROJECT.fullmatch(name) for name in left):
            yield f"then left behind: {left}"


def _prepare_drawing() -> None:
    """Make pictures that are the same in every trial."""
    import matplotlib

    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "the same in every trial"


def _chosen(names: str, known: Iterable[str]) -> list[str]:
    chosen = names.split(",") if names else [*known]
    if unknown := {*chosen} - {*known}:
        raise SystemExit(f"unknown: {', '.join(unknown)}; known: {', '.join(known)}")
    return chosen


def _main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--command", default="", help="commands, separated by commas")
    asked.add_argument("--kind", default="", help="kinds of faults, separated by commas")
    asked.add_argument("--first", type=int, default=1)
    asked.add_argument("--every", type=int, default=1)
    asked.add_argument("--least", type=int, default=LEAST, help="smallest allocation that fails")
    asked.add_argument("--messages", action="store_true", help="print each message")
    given = asked.parse_args()
    _prepare_drawing()
    known, rows, trials, broken = commands(), list[str](), 0, 0
    kinds = _chosen(given.kind, KINDS)
    for name in _chosen(given.command, known):
        with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
            bench = Bench(known[name], Path(folder).resolve(), given.least)
            for kind in kinds:
                outcome = bench.tried(kind, given.first, given.every)
                listed = outcome.crashes + (outcome.messages if given.messages else Counter())
                for text, times in listed.most_common():
                    print(f"  {times} times {text!r}")
                rows.append(f"{name} | {kind} | {outcome.row()}")
                print(rows[-1], flush=True)
                trials, broken = trials + outcome.trials, broken + outcome.broken
            os.chdir("/")
    print("", f"command | kind | {HEADS}", *rows, sep="\n")
    print(f"{trials - broken} of {trials} held")
    raise SystemExit(broken > 0)


if __name__ == "__main__":
    _main()
