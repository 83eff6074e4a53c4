"""Run commands, each in a fork, on a number of field files and results that are damaged or
malicious, and of experiments that name files elsewhere.

    python tests/reliability/hostile_files.py [--count N] [--seed S] [--only NUMBER]

None crashes, hangs, is called a bug, takes more memory than `MOST_BYTES`, shows values that the
file does not hold, or reads what lies elsewhere. `--only` prints one case.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent)]
import h5py
import matplotlib
from isolation import Outcome, outcomes, report, serve
from mutate_results import make_subject, mutated

matplotlib.use("Agg")
import matplotlib.pyplot  # the forks find all that is heavy loaded
import numpy as np
import xarray

import pbdkit
import pbdkit.cli.check
import pbdkit.cli.plot
import pbdkit.cli.result
import pbdkit.web.command_line
import pbdkit.web.report  # noqa: F401  # as above
from pbdkit.cli import main as program
from pbdkit.io.seal import put_seal, seal_of
from pbdkit.model.reading import FileResolver
from pbdkit.model.validation import read_field

PATIENCE_S, LONGEST_S = 120.0, 60.0
MOST_BYTES = 2 * 2**30
"""Bytes of memory that a case may take; of address space it gets twice as many."""
SECRET, SECRET_TEXT = 0.7310585786300049, b"TOPSECRET"
DOCUMENTED = (0, 2, 3, 4, 6)
"""Exit statuses that a command may end with here."""
EXPERIMENT: dict[str, Any] = {
    "version": 1,
    "name": "hostile",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "velocity", "velocity": [0.1, 0.0], "steps": 3},
        },
    ],
    "steps": 5,
}
Change = Callable[[h5py.File, random.Random], None]


# Files made to do harm: each change is made to a sound file, under a name and a variable.


def _bomb(file: h5py.File, draw: random.Random) -> None:
    length = draw.choice([10**7, 10**9, 10**12, 2**40])
    file.create_dataset("more", (length,), "f8", chunks=(10**6,))
    if draw.random() < 0.5:
        file["more"].make_scale("more")


def _deep_bomb(file: h5py.File, draw: random.Random) -> None:
    """Stored in truth, and compressed as much as deflate can."""
    data = file.create_dataset("more", (draw.choice([10**6, 10**7]),), "f8", compression="gzip")
    data[...] = 0.0


def _longer(file: h5py.File, draw: random.Random) -> None:
    """A coordinate, or a variable, that declares more than is written of it."""
    name = draw.choice([n for n in file if isinstance(file[n], h5py.Dataset)])
    old = file[name]
    shape = tuple(draw.choice([n, 10**5, 10**9]) for n in old.shape) or (10**10,)
    kept = {key: old.attrs.get(key) for key in ("CLASS", "NAME") if key in old.attrs}
    del file[name]
    new = file.create_dataset(name, shape, "f8", chunks=tuple(min(n, 1000) for n in shape))
    new.attrs.update(kept)


def _external(file: h5py.File, draw: random.Random) -> None:
    name = draw.choice(["E", "pe1", "position", "more", "y"])
    shape = file[name].shape if name in file else (8,)
    if name in file:
        del file[name]
    size = int(np.prod(shape)) * 8
    file.create_dataset(name, shape, "f8", external=[("../secret.bin", 0, size)])


def _external_link(file: h5py.File, draw: random.Random) -> None:
    name = draw.choice(["E", "pe1", "x", "more"])
    if name in file:
        del file[name]
    kinds = [h5py.ExternalLink("../secret.h5", "/E"), h5py.SoftLink("/position")]
    file[name] = draw.choice(kinds)


def _virtual(file: h5py.File, draw: random.Random) -> None:
    name = draw.choice(["E", "pe1", "more"])
    shape = file[name].shape if name in file else (4, 4)
    if name in file:
        del file[name]
    layout = h5py.VirtualLayout(shape, "f8")
    layout[...] = h5py.VirtualSource("../secret.h5", "E", shape)
    file.create_virtual_dataset(name, layout)


def _filter(file: h5py.File, draw: random.Random) -> None:
    """Stored by another filter than netCDF's own: LZF, scale-offset, or one that is not here."""
    name = draw.choice(["E", "more"])
    if name in file:
        del file[name]
    more = draw.choice([{"compression": "lzf"}, {"scaleoffset": 2}])
    file.create_dataset(name, data=np.ones((6, 6)), chunks=(3, 3), **more)


def _texts(file: h5py.File, draw: random.Random) -> None:
    """One long text to which many elements could refer."""
    count = draw.choice([10, 1000, 20000])
    texts = file.create_dataset("texts", (count,), h5py.string_dtype())
    texts[0] = "x" * draw.choice([10, 10**6])


def _text_attribute(file: h5py.File, draw: random.Random) -> None:
    count = draw.choice([10, 3000])
    file.attrs.create("texts", ["x" * 100] * count, dtype=h5py.string_dtype())


def _large_chunk(file: h5py.File, draw: random.Random) -> None:
    length = draw.choice([10**6, 2**28])
    data = file.create_dataset("more", (5,), "f8", chunks=(length,), maxshape=(None,), **_ZLIB)
    if length < 2**20:
        data[...] = 1.0


_ZLIB = {"compression": "gzip"}


def _circle(file: h5py.File, draw: random.Random) -> None:
    group = file.create_group("g")
    group["again"] = file["/"]
    for n in range(draw.choice([3, 2000])):
        group[f"n{n}"] = group


def _packing(file: h5py.File, draw: random.Random) -> None:
    """Attributes that change what the numbers mean, and that make no sense, or do."""
    names = [n for n in ("E", "x", "pe1", "position") if n in file]
    odd: list[Any] = ["abc", [1.0, 2.0], np.nan, 0.0, 2.0, b"\xff", np.int8(3), [], 1e308]
    keys = ["scale_factor", "add_offset", "_FillValue", "missing_value", "units", "_Unsigned"]
    value = draw.choice(odd)
    file[draw.choice(names)].attrs[draw.choice(keys)] = (
        draw.choice(["days since 2000-01-01", "true", value]) if draw.random() < 0.3 else value
    )


def _dimensions(file: h5py.File, draw: random.Random) -> None:
    """Lists of dimensions that are damaged."""
    for name in [n for n in file if isinstance(file[n], h5py.Dataset)]:
        for key in ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "_Netcdf4Dimid"):
            if key in file[name].attrs and draw.random() < 0.3:
                del file[name].attrs[key]
                if draw.random() < 0.5:
                    file[name].attrs[key] = draw.choice([0, -1, "x", [1, 2]])


def _embedded(file: h5py.File, draw: random.Random) -> None:
    """An experiment that names files, in a result."""
    if "experiment" not in file.attrs:
        return _bomb(file, draw)
    parts = json.loads(file.attrs["experiment"])
    secret = draw.choice(["/etc/passwd", "../secret.csv", "../secret.txt", "secret.csv"])
    if draw.random() < 0.6:
        parts["leaders"][-1]["motion"] = {"type": "table", "file": secret}
    else:
        parts["rule"] = EXPERIMENT["rule"] | {"stiffness": {"file": secret, "variable": "E"}}
    file.attrs["experiment"] = json.dumps(parts)
    return None


CHANGES: dict[str, Change] = {
    "bomb": _bomb, "deep bomb": _deep_bomb, "longer": _longer, "external": _external,
    "link": _external_link, "virtual": _virtual, "filter": _filter, "texts": _texts,
    "text attribute": _text_attribute, "chunk": _large_chunk, "circle": _circle,
    "packing": _packing, "dimensions": _dimensions, "embedded": _embedded,
}  # fmt: skip
REFUSED = ("external", "link", "virtual")
"""Changes after which no command may end well that reads the file: data would lie elsewhere."""


def make_subjects(folder: Path) -> None:
    """Sound files, and what no case may read."""
    x = np.arange(6.0) * 3.0 - 1.0
    values = np.random.default_rng(0).random((6, 6)) + 1.0
    field = xarray.Dataset({"E": (("x", "y"), values)}, {"x": x, "y": x})
    for n, how in enumerate(
        [
            {"engine": "h5netcdf"},
            {"engine": "netcdf4"},
            {"engine": "h5netcdf", "encoding": {"E": {"zlib": True}}},
            {"engine": "netcdf4", "encoding": {"E": {"fletcher32": True}}},
        ]
    ):
        field.to_netcdf(folder / f"field{n}.nc", **how)
    for name in ("sealed", "sealed-zlib", "rewritten"):
        make_subject(name, folder)
    secret = np.full((64, 64), SECRET)
    (folder / "secret.bin").write_bytes(secret.tobytes())
    (folder / "secret.csv").write_text(f"step,ux,uy\n1,{SECRET},0\n")
    (folder / "secret.txt").write_bytes(SECRET_TEXT + b",ux,uy\n1,2,TOPSECRET\n")
    xarray.Dataset({"E": (("x", "y"), secret)}, {"x": np.arange(64.0), "y": np.arange(64.0)}) \
        .to_netcdf(folder / "secret.h5", engine="h5netcdf")  # fmt: skip


# One function for each kind of case: it makes files, and returns the command, whether it has to be
# refused, and what was done.
Case = tuple[list[str], bool, str]


def _damaged(sound: Path, path: Path, draw: random.Random) -> str:
    """Damage a sound file, and return a description: bytes damaged, or a malicious change and, in a
    result, a valid seal."""
    if draw.random() < 0.5:
        what, content = mutated(sound.read_bytes(), draw)
        path.write_bytes(content)
        return what
    content = sound.read_bytes()
    with FileIO(sound) as file:
        seal = seal_of(file)
    path.write_bytes(content[: seal.size] if seal else content)
    what = draw.choice([*CHANGES])
    with contextlib.suppress(ValueError, KeyError, OSError), h5py.File(path, "r+") as file:
        CHANGES[what](file, draw)
    if seal:
        with FileIO(path, "r+b") as file:
            put_seal(file)
    return what


def field_case(folder: Path, subjects: Path, draw: random.Random) -> Case:
    """An experiment with a field file."""
    what = _damaged(subjects / f"field{draw.randrange(4)}.nc", folder / "f.nc", draw)
    rule = EXPERIMENT["rule"] | {"stiffness": {"file": "f.nc", "variable": "E"}}
    (folder / "e.json").write_text(json.dumps(EXPERIMENT | {"rule": rule}))
    return ["check", "e.json"], what in REFUSED, f"field, {what}"


COMMANDS = (
    ["verify", "r.nc"], ["plot", "r.nc", "--color", "pe1", "-o", "p.png"], ["explain", "r.nc"],
    ["report", "r.nc", "-o", "p.html"], ["status", "r.nc"], ["resume", "r.nc", "--steps", "14"],
    ["curve", "r.nc", "-o", "c.png"], ["export", "r.nc"],
)  # fmt: skip


def result_case(folder: Path, subjects: Path, draw: random.Random) -> Case:
    """A result, looked at by any command."""
    sound = subjects / f"{draw.choice(['sealed', 'sealed-zlib', 'rewritten'])}.nc"
    what = _damaged(sound, folder / "r.nc", draw)
    command = draw.choice(COMMANDS)
    reads = command[0] not in ("status",)
    return command, reads and what in REFUSED, f"{sound.stem}, {what}, {command[0]}"


ELSEWHERE = (
    "../secret.csv", "{}/secret.csv", "link.csv", "linked/secret.csv", "/etc/passwd",
    "../secret.txt", "a/../../secret.csv", "./../secret.csv",
)  # fmt: skip
NO_FILES = (
    "/dev/zero", "/dev/stdin", ".", "", "x" * 300, "x/" * 3000, "no.csv", "\n", "fifo", "a\0b", 7,
    None, ["d.csv"], {"a": 1},
)  # fmt: skip
TABLES = (
    b"step,ux,uy\n1,1_0,0\n", b"step,ux,uy\n1," + "١".encode() + b",0\n", b"step,ux,uy\n1,nan,0\n",
    b"step,ux,uy\n" + b"1,0,0,\n" * 10, b"," * 3_000_000 + b"\n", b"step,ux,ux\n1,2,3\n",
    ",".join(f"ux{n}" for n in range(300_000)).encode(), b"step,ux,uy\n1,\"0\n,0\n" * 9,
    b"step,ux,uy\n1,1e400,0\n", b"\xff\xfe" + b"step,ux,uy\n", b"", b"\0" * 99,
    b"step,ux,uy\r1,0,0\r",
)  # fmt: skip


def experiment_case(folder: Path, subjects: Path, draw: random.Random) -> Case:
    """An experiment, a sweep or a fit that names files: elsewhere, none, or damaged tables."""
    (folder / "link.csv").symlink_to("../secret.csv")
    (folder / "linked").symlink_to("..")
    (folder / "a").mkdir()
    os.mkfifo(folder / "fifo")
    kind = draw.choice(["elsewhere", "no file", "table", "mutated"])
    name: Any = "d.csv"
    if kind == "elsewhere":
        name = draw.choice(ELSEWHERE).format(subjects)
    elif kind == "no file":
        name = draw.choice(NO_FILES)
    elif kind == "table":
        (folder / name).write_bytes(draw.choice(TABLES))
    else:
        sound = b"step,ux,uy\n" + b"".join(b"%d,0.0%d,0.0\n" % (n, n) for n in range(1, 9))
        (folder / name).write_bytes(mutated(sound * 100, draw)[1])
    leaders = [*EXPERIMENT["leaders"][:1], {"select": {"edge": "right"}}]
    if draw.random() < 0.5 or kind in ("table", "mutated"):
        leaders[1]["motion"] = {"type": "table", "file": name}
        parts = EXPERIMENT | {"leaders": leaders}
    else:
        rule = EXPERIMENT["rule"] | {"stiffness": {"file": name, "variable": "E"}}
        parts = EXPERIMENT | {"rule": rule}
    (folder / "e.json").write_text(json.dumps(parts))
    (folder / "s.json").write_text(json.dumps({"experiment": parts, "vary": {"steps": [4]}}))
    (folder / "f.json").write_text(
        json.dumps(
            {
                "experiment": parts,
                "unknown": {"rule.poisson_ratio": [0.1, 0.3]},
                "measured": {"file": name},
            }
        )
    )
    commands = [["check", "e.json"], ["run", "e.json"], ["sweep", "s.json", "--workers", "1"]]
    commands += [["fit", "f.json"], ["identify", "e.json"]]
    command = draw.choice(commands)
    return command, kind in ("elsewhere", "no file"), f"experiment, {kind}, {name!r:.30}, {command}"


CASES = (field_case, result_case, result_case, experiment_case)


def tried(seed: int, number: int, subjects: Path) -> Outcome:
    """Return the outcome of the case of that number, in a fork with a bound on its memory."""
    draw = random.Random(f"{seed}/{number}")
    with tempfile.TemporaryDirectory(dir=subjects) as name:
        folder = Path(name)
        command, refused, what = CASES[number % len(CASES)](folder, subjects, draw)
        begun = time.monotonic()
        pid = os.fork()
        if pid == 0:
            _child(folder, command)
        status, peak = _ended(pid)
        log = (folder / "log").read_text(errors="replace") if (folder / "log").exists() else ""
        found: Outcome = {"what": what, "status": status, "peak_mib": peak / 2**20}
        found["seconds"] = time.monotonic() - begun
        how = f"status {status}"
        if status < 0:
            how = "hang" if status == -signal.SIGKILL else f"crash ({status})"
        elif status not in DOCUMENTED or "a bug in pbdkit" in log or "Traceback" in log:
            how = f"undocumented: {log.strip()[-300:]}"
        elif refused and status == 0:
            how = "read what lies elsewhere"
        elif _leaks(folder, log):
            how = "shows what lies elsewhere"
        elif status == 0 and number % len(CASES) == 0 and not _as_stored(folder):
            how = "shows values that are not in the file"
        found["how"] = how
        return found


def _child(folder: Path, command: list[str]) -> None:
    os.chdir(folder)
    log = os.open("log", os.O_WRONLY | os.O_CREAT)
    for descriptor, source in ((0, os.open(os.devnull, os.O_RDONLY)), (1, log), (2, log)):
        os.dup2(source, descriptor)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (2 * MOST_BYTES,) * 2)
    code: Any = 70
    try:
        program(command)
    except SystemExit as end:
        code = end.code or 0
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 71)


def _ended(pid: int) -> tuple[int, int]:
    """Exit status, or minus the signal, and the peak of memory; one that hangs is killed."""
    end = time.monotonic() + LONGEST_S
    while time.monotonic() < end:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    _, status, usage = os.wait4(pid, 0)
    return os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024


def _leaks(folder: Path, log: str) -> bool:
    """Return whether data from elsewhere is in a message, or in a file that a command wrote."""
    needles = (SECRET_TEXT, struct.pack("<d", SECRET), str(SECRET)[:10].encode(), b"root:")
    told = [log.encode()]
    made = (p for p in folder.iterdir() if p.is_file() and p.name not in ("link.csv", "log"))
    told += [path.read_bytes() for path in made]
    return any(needle in text for text in told for needle in needles)


def _as_stored(folder: Path) -> bool:
    """Return whether the field that was read is what HDF5 itself finds in the file."""
    taken = read_field({"file": "f.nc", "variable": "E"}, FileResolver(folder))
    with h5py.File(folder / "f.nc") as file:
        stored = {name: file[name][...] for name in ("E", "x", "y")}
        packed = {*file["E"].attrs, *file["x"].attrs} & {"scale_factor", "add_offset", "_Unsigned"}
    values = stored["E"] if taken.values.shape == stored["E"].shape else stored["E"].T
    same = np.array_equal(taken.values, values) or np.array_equal(taken.values, stored["E"].T)
    return bool(packed or (same and np.array_equal(taken.x, stored["x"])))


def faults(outcome: Outcome) -> list[str]:
    """Return the faults of the outcome of a case."""
    how, what = outcome["how"], outcome.get("what", "")
    found = [] if how.startswith("status") else [f"{how}: {what}"]
    if outcome.get("peak_mib", 0.0) > MOST_BYTES / 2**20:
        found.append(f"{outcome['peak_mib']:.0f} MiB: {what}")
    return found


def attack(count: int, seed: int, folder: Path, workers: int = 2) -> list[tuple[int, Outcome]]:
    """The outcomes of the first `count` cases of a seed."""
    make_subjects(folder)
    command = [__file__, "--seed", str(seed), "--folder", str(folder)]
    return outcomes(command, range(count), PATIENCE_S, workers)


def main() -> None:
    """The command, and the child that it starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--only", type=int)
    parser.add_argument("role", nargs="?", choices=["serve"])
    given = parser.parse_args()
    if given.role:
        serve(lambda number: tried(given.seed, number, given.folder))
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.only is not None:
            make_subjects(folder)
            print(json.dumps(tried(given.seed, given.only, folder)))
            return
        found = attack(given.count, given.seed, folder, given.workers)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    sys.exit(report(found, given.seed, faults) > 0)


if __name__ == "__main__":
    main()
