"""Kill one of the processes of a run, or their launcher, and resume the run with another number of
processes.

    python tests/reliability/rank_kills.py [--trials N] [--seed S]

After each kill every process must have ended within ten seconds; in the end the result is compared
with that of one undisturbed process, bit for bit.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from trials import (
    BASE,
    BREAKING,
    OUTPUT,
    debris,
    differences,
    often,
    reference,
    row,
    write_experiment as written,
)

from pbdkit.cli import main as program
from pbdkit.io.run_store import is_unfinished

EXPERIMENTS = {
    "breaking": BASE | BREAKING | {"steps": 300},
    "settling": BASE | {"steps": 3000, "solver": BASE["solver"] | {"settle": {"tolerance": 1e-3}}},
}
MOST, PATIENCE_S = 3, 10.0
PIDS = "pids"


def begun(count: int, *arguments: str) -> subprocess.Popen[bytes]:
    """Processes that carry out a command together, which commit whenever they can; each leaves its
    number in a folder."""
    pids = Path(PIDS)
    for old in pids.glob("*"):
        old.unlink()
    pids.mkdir(exist_ok=True)
    command = [sys.executable, __file__, "--program", *arguments]
    launcher = ["mpiexec", "-n", str(count)] if count > 1 else []
    return subprocess.Popen(
        [*launcher, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )


def killed(running: subprocess.Popen[bytes], count: int, draw: random.Random) -> float:
    """Kills one of the processes at some moment; after how many seconds all have ended."""
    end = time.monotonic() + 60.0
    while len(list(Path(PIDS).glob("*"))) < count and time.monotonic() < end:
        time.sleep(0.01)
    pids = [int(file.name) for file in Path(PIDS).glob("*")]
    time.sleep(draw.uniform(0.5, 3.0))
    try:
        os.kill(draw.choice([running.pid, *pids]), signal.SIGKILL)
    except ProcessLookupError:
        return 0.0  # it was quicker
    begin = time.monotonic()
    while any(map(_lives, pids)) and time.monotonic() < begin + 60.0:
        running.poll()
        time.sleep(0.02)
    return time.monotonic() - begin


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def tried(draw: random.Random, folder: Path) -> tuple[list[str], float, int]:
    """Return the faults of one run, killed and resumed; the longest end, and the kills."""
    kind = draw.choice(sorted(EXPERIMENTS))
    expected, _ = reference(EXPERIMENTS[kind], folder)
    name, longest, kills = written(EXPERIMENTS[kind], folder), 0.0, 0
    arguments = ["run", name, "-o", OUTPUT, "--force"]
    for _ in range(draw.randint(1, 3)):
        count = draw.randint(2, MOST)
        running = begun(count, *arguments)
        longest, kills = max(longest, killed(running, count, draw)), kills + 1
        running.kill()
        running.wait()
        if Path(OUTPUT).exists():
            break
        if is_unfinished(Path(OUTPUT)):
            arguments = ["resume", OUTPUT]
    if not Path(OUTPUT).exists():
        last = begun(draw.randint(1, MOST), *arguments)
        _, said = last.communicate(timeout=120)
        if last.returncode:
            return [f"{kind}: {said.decode()}"], longest, kills
    wrong = differences(expected, Path(OUTPUT))
    wrong += debris(folder, expected.name, OUTPUT, PIDS, "kept.nc")
    return [f"{kind}: {one}" for one in wrong], longest, kills


def main() -> None:
    """Run the requested number of trials; or be one of the processes of a run."""
    if "--program" in sys.argv:
        (Path(PIDS) / str(os.getpid())).touch()
        often()
        program(sys.argv[sys.argv.index("--program") + 1 :])
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    wrong, longest, kills = 0, 0.0, 0
    for number in range(asked.trials):
        with tempfile.TemporaryDirectory() as name:
            draw = random.Random(f"{asked.seed} {number}")
            found, seconds, some = tried(draw, Path(name) / "trial")
            os.chdir("/")
        wrong, longest, kills = wrong + bool(found), max(longest, seconds), kills + some
        if found:
            print(f"number {number}: {'; '.join(found)}", file=sys.stderr, flush=True)
    row(
        f"{kills} kills in {asked.trials} runs of 2 to {MOST} processes: results that differ",
        f"{wrong}",
    )
    row("longest until all processes had ended", f"{longest:.1f} s")
    sys.exit(bool(wrong) or longest > PATIENCE_S)


if __name__ == "__main__":
    main()
