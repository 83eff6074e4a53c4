"""A disk that is full at each of the first writes of a run, and room made afterwards.

    python tests/reliability/full_disk.py [--trials N]

Needs the right to mount a file system in memory, which has 4 KiB more in each trial.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

from trials import BASE, BREAKING, OUTPUT, debris, differences, done, reference, row

from pbdkit.errors import PbdkitError
from pbdkit.io.run_store import status_of

LOG = Path("/dev/shm/pbdkit-full-disk-log")
PARTS = BASE | BREAKING | {"body": {"type": "grid", "columns": 40, "rows": 30}, "steps": 16}


def mounted(folder: Path, kib: int, *, again: bool = False) -> None:
    """A file system of that size at a folder."""
    options = f"{'remount,' if again else ''}size={kib}k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)


def tried(folder: Path, kib: int, whole: Path) -> tuple[list[str], bool]:
    """Return the faults of a run on a disk of that size, and whether it was too small."""
    mounted(folder, kib)
    os.chdir(folder)
    try:
        code, said = done("run", str(whole.parent / "e.json"), "-o", OUTPUT, log=LOG)
        if code == 0:
            return differences(whole, Path(OUTPUT)), False
        found = [] if code == 6 and "full" in said else [f"exit {code}: {said}"]
        if len([line for line in said.splitlines() if line.startswith("pbdkit")]) != 1:
            found.append(f"not one message: {said}")
        told = "resume" in said
        mounted(folder, 65536, again=True)
        try:
            kept = status_of(Path(OUTPUT)) is not None
        except PbdkitError as error:
            return [*found, f"unreadable: {error}"], True
        if told and not kept:
            found.append("was told to resume what is not there")
        command = (
            ["resume", OUTPUT] if kept else ["run", str(whole.parent / "e.json"), "-o", OUTPUT]
        )
        code, said = done(*command, log=LOG)
        if code:
            return [*found, f"{command[0]} with room again: exit {code}: {said}"], True
        found += differences(whole, Path(OUTPUT))
        if left := debris(folder, OUTPUT):
            found.append(f"left behind: {left}")
        return found, True
    finally:
        os.chdir("/")
        subprocess.run(["umount", "-l", str(folder)], check=True)


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=200)
    asked.add_argument("--from", dest="first", type=int, default=0)
    given = asked.parse_args()
    right = full = 0
    with tempfile.TemporaryDirectory() as name:
        whole, _ = reference(PARTS, Path(name, "whole"))
        folder = Path(name, "disk")
        folder.mkdir()
        for number in range(given.first, given.first + given.trials):
            found, was_full = tried(folder, 4 * (number + 1), whole)
            for finding in found:
                print(f"{4 * (number + 1)} KiB: {finding}", flush=True)
            right, full = right + (not found), full + was_full
    row(
        f"disk full: clear error, gone on with, identical {given.trials} of {given.trials}",
        f"{right} of {given.trials}, the disk was too small in {full}",
    )
    raise SystemExit(right < given.trials)


if __name__ == "__main__":
    main()
