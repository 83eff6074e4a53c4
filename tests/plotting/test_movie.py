"""Movies: every recorded step is there, on one scale, in even numbers of pixels, or nothing is."""

import re
import subprocess

import numpy as np
import pytest

import pbdkit
from pbdkit import ExperimentError, StorageError

pytest.importorskip("imageio_ffmpeg")
pytest.importorskip("matplotlib")

import imageio_ffmpeg
from PIL import Image

from pbdkit.plotting.data import Trajectory
from pbdkit.plotting.movie import MovieFigure
from pbdkit.plotting.style import PlotOptions

SMALL = {"figsize": (3.01, 2.47), "dpi": 61}
"""A picture with an odd number of pixels either way is written in its own size."""


@pytest.fixture(scope="module")
def torn():
    return pbdkit.run(pbdkit.load("paper/f2", settings=["steps=24"]), progress=False)


def frames_of(path):
    """Return all frames of a movie: (frame, row, column, red green blue)."""
    if path.suffix == ".gif":
        with Image.open(path) as moving:
            found = []
            for n in range(moving.n_frames):
                moving.seek(n)
                found.append(np.asarray(moving.convert("RGB")))
            return np.stack(found)
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(path)]
    decoded = subprocess.run(
        [*ffmpeg, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    width, height = map(int, re.search(rb"Video: .*?, (\d+)x(\d+)", decoded.stderr).groups())
    return np.frombuffer(decoded.stdout, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_every_recorded_step_has_a_frame(torn, tmp_path, suffix):
    shares, path = [], tmp_path / f"torn{suffix}"
    torn.pbd.animate("pe1_intact", path, show=lambda what, share: shares.append(share), **SMALL)
    frames = frames_of(path).astype(int)
    assert frames.shape == (25, 152, 184, 3)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert shares[-1] == 1.0
    changes = np.abs(np.diff(frames, axis=0)).max(axis=(1, 2, 3))
    assert changes.min() > 40  # the number of the step, at least
    same = np.ptp(frames, axis=0).max(axis=2) < 60
    assert same.mean() > 0.5  # axes, labels and the scale stay
    assert same[:, :14].all()
    assert np.median(frames) > 235  # on a white page


def test_frame_equals_the_plot_of_its_step(torn):
    recording = Trajectory(torn, "pe1_intact")
    moving = MovieFigure(recording, range(25), PlotOptions(**SMALL), lambda what, share: None)
    frames = [*moving.frames(range(25))]
    assert moving.sheet.axes[0].get_title().endswith("step 24")
    again = next(iter(moving.frames([7])))
    np.testing.assert_array_equal(again, frames[7])
    low, high = moving.sheet.axes[0].collections[-1].get_clim()
    assert (low, high) == (0.0, pytest.approx(float(torn.pe1_intact.max())))


def test_selected_steps_always_include_the_last(torn, tmp_path):
    torn.pbd.animate(file=tmp_path / "some.gif", every=10, **SMALL)
    assert len(frames_of(tmp_path / "some.gif")) == 4  # 0, 10, 20 and 24


@pytest.mark.parametrize(
    ("name", "look", "message"),
    [
        ("torn.avi", {}, "torn.avi: the name of a movie must end in .mp4 or .gif"),
        ("torn.gif", {"fps": 100.0}, "fps: 100 is not between 0.1 and 50"),
        ("torn.gif", {"every": 0}, "every: 0 is below 1; 1 shows all recorded steps"),
        ("torn.mp4", {"color": "pe3"}, "'pe3' cannot be drawn; did you mean"),
    ],
)
def test_data_without_a_movie_are_refused(torn, name, look, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ExperimentError) as refused:
        torn.pbd.animate(file=name, **look)
    assert message in str(refused.value)
    assert [*tmp_path.iterdir()] == []


def test_missing_package_is_named_with_its_extra(torn, tmp_path, monkeypatch):
    monkeypatch.setattr("pbdkit.errors.find_spec", lambda name: None)
    for name, missing in {"torn.mp4": "imageio-ffmpeg", "torn.gif": "pillow"}.items():
        with pytest.raises(ExperimentError) as refused:
            torn.pbd.animate(file=tmp_path / name)
        assert f"require {missing}: pip install 'pbdkit[movie]'" in str(refused.value)


def test_failed_movie_leaves_no_file(torn, tmp_path, monkeypatch):
    with pytest.raises(StorageError, match="there is no folder"):
        torn.pbd.animate(file=tmp_path / "none" / "torn.gif", **SMALL)
    shown = []

    def stop(what, share):
        shown.append(share)
        if what == "the movie" and share > 0.5:
            raise KeyboardInterrupt

    path = tmp_path / "torn.mp4"
    path.write_text("mine")
    with pytest.raises(KeyboardInterrupt):
        torn.pbd.animate(file=path, show=stop, **SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["torn.mp4"]
    assert path.read_text() == "mine"


def test_command_makes_movies_and_overwrites_none(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("run", "paper/f2", "--set", "steps=9", "-o", "f2.nc").code == 0
    look = ["--size", "3", "2", "--dpi", "60", "--color", "pe1", "--contours"]
    done = call("animate", "f2.nc", *look)
    assert (done.code, done.out) == (0, "f2.mp4 written\n")
    assert len(frames_of(tmp_path / "f2.mp4")) == 10
    again = call("animate", "f2.nc", *look)
    assert (again.code, "f2.mp4: exists; --force replaces it" in again.err) == (2, True)
    assert call("animate", "f2.nc", "-o", "f2.gif", "--force", *look).code == 0
    wrong = call("animate", "f2.nc", "-o", "f2.png")
    assert (wrong.code, "the name of a movie must end in .mp4 or .gif" in wrong.err) == (2, True)


def test_notebooks_show_an_animation_of_at_most_sixty_steps(torn):
    from matplotlib.animation import FuncAnimation

    many = torn.isel(time=np.repeat(np.arange(25), 3)).assign_coords(time=np.arange(75))
    moving = many.pbd.animation("pe1_intact", figsize=(3, 2), dpi=40)
    assert isinstance(moving, FuncAnimation)
    assert len([*moving.new_frame_seq()]) == 60
    moving._draw_was_started = True  # matplotlib warns of an animation that is not drawn
    few = torn.isel(time=slice(4)).pbd.animation("pe1_intact", figsize=(3, 2), dpi=40)
    assert few.to_jshtml().count("data:image/png") == 4
