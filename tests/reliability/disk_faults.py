"""Inject faults of a disk at each call by which a command writes: an error, a short write, a full
disk.

    python tests/reliability/disk_faults.py [--commands run,export] [--kinds EIO,short,full]
                                            [--every N] [--first N]

A library of 200 lines of C is compiled and preloaded. The n-th call of a command on files below its
folder (write, pwrite, fsync, fdatasync, link, rename, unlink, ftruncate, mkdir, mmap, open with
O_CREAT) fails with EIO, writes half of its bytes, or, with all that need room after it, reports
ENOSPC. Each trial is a fork of one process that has imported everything. Checked are the exit
status, the message, the earlier file, the files in the folder, that an output of exit 0 is that of
the undisturbed command, and that the next call produces it if the exit was 6.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LIBRARY = "PBDKIT_DISK_FAULTS"
"""The variable of the environment that names the library, which is preloaded then."""
KINDS = {"EIO": 1, "short": 2, "full": 3}
SKIPPED = 77
MEMORY = Path("/dev/shm")
"""A file system that need not wait for a disk."""


def preloaded() -> Any:
    """The library, in a process that has it; else this script is run once more in one that has, and
    this process ends as that does."""
    if LIBRARY in os.environ:
        library = ctypes.CDLL(os.environ[LIBRARY])
        library.disk_faults_calls.restype = ctypes.c_long
        return library
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        print("skipped: the faults need Linux and a C compiler named cc")
        raise SystemExit(SKIPPED)
    with tempfile.TemporaryDirectory() as folder:
        library = str(Path(folder, "disk_faults.so"))
        source = str(Path(__file__).with_suffix(".c"))
        subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True
        )
        more = {LIBRARY: library, "LD_PRELOAD": library, "SOURCE_DATE_EPOCH": "0"}
        done = subprocess.run([sys.executable, *sys.argv], env=os.environ | more, check=False)
    raise SystemExit(done.returncode)


FAULTS = preloaded() if __name__ == "__main__" else None
if FAULTS:
    from trials import BASE, BREAKING, differences, ended, often, started

    import pbdkit
    from pbdkit.cli import main
    from pbdkit.io.seal import SealedFile
    from pbdkit.io.sinks import OverlappingSink

SMALL = {
    "body": {"type": "grid", "columns": 10, "rows": 8},
    "steps": 5,
    "diagnostics": [{"type": "pe1"}, {"type": "broken"}],
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
    again: Callable[[], list[str]] | None = None
    """The command by which one comes to the result after a fault that left parts of it."""


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
    try:
        return differences(one, other)
    except Exception as error:  # whatever a broken file leads to
        return [f"{type(error).__name__}: {error}"]


def _same_sweep(one: Path, other: Path) -> list[str]:
    try:
        for path in (one, other):
            with SealedFile(path) as file:
                file.check()
                if file.seal is None:
                    return [f"{path}: has no seal"]
        with pbdkit.open(one) as first, pbdkit.open(other) as second:
            first.attrs["created"] = second.attrs["created"]
            return [] if first.identical(second) else [f"{one}: other values"]
    except Exception as error:  # as above
        return [f"{type(error).__name__}: {error}"]


def _same_page(one: Path, other: Path) -> list[str]:
    """Compare the pages except for the time of day."""
    texts = [re.sub(r'"created": ?"[^"]*"', "", p.read_text()) for p in (one, other)]
    return [] if texts[0] == texts[1] else [f"{one}: another text"]


def quietly(*words: str, before: Callable[[], object] = lambda: None) -> tuple[int, str]:
    """A command without faults, in the current folder."""
    log = Path.cwd().with_name("log")

    def work() -> None:
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


def _unfinished() -> None:
    """A run that is killed at its second commit."""
    from pbdkit.io.run_store import UnfinishedRun

    _experiment()
    keep, left = UnfinishedRun.keep, [2]

    def killed() -> None:
        _each_step()

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
    return ["resume", "out.nc"] if Path("out.nc.run").exists() else [*RUN, "--force"]


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


def _fitted_once() -> Callable[[], None]:
    """A fit writes nothing while it computes, so that one serves all trials."""
    found: list[Any] = []

    def before() -> None:
        if not found:
            found.append(pbdkit.fit("f.json"))
        pbdkit.fit = lambda file: found[0]

    return before


def _sweeping() -> None:
    _experiment()
    Path("s.json").write_text(json.dumps({"experiment": "e.json"} | SWEEP))


def _earlier_run() -> None:
    _experiment(steps=3)
    assert quietly("run", "e.json", "-o", "out.nc")[0] == 0
    _experiment()


def _finished() -> None:
    _experiment()
    assert quietly("run", "e.json", "-o", "out.nc")[0] == 0


RUN = ["run", "e.json", "-o", "out.nc", "--quiet"]
LONGER = ["resume", "out.nc", "--steps", "9"]
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
        "longer": Command(LONGER, "out.nc", _finished, _each_step, _same_run, lambda: LONGER),
        "sweep": Command(
            SWEEPING, "s/sweep.nc", _sweeping, same=_same_sweep, again=lambda: SWEEPING
        ),
        "fit": Command(FITTING, "out.json", _fitting, _fitted_once()),
        "fit --plot": Command([*FITTING, *PLOTTED], "out.png", _fitting, _fitted_once()),
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


class Bench:
    """The trials of one command."""

    def __init__(self, command: Command, root: Path) -> None:
        self.command, self._root = command, root
        self._start, self._whole, self._folder = root / "start", root / "whole", root / "trial"
        self._log = root / "log"
        self._start.mkdir(parents=True)
        os.chdir(self._start)
        command.prepare()
        self._fresh(self._whole)
        command.before()
        with suppress(SystemExit):  # in this process, which finds all of it loaded from then on
            main([*command.words])
        assert Path(command.output).exists()
        assert self._trial(0, 0) == (0, [])
        self.calls = FAULTS.disk_faults_calls()

    def _fresh(self, folder: Path) -> None:
        os.chdir(self._root)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self._start, folder)
        os.chdir(folder)

    def _trial(self, number: int, kind: int) -> tuple[int, list[str]]:
        """The exit status, and what is wrong."""
        self._fresh(self._folder)

        def work() -> None:
            self.command.before()
            FAULTS.disk_faults_arm(os.fsencode(self._folder), ctypes.c_long(number), kind)
            main([*self.command.words])

        code = ended(started(work, self._log), 120.0)
        return code, list(self._judged(code, self._log.read_text(errors="replace")))

    def _judged(self, code: int, said: str) -> Iterator[str]:
        output = Path(self.command.output)
        whole, earlier = self._whole / output, self._start / output
        if code not in (0, 6):
            yield f"exit {code}: {said[-300:]}"
        if "a bug in pbdkit" in said or "Traceback" in said:
            yield f"says {said[-300:]}"
        if "is damaged" in said.replace("where it is damaged", ""):
            yield f"blames a sound file: {said[-300:]}"
        if (
            code == 6
            and len([line for line in said.splitlines() if line.startswith("pbdkit")]) != 1
        ):
            yield f"not one message: {said!r}"
        left = [p for p in self._left() if not (LOGS if code == 0 else STORES).fullmatch(p)]
        if left:
            yield f"exit {code}, left behind: {left}"
        if code == 0 and not output.exists():
            yield "exit 0, and no output"
        elif code == 0:
            yield from self.command.same(output, whole)
        elif output.exists() and not (earlier.exists() and not _same_bytes(output, earlier)):
            yield from (f"exit {code}, and {text}" for text in self.command.same(output, whole))
        elif earlier.exists() and not output.exists():
            yield "the earlier file is gone"
        if code == 6 and self.command.again:
            yield from self._resumed(self.command.again(), output, whole)

    def _left(self) -> list[str]:
        """Return the files in the folder that the undisturbed command does not leave."""
        names = [
            {str(p.relative_to(top)) for p in top.rglob("*")} for top in (self._folder, self._whole)
        ]
        return sorted(names[0] - names[1])

    def _resumed(self, words: list[str], output: Path, whole: Path) -> Iterator[str]:
        """The next command comes to the same result."""
        code, said = quietly(*words, before=self.command.before)
        if code:
            yield f"then exit {code}: {said[-300:]}"
            return
        yield from (f"then {text}" for text in self.command.same(output, whole))
        if left := [p for p in self._left() if not LOGS.fullmatch(p)]:
            yield f"then left behind: {left}"

    def tried(self, kind: str, first: int, every: int) -> tuple[int, list[str]]:
        """Return the number of trials, and their findings."""
        numbers = range(first, self.calls + 1, every)
        findings = []
        for number in numbers:
            code, found = self._trial(number, KINDS[kind])
            if kind == "short" and code:
                found.append(f"exit {code} for what is no fault")
            findings += (
                [f"{kind} at call {number} of {self.calls}: {'; '.join(found)}"] if found else []
            )
        return len(numbers), findings


def _prepare_drawing() -> None:
    """Make pictures that are the same in every trial."""
    import matplotlib

    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "the same in every trial"


def _main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--commands", default="")
    asked.add_argument("--kinds", default=",".join(KINDS))
    asked.add_argument("--first", type=int, default=1)
    asked.add_argument("--every", type=int, default=1)
    given = asked.parse_args()
    _prepare_drawing()
    total = broke = 0
    every = commands()
    for name in given.commands.split(",") if given.commands else every:
        with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
            bench = Bench(every[name], Path(folder).resolve())
            for kind in given.kinds.split(","):
                count, findings = bench.tried(kind, given.first, given.every)
                for text in findings:
                    print(f"  {name}, {text}", flush=True)
                held = f"{count - len(findings)} of {count} held, of {bench.calls} calls"
                print(f"{name}, {kind}: {held}", flush=True)
                total, broke = total + count, broke + len(findings)
            os.chdir("/")
    print(f"{total - broke} of {total} held", flush=True)
    raise SystemExit(broke > 0)


if __name__ == "__main__":
    _main()
