"""Writes the gallery's scripts: of each shipped experiment what it is, its picture, movie, file."""

from __future__ import annotations

import re
import shlex
import textwrap
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
from imageio_ffmpeg import get_ffmpeg_exe

from pbdkit.model.shipped import shipped_names, shipped_text

GROUPS = {
    "paper": "The paper's cases",
    "material": "Calibrated materials",
    "modelling": "What researchers model",
    "stability": "Stability",
    "": "To start with",
}
SCRIPT = '''"""
{name}
{line}

{text}
"""

import pbdkit

ds = pbdkit.run("{name}", progress=False)
{draw}
{movie}
# %%
# The file, `pbdkit run {name}`:
#
# .. code-block:: yaml
#
{file}
'''
MOVIE = """
# %%
# Step by step:
moving = ds.pbd.animation({color})
"""


def write_scripts(folder: Path) -> None:
    """A folder a group, a script an experiment."""
    for name in shipped_names():
        group, _, short = name.rpartition("/")
        place = folder / (group or "start")
        place.mkdir(parents=True, exist_ok=True)
        title = GROUPS[group]
        (place / "GALLERY_HEADER.rst").write_text(f"{title}\n{'=' * len(title)}\n")
        (place / f"plot_{short.replace('-', '_')}.py").write_text(script_of(name))
    (folder / "GALLERY_HEADER.rst").write_text(
        "Gallery\n=======\n\nEvery experiment that is shipped: its picture, its movie, its file. "
        "`pbdkit experiments` lists them, `pbdkit init --from paper/a` copies one.\n"
    )


def script_of(name: str) -> str:
    """What draws one of them. Where its comment names a command that draws it, that is drawn."""
    given = shipped_text(name)
    comment = re.match(r"(?:#.*\n)+", given)
    text = re.sub(r"^# ?", "", comment[0], flags=re.M) if comment else ""
    color, times = asked(text)
    options = ([f'color="{color}"'] if color else []) + ([f"time={times}"] if times else [])
    records = "solver: {type: equilibrium" not in given
    return SCRIPT.format(
        name=name,
        line="=" * len(name),
        text=text.replace("`", "``"),
        draw=f"ds.pbd.plot({', '.join(options)})",
        movie=MOVIE.format(color=f'color="{color}"' if color else "") if records else "",
        file=textwrap.indent(given, "#     ", lambda _: True).rstrip(),
    )


def with_ffmpeg(gallery_conf: dict[str, Any], script: str) -> None:
    """Tells matplotlib, whose settings are new for each script, what codes movies."""
    mpl.rcParams["animation.ffmpeg_path"] = get_ffmpeg_exe()


def asked(text: str) -> tuple[str, list[int]]:
    """The colour and the times of the command in a comment."""
    command = re.search(r"`(pbdkit plot[^`]*)`", text)
    words = shlex.split(command[1]) if command else []
    options = list(pairwise(words))
    color = next((value for key, value in options if key == "--color"), "")
    return color, [int(value) for key, value in options if key == "--time"]
