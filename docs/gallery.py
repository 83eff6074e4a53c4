"""Sphinx extension that writes the gallery: a page with picture, movie and file for each shipped
experiment.

`-D gallery_run=0` writes the pages without running the experiments.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray
from matplotlib.figure import Figure
from sheet import Sheet
from sphinx.application import Sphinx
from sphinx.util.display import status_iterator

import pbdkit
from pbdkit.model.shipped import shipped_data, shipped_names, shipped_text, shipped_title

FOLDER = Path(__file__).parent / "gallery"
"""Folder of the pages; it is rewritten by each build."""
MOVIES = Path(__file__).parent.parent / "build" / "movies"
"""Folder of the movies, copied to `_static`."""
FIGSIZE = (5.0, 3.4)
"""Size of pictures and movies in inches."""
DPI = 150
"""Resolution of pictures in dots per inch."""
MOVIE_DPI = 100
"""Resolution of movies in dots per inch."""
FRAMES = 30
"""Maximum number of frames of a movie."""
FPS = 12
"""Frame rate of movies in 1/s."""
MARGIN = 12
"""Margin of thumbnails in pixels."""
WHITE = 250
"""Smallest brightness of the background of pictures."""
COLORS = {
    "pe1-intact": "pe1_intact",
    "pe1": "pe1",
    "stress": "stress_xx",
    "displacement": "u",
    "broken": "broken_step",
}
"""Variables for the colours of a picture, by the diagnostic that computes them, best first."""
FIELDS = ("stress", "strain", "u")
"""First letters of variables that are drawn as fields."""
END_OF_PULL = 10
"""Last step in which the leaders of the paper's cases move."""
GROUPS = {
    "": "To start with",
    "material": "Calibrated materials",
    "modelling": "Loads, supports, contact and fracture",
    "fracture": "Crack tips and the load past its peak",
    "stability": "Oscillation",
    "paper": "The paper's cases",
}
INDEX = """---
html_theme.sidebar_secondary.remove: true
---
# Gallery

Every shipped experiment with its picture, its movie and its file. `pbdkit run NAME` runs one, and
`pbdkit init --from NAME` copies its file. The movies of the paper's cases
show early steps at shorter intervals.
"""
SHEET = """
All experiments on one page for print: {download}`experiments.pdf`.
"""
PAGE = """---
html_theme.sidebar_secondary.remove: true
---
# {title}

{text}

:::::{{grid}} 1 1 2 2
:gutter: 3

::::{{grid-item}}
{picture}
::::
::::{{grid-item}}
```{{literalinclude}} {stem}.yaml
:language: yaml
:lines: {first}-
```
Download {downloads}
::::
:::::

The experiment is shipped under the name `{name}`. On the command line and in Python:

```console
$ pbdkit run {name}
$ pbdkit plot {stem}.nc{options}
```

```python
import pbdkit

ds = pbdkit.run("{name}", progress=False)
ds.pbd.plot({arguments})
```
"""
VIDEO = """
```{{raw}} html
<video src="../_static/{stem}.mp4" autoplay loop muted playsinline controls
  style="max-width: 100%" aria-label="{title}, step by step"></video>
```
"""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the option and the writer of the pages."""
    MOVIES.mkdir(parents=True, exist_ok=True)
    app.add_config_value("gallery_run", True, "env", bool)
    app.connect("builder-inited", write_gallery)
    return {"parallel_read_safe": True}


def write_gallery(app: Sphinx) -> None:
    """Write the pages, their files, pictures and movies."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    entries = [Entry.read(name) for name in shipped_names()]
    names, sheet = attrgetter("name"), Sheet(len(entries))
    for entry in status_iterator(entries, "gallery... ", length=len(entries), stringify_func=names):
        for file in shipped_data(entry.name):
            shutil.copy(file, FOLDER)
        (FOLDER / f"{entry.stem}.yaml").write_text(entry.source, "utf-8")
        if app.config.gallery_run:
            entry.draw(sheet)
        (FOLDER / f"{entry.stem}.md").write_text(entry.page(drawn=app.config.gallery_run), "utf-8")
    if app.config.gallery_run:
        sheet.save(FOLDER / "experiments.pdf", FOLDER / "experiments.png")
    index = "\n".join(index_lines(entries, drawn=app.config.gallery_run))
    (FOLDER / "index.md").write_text(index, "utf-8")


def index_lines(entries: list[Entry], *, drawn: bool) -> Iterator[str]:
    """Yield the lines of the index: a card with a thumbnail for each experiment."""
    yield INDEX
    if drawn:
        yield SHEET
    for group, heading in GROUPS.items():
        members = [entry for entry in entries if entry.group == group]
        yield f"## {heading}\n\n::::{{grid}} 2 3 3 4\n:gutter: 3\n"
        for entry in members:
            image = f":img-top: {entry.stem}-thumbnail.png\n" if drawn else ""
            yield (
                f":::{{grid-item-card}}\n:link: {entry.stem}\n:link-type: doc\n"
                f":class-img-top: gallery-thumbnail\n{image}\n{entry.title}\n:::"
            )
        stems = "\n".join(f"{entry.title} <{entry.stem}>" for entry in members)
        yield f"::::\n\n```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{stems}\n```\n"


@dataclass(frozen=True)
class Entry:
    """A shipped experiment and the options of its picture.

    The options are those of the `pbdkit plot` command in the comment at the head of its file; by
    default the colours show a variable that the experiment records.
    """

    name: str
    source: str
    text: str
    options: tuple[str, ...]

    @classmethod
    def read(cls, name: str) -> Entry:
        """Read a shipped experiment."""
        source = shipped_text(name)
        comment = re.match(r"(?:#.*\n)+", source)
        text = re.sub(r"^# ?", "", comment[0], flags=re.M) if comment else ""
        command = re.search(r"`pbdkit plot([^`]*)`", text)
        options = shlex.split(command[1]) if command else []
        options = options[1:] if options and options[0].endswith(".nc") else options
        if "--color" not in options and (color := default_color(source)):
            options += ["--color", color]
        if options[options.index("--color") + 1].startswith(FIELDS) and "--contours" not in options:
            options += ["--field"]
        if "--time" not in options and name.startswith("paper/") and "record:" not in source:
            options += ["--time", str(END_OF_PULL)]
        return cls(name, source, text, tuple(options))

    @property
    def group(self) -> str:
        """The folder of the file."""
        return self.name.rpartition("/")[0]

    @property
    def stem(self) -> str:
        """The name as that of a file."""
        return self.name.replace("/", "-")

    @property
    def title(self) -> str:
        """The first sentence of the comment."""
        return shipped_title(self.name).removesuffix(".")

    @property
    def arguments(self) -> dict[str, Any]:
        """The options as arguments of `ds.pbd.plot`."""
        pairs = [*pairwise((*self.options, ""))]
        times = [int(value) for key, value in pairs if key == "--time"]
        arguments: dict[str, Any] = {key[2:]: value for key, value in pairs if key == "--color"}
        arguments |= {"contours": True} if "--contours" in self.options else {}
        arguments |= {"filled": True} if "--field" in self.options else {}
        return arguments | ({"time": times if len(times) > 1 else times[0]} if times else {})

    @property
    def shown(self) -> tuple[str, float | None]:
        """Return the variable and the step of the thumbnail."""
        times = self.arguments.get("time")
        time = times[len(times) // 2] if isinstance(times, list) else times
        return self.arguments["color"], time

    def page(self, *, drawn: bool) -> str:
        """Return the Markdown of the page."""
        text = re.sub(r"\A.*?\.(?=\s)", "", self.text, count=1, flags=re.S).partition("\n\n")[0]
        text = re.sub(r"docs/(\S+\.md)", r"[](../\1)", text)
        files = [f"{self.stem}.yaml", *(file.name for file in shipped_data(self.name))]
        picture = f"![{self.title}]({self.stem}.png)\n" if drawn else ""
        if drawn and self.has_movie:
            picture += VIDEO.format(stem=self.stem, title=self.title)
        return PAGE.format(
            title=self.title,
            text=text.strip(),
            picture=picture,
            stem=self.stem,
            name=self.name,
            first=self.source.count("\n", 0, self.source.index("version:")) + 1,
            downloads=", ".join(f"{{download}}`{file}`" for file in files),
            options="".join(f" {shlex.quote(word)}" for word in self.options),
            arguments=", ".join(
                f"{key}={value!r}".replace("'", '"') for key, value in self.arguments.items()
            ),
        )

    @property
    def has_movie(self) -> bool:
        """True if the experiment makes steps, rather than one equilibrium."""
        return "solver: {type: equilibrium" not in self.source

    def draw(self, sheet: Sheet) -> None:
        """Run the experiment, write picture, thumbnail and movie, and add it to a sheet."""
        dataset = pbdkit.run(self.name, progress=False)
        sheet.add(self.name, dataset, *self.shown)
        times = self.arguments.get("time")
        several = isinstance(times, list)
        size = {} if several else {"figsize": FIGSIZE}
        dataset.pbd.plot(**self.arguments, **size, dpi=DPI)
        figure = plt.gcf()
        figure.savefig(FOLDER / f"{self.stem}.png")
        middle = figure.axes[len(times) // 2 if several else 0]
        plt.imsave(FOLDER / f"{self.stem}-thumbnail.png", thumbnail(figure, middle))
        plt.close(figure)
        if self.has_movie:
            shown = {key: value for key, value in self.arguments.items() if key != "time"}
            dataset.isel(time=self.frames(dataset)).pbd.animate(
                **shown, file=MOVIES / f"{self.stem}.mp4", fps=FPS, figsize=FIGSIZE, dpi=MOVIE_DPI
            )

    def frames(self, dataset: xarray.Dataset) -> list[int]:
        """Return the recorded steps of the movie.

        Early steps have smaller intervals in the paper's cases, in which the leaders move for ten
        of several hundred steps.
        """
        last = dataset.sizes["time"] - 1
        shares = np.linspace(0.0, 1.0, min(FRAMES, last + 1))
        exponent = 2.0 if self.group == "paper" and last > FRAMES else 1.0
        return np.unique((shares**exponent * last).round().astype(int)).tolist()


def default_color(source: str) -> str:
    """Return the variable of the first suitable diagnostic of an experiment."""
    diagnostics = re.findall(r"type: ([\w-]+)", source.partition("diagnostics:")[2])
    return next((COLORS[name] for name in COLORS if name in diagnostics), "")


def thumbnail(figure: Figure, ax: Any) -> np.ndarray[Any, Any]:
    """Return the pixels of a panel, cropped to the body."""
    canvas: Any = figure.canvas
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    box, height = ax.get_window_extent(), pixels.shape[0]
    inset = round(2 * mpl.rcParams["axes.linewidth"] * figure.dpi / 72)
    rows = slice(round(height - box.y1) + inset, round(height - box.y0) - inset)
    panel = pixels[rows, round(box.x0) + inset : round(box.x1) - inset]
    dark = (panel < WHITE).any(axis=2)
    (top, bottom), (left, right) = ((d.nonzero()[0][[0, -1]]) for d in (dark.any(1), dark.any(0)))
    body = panel[top : bottom + 1, left : right + 1]
    return np.pad(body, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), constant_values=255)
