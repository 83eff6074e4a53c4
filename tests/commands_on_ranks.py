"""Carry out several command lines one after another, in each process that mpiexec starts.

    mpiexec -n 2 python tests/commands_on_ranks.py LINES

LINES is a list of lists of words in JSON. A line is a command of pbdkit, or a script with its
arguments. All processes write the output of line 0 to the files 0.out and 0.err in the current
folder, and their exit statuses to 0.status. Processes that start once for all lines import pbdkit
once.
"""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple


class Ended(NamedTuple):
    """The exit statuses of all processes, and their output together."""

    statuses: list[int]
    out: str
    err: str


def on_ranks(mpiexec: str, size: int, lines: Sequence[list[str]], folder: Path) -> list[Ended]:
    """Return the outcome of each line. The command of mpiexec itself must succeed."""
    command = [mpiexec, "-n", str(size), sys.executable, __file__, json.dumps(lines)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return [
        Ended(
            [int(status) for status in (folder / f"{n}.status").read_text().split()],
            (folder / f"{n}.out").read_text(),
            (folder / f"{n}.err").read_text(),
        )
        for n in range(len(lines))
    ]


@contextmanager
def output_to(name: str) -> Iterator[None]:
    """Append the output of this process to files that all processes share."""
    kept = [os.dup(descriptor) for descriptor in (1, 2)]
    for descriptor, end in ((1, "out"), (2, "err")):
        file = os.open(f"{name}.{end}", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, descriptor)
        os.close(file)
    try:
        yield
    finally:
        for stream, descriptor in ((sys.stdout, kept[0]), (sys.stderr, kept[1])):
            stream.flush()
            os.dup2(descriptor, stream.fileno())
            os.close(descriptor)


def carry_out(words: list[str]) -> int:
    """Return the exit status of a line."""
    from interpreted_kernels import interpreting

    from pbdkit.cli import main

    try:
        if words[0].endswith(".py"):
            sys.argv = words
            sys.path.insert(0, str(Path(words[0]).parent))
            with interpreting():
                runpy.run_path(words[0], run_name="__main__")
        else:
            main(words)
    except SystemExit as end:
        return int(end.code or 0)
    return 0


if __name__ == "__main__":
    for number, line in enumerate(json.loads(sys.argv[1])):
        with output_to(str(number)):
            status = carry_out(line)
        with Path(f"{number}.status").open("a") as file:
            file.write(f"{status}\n")
