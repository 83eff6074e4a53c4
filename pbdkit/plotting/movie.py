"""Movies of a dataset: all recorded steps with the same limits and colours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from pbdkit.errors import (
    ExperimentError,
    StorageError,
    one_line,
    refuse_no_matplotlib,
    refuse_without,
)
from pbdkit.io.atomic_file import NewFile, encoding, open_atomic
from pbdkit.io.layout import as_step
from pbdkit.plotting.data import Extent, Snapshot, Trajectory, extent_of
from pbdkit.plotting.style import PlotKeywords, PlotOptions, takes_options

if TYPE_CHECKING:
    import xarray
    from matplotlib.animation import FuncAnimation

    from pbdkit.plotting.configuration import PanelFigure


Show = Callable[[str, float], None]
Frame = NDArray[np.uint8]
"""Pixels of shape (row, column, colour) with the colours red, green and blue."""
FORMATS = (".mp4", ".gif")
"""File name extensions of movies."""
WRITERS = {"imageio_ffmpeg": "imageio-ffmpeg", "PIL": "pillow"}
"""Distributions of the modules that write movies."""
DPI = 120
"""Resolution of a movie."""
NOTEBOOK_DPI = 80
"""Resolution of an animation for notebooks."""
MAX_GIF_COLOURS = 128
"""Maximum number of colours of a GIF."""
MIN_FRAME_RATE = 0.1
"""Minimum frame rate in 1/s."""
MAX_FRAME_RATE = 240
"""Maximum frame rate in 1/s."""
MAX_GIF_FRAME_RATE = 50
"""Maximum frame rate of a GIF in 1/s."""
FIELD_RESOLUTION = 0.6
"""Number of pixels of a field per pixel of the movie, along each axis; fields are interpolated."""
NEARLY_WHITE = 240
"""Brightness above which a colour of a palette counts as white."""
MAX_NOTEBOOK_FRAMES = 60
"""Maximum number of steps in an animation for notebooks."""


def silent(what: str, share: float) -> None:
    """Ignore the progress of a movie."""


@takes_options("numbers", dpi=DPI)
def animate(
    dataset: xarray.Dataset,
    color: str | None = None,
    file: str | Path | None = None,
    *,
    fps: float = 25.0,
    every: int = 1,
    show: Show | None = None,
    replace: bool = True,
    **options: Unpack[PlotKeywords],
) -> None:
    """Write a movie of the recorded steps, with one scale of colours for the whole run.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of one run.
    color : str, optional
        Variable of particles or bonds, as for `plot`.
    file : str or path
        MP4 or GIF file, by its extension. An incomplete file never appears.
    fps : float
        Recorded steps per second.
    every : int
        Draw every n-th recorded step only, and the last.
    show : callable, optional
        Function that is called with a text and the completed fraction, from 0 to 1.
    replace : bool
        Replace an existing file.
    {options}

    Raises
    ------
    ExperimentError
        As for `plot`, and if the library that writes movies is missing.
    StorageError
        If the file cannot be written.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> ds.pbd.animate("pe1", "a.gif", every=10, dpi=40)
    """
    path = _movie_file(color, file)
    refuse_no_movie(path)
    _refuse_speed(path, fps, every)
    look = PlotOptions(**options)
    recording = Trajectory(dataset, color or "kind")
    show = show or silent
    rows = [*range(0, len(recording.steps), every)]
    rows += [] if rows[-1] == len(recording.steps) - 1 else [len(recording.steps) - 1]
    moving = MovieFigure(recording, rows, look, show)
    frames = moving.frames(rows, show)
    with open_atomic(path, NewFile, replace=replace) as new:
        if path.suffix == ".gif":
            few = moving.frames(rows[:: max(1, len(rows) // 4)])
            with encoding(path):
                _write_gif(new, np.concatenate([*few]), frames, fps)
        else:
            _write_mp4(new, frames, fps)


def _refuse_speed(path: Path, fps: float, every: int) -> None:
    """Raise ExperimentError for a frame rate or step interval outside the supported range."""
    fastest = MAX_GIF_FRAME_RATE if path.suffix == ".gif" else MAX_FRAME_RATE
    if not MIN_FRAME_RATE <= fps <= fastest:
        raise ExperimentError(f"fps: {fps:g} is not between {MIN_FRAME_RATE:g} and {fastest}")
    if every < 1:
        raise ExperimentError(f"every: {every} is below 1; 1 shows all recorded steps")


def _movie_file(color: str | None, file: str | Path | None) -> Path:
    """Return the path of the movie. Raises ExperimentError if the path is missing or was passed as
    the variable."""
    if file is not None and Path(str(color)).suffix not in FORMATS:
        return Path(file)
    if isinstance(color, str | Path) and Path(color).suffix in FORMATS:
        variable = f"{str(file)!r}, " if file is not None else ""
        raise ExperimentError(
            f"animate: the first argument is the variable, but '{color}' is a file; write "
            f"animate({variable}file={str(color)!r})"
        )
    named = f"{color!r}, " if color is not None else ""
    raise ExperimentError(
        f"animate: expected a file; write animate({named}file='movie.mp4'), or in a notebook "
        f"animation({named.rstrip(', ')})"
    )


@takes_options("numbers", dpi=NOTEBOOK_DPI)
def animation(
    dataset: xarray.Dataset,
    color: str | None = None,
    **options: Unpack[PlotKeywords],
) -> FuncAnimation:
    """Return an animation of matplotlib, for notebooks.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of one run. At most 60 of its recorded steps are drawn, evenly spaced.
    color : str, optional
        Variable of particles or bonds, as for `plot`.
    {options}

    Returns
    -------
    matplotlib.animation.FuncAnimation
        Animation; a notebook displays ``HTML(animation.to_jshtml())``.

    Raises
    ------
    ExperimentError
        As for `plot`.
    """
    refuse_no_matplotlib()
    from matplotlib.animation import FuncAnimation

    look = PlotOptions(**options)
    recording = Trajectory(dataset, color or "kind")
    last = len(recording.steps) - 1
    rows = np.unique(
        np.linspace(0, last, min(MAX_NOTEBOOK_FRAMES, last + 1)).round().astype(int)
    ).tolist()
    moving = MovieFigure(recording, rows, look, silent, standalone=False)
    snapshots = [*recording.snapshots(rows)]
    return FuncAnimation(
        moving.sheet.figure, lambda n: moving.put(snapshots[n]), frames=len(snapshots), interval=80,
        blit=False,
    )  # fmt: skip


def refuse_no_movie(path: Path) -> None:
    """Raise ExperimentError if the suffix is not the suffix of a movie, or if the library that
    writes such movies is not installed. Raise StorageError if the folder does not exist."""
    if path.suffix not in FORMATS:
        raise ExperimentError(f"{path}: the name of a movie must end in {' or '.join(FORMATS)}")
    writer = "imageio_ffmpeg" if path.suffix == ".mp4" else "PIL"
    for module, name in ((writer, WRITERS[writer]), ("matplotlib", "matplotlib")):
        refuse_without(module, "movie", f"movies require {name}")
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")


class MovieFigure:
    """A sheet with one panel. Its background is drawn once, and its layers show one step after the
    other."""

    def __init__(
        self,
        recording: Trajectory,
        rows: Sequence[int],
        look: PlotOptions,
        show: Show,
        *,
        standalone: bool = True,
    ) -> None:
        from pbdkit.plotting.configuration import PanelFigure

        self._recording, self._name = recording, recording.title
        looked_at = _with_progress(
            recording.snapshots(rows), len(rows), "the scale of colours", show
        )
        extent: Extent = extent_of(recording, looked_at, look)
        title = self._title(as_step(recording.steps[-1]))
        self.sheet: PanelFigure = PanelFigure(
            [recording], [title], "", extent, look, finer=FIELD_RESOLUTION, standalone=standalone
        )
        (self._panel,) = self.sheet.panels
        self._heading = self._panel.ax.title
        if self._panel.is_shortened:
            self._name = ""

    def _title(self, step: float) -> str:
        return f"{self._name}, step {step}".lstrip(", ")

    def put(self, snapshot: Snapshot) -> list[Any]:
        """Show a step, and return the changed artists."""
        self._panel.show(snapshot, self._title(snapshot.step))
        return [*self._panel.artists, self._heading]

    def frames(self, rows: Sequence[int], show: Show = silent) -> Iterator[Frame]:
        """Generate the pixels of each step. The numbers of rows and of columns are even."""
        figure = self.sheet.figure
        pixels = np.ceil(figure.get_size_inches() * figure.dpi / 2 - 1e-9) * 2
        figure.set_size_inches(*(pixels / figure.dpi))
        canvas: Any = figure.canvas
        moving = [*self._panel.artists, self._heading]
        for artist in moving:
            artist.set_animated(True)
        canvas.draw()
        background = canvas.copy_from_bbox(figure.bbox)
        for snapshot in _with_progress(
            self._recording.snapshots(rows), len(rows), "the movie", show
        ):
            canvas.restore_region(background)
            for artist in sorted(self.put(snapshot), key=lambda a: a.get_zorder()):
                figure.draw_artist(artist)
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _with_progress(
    snapshots: Iterator[Snapshot], count: int, task: str, show: Show
) -> Iterator[Snapshot]:
    for n, snapshot in enumerate(snapshots):
        yield snapshot
        show(task, (n + 1) / count)


def _write_mp4(file: NewFile, frames: Iterator[Frame], fps: float) -> None:
    """Encode the frames with ffmpeg, in a separate process. All players support the format of the
    file."""
    from imageio_ffmpeg import get_ffmpeg_exe

    first = next(frames)
    height, width, _ = first.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}"]
    codec = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-preset", "veryfast"]
    command = [get_ffmpeg_exe(), "-y", "-v", "error", *source, "-i", "-", *codec,
               "-movflags", "+faststart", "-f", "mp4", str(file.disk.name)]  # fmt: skip
    with TemporaryFile() as log:
        with Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=log) as ffmpeg:
            assert ffmpeg.stdin is not None
            try:
                with suppress(BrokenPipeError), ffmpeg.stdin as pipe:
                    for frame in chain([first], frames):
                        pipe.write(frame.tobytes())
            # After an interrupt, `with` alone would not wait for the end of the process.
            except BaseException:
                ffmpeg.kill()
                ffmpeg.wait()
                raise
        log.seek(0)
        fault = one_line(log.read().decode(errors="replace"))
        if fault or ffmpeg.returncode:
            file.fail(OSError(0, fault or f"ffmpeg ended with status {ffmpeg.returncode}"))


def _write_gif(file: NewFile, few: Frame, frames: Iterator[Frame], fps: float) -> None:
    """Write the frames with one palette, so that parts that do not change do not flicker. The
    palette is determined from `few`, a picture that contains several frames."""
    from PIL import Image

    palette = Image.fromarray(few).quantize(MAX_GIF_COLOURS, Image.Quantize.MAXCOVERAGE)
    colours = np.reshape(palette.getpalette() or [], (-1, 3))
    colours[colours.min(axis=1) > NEARLY_WHITE] = 255  # The background remains white.
    palette.putpalette(colours.astype(np.uint8).tobytes())
    target: Any = file  # Pillow needs no other methods of the file.
    drawn = (Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames)
    next(drawn).save(
        target, "GIF", save_all=True, append_images=drawn, duration=round(1000 / fps), loop=0,
        optimize=False,
    )  # fmt: skip
