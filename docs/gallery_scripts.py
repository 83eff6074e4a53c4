"""Write the scripts of the gallery: a page with picture, movie and file for each experiment."""

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

FIGSIZE = (5.0, 3.4)
"""Size of pictures in inches: their labels remain legible in thumbnails."""
COLORS = {"pe1-intact": "pe1_intact", "pe1": "pe1", "stress": "stress_xx", "displacement": "u"}
"""Variables for the colours of a picture, by the diagnostic that computes them, best first."""
END_OF_PULL = 10
"""Last step in which the leaders of the paper's cases move."""
GROUPS = {
    "paper": "The paper's cases",
    "material": "Calibrated materials",
    "modelling": "What researchers model",
    "stability": "Stability",
    "": "To start with",
}
SCRIPT = '''"""
{title}
{line}

``{name}``. {text}
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
    """Write a folder for each group and a script for each experiment."""
    for name in shipped_names():
        group, _, short = name.rpartition("/")
        place = folder / (group or "start")
        place.mkdir(parents=True, exist_ok=True)
        title = GROUPS[group]
        (place / "GALLERY_HEADER.rst").write_text(f"{title}\n{'=' * len(title)}\n")
        (place / f"plot_{short.replace('-', '_')}.py").write_text(script_of(name))
    (folder / "GALLERY_HEADER.rst").write_text(
        "Gallery\n=======\n\nEvery shipped experiment with its picture, its movie and its file. "
        "``pbdkit init --from paper/a`` copies a file; each page offers its script for download.\n"
    )


def script_of(name: str) -> str:
    """Return the script of one experiment.

    The picture is that of the `pbdkit plot` command in the comment at its head, otherwise a
    variable that the experiment records.
    """
    source = shipped_text(name)
    comment = re.match(r"(?:#.*\n)+", source)
    text = re.sub(r"^# ?", "", comment[0], flags=re.M) if comment else ""
    color, times = plot_options(text)
    color = color or default_color(source)
    if not times and name.startswith("paper/") and "record:" not in source:
        times = [END_OF_PULL]
    options = ([f'color="{color}"'] if color else []) + ([f"time={times}"] if times else [])
    options += [f"figsize={FIGSIZE}"] if len(times) < 2 else []
    steps = "solver: {type: equilibrium" not in source
    title = title_of(text) or name
    return SCRIPT.format(
        title=title,
        name=name,
        line="=" * len(title),
        text=text.replace("`", "``"),
        draw=f"ds.pbd.plot({', '.join(options)})",
        movie=MOVIE.format(color=f'color="{color}"' if color else "") if steps else "",
        file=textwrap.indent(source, "#     ", lambda _: True).rstrip(),
    )


def title_of(text: str) -> str:
    """Return the first clause of a comment."""
    return re.split(r"[.:](?:\s|$)", " ".join(text.split()), maxsplit=1)[0]


def default_color(source: str) -> str:
    """Return the variable of the first suitable diagnostic of an experiment."""
    diagnostics = re.findall(r"type: ([\w-]+)", source.partition("diagnostics:")[2])
    return next((COLORS[name] for name in COLORS if name in diagnostics), "")


def with_ffmpeg(gallery_conf: dict[str, Any], script: str) -> None:
    """Set the encoder of movies, since matplotlib's settings are reset for each script."""
    mpl.rcParams["animation.ffmpeg_path"] = get_ffmpeg_exe()


def plot_options(text: str) -> tuple[str, list[int]]:
    """Return the colour and the times of the `pbdkit plot` command in a comment."""
    command = re.search(r"`(pbdkit plot[^`]*)`", text)
    words = shlex.split(command[1]) if command else []
    options = list(pairwise(words))
    color = next((value for key, value in options if key == "--color"), "")
    return color, [int(value) for key, value in options if key == "--time"]
