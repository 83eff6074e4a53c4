"""Scales of colours: linear and others, for all steps or for each of them; and principal values as
colours."""

import numpy as np
import pytest

import pbdkit
from pbdkit import ExperimentError

pytest.importorskip("matplotlib")

from matplotlib.colors import BoundaryNorm

from pbdkit.plotting.colours import scale_of, scale_within
from pbdkit.plotting.data import PlottedQuantity
from pbdkit.plotting.style import PlotOptions


def quantity(*, whole=False):
    return PlottedQuantity("stress_xx", "particle", "stress", 1.0, "MPa", False, None, {}, whole)


RANGES = [(0.0, 4.0), (2.0, 4.0), (-3.0, 0.0), (-1.0, 250.0), (3.0, 3.0), (0.0, 0.0), (-2e-7, 1e-9)]


@pytest.mark.parametrize("contours", [False, True])
@pytest.mark.parametrize("norm", ["linear", "log", "sqrt", "symlog"])
@pytest.mark.parametrize("values", RANGES, ids=str)
def test_every_value_has_a_colour_within_the_limits(values, norm, contours):
    """Levels include both extremes, and also what interpolation puts slightly below the lowest."""
    look = PlotOptions(norm=norm, contours=contours)
    if norm == "log" and (values[0] < 0.0 or values[1] <= 0.0):
        if values[0] < 0.0:
            with pytest.raises(ExperimentError, match="use the scale symlog or sqrt"):
                scale_of(quantity(), values, look, True)
        return
    scale = scale_of(quantity(), values, look, True)
    assert scale.low < scale.high
    assert scale.high >= values[1]
    assert norm == "log" or scale.low <= values[0]
    slack = 1e-9 * (scale.high - scale.low)
    inner = np.linspace(values[0] - slack, values[1] + slack, 101)
    colours = scale.colours(scale.norm(inner))
    assert (colours[:, 3] == 1.0).all()
    at = np.asarray(scale.norm(inner), float)
    assert (np.diff(at) >= 0.0).all()
    if contours:
        assert isinstance(scale.norm, BoundaryNorm)
        assert len(scale.norm.boundaries) <= 30
    if values[0] < 0.0 < values[1]:
        assert scale.low == -scale.high
        neutral = scale.colours(scale.norm(np.array([0.0])))[0, :3]
        assert contours or np.ptp(neutral) < 0.03


def test_zero_is_neutral_between_unequal_limits():
    for norm in ("linear", "sqrt", "symlog"):
        look = PlotOptions(vmin=-1.0, vmax=9.0, norm=norm)
        scale = scale_of(quantity(), (-4.0, 20.0), look, True)
        assert np.ptp(scale.colours(float(scale.norm(0.0)))[:3]) < 0.05
        assert scale.extend == "both"


def test_a_single_integer_has_one_colour_and_one_tick():
    ds = pbdkit.run("paper/f2", settings={"steps": 6}, progress=False)
    first = int(ds.broken_step.where(ds.broken_step > 0).min())
    ax = ds.pbd.plot("broken_step", time=first)
    bar = ax.figure.axes[-1]
    low, high = bar.get_ylim()
    assert [t for t in bar.get_yticks() if low <= t <= high] == [first]
    ticks = ds.pbd.plot("broken_step", time=6).figure.axes[-1].get_yticks()
    assert (np.mod(ticks, 1.0) == 0.0).all()


def test_each_step_has_its_own_limits_and_states_them():
    ds = pbdkit.run("paper/a", settings={"steps": 60}, progress=False)
    figure = ds.pbd.plot("pe1", time=[5, 60], limits="each", filled=True)
    for step, ax in zip((5, 60), figure.axes, strict=False):
        largest = float(ds.pe1.sel(time=step).max())
        assert ax.images[0].get_clim() == pytest.approx((0.0, largest))
        assert ax.get_title() == f"step {step}: 0 to {largest:.3g}"
    shared = ds.pbd.plot("pe1", time=[5, 60], filled=True)
    assert shared.axes[0].images[0].get_clim() == shared.axes[1].images[0].get_clim()
    both = quantity()
    whole = scale_of(both, (-3.0, 1.0), PlotOptions(limits="each"), True)
    part = scale_within(whole, both, (0.0, 0.5), PlotOptions(limits="each"))
    assert (part.low, part.high) == (-0.5, 0.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "cube"}, "norm: expected linear, log, sqrt, symlog; got 'cube'"),
        ({"limits": "both"}, "limits: expected all, each; got 'both'"),
        ({"limits": "each", "vmax": 1.0}, "limits='each' determines the limits"),
    ],
)
def test_wrong_scales_are_refused(options, message):
    with pytest.raises(ExperimentError, match=message):
        PlotOptions(**options)


def test_principal_values_are_drawn_wherever_stresses_are(tmp_path):
    pytest.importorskip("pint")
    ds = pbdkit.run("modelling/strip", progress=False)
    both = ds.stress_principal.values
    ax = ds.pbd.plot("stress_1", filled=True)
    assert ax.images[0].get_clim()[1] == pytest.approx(np.nanmax(both[-1, :, 0]))
    bar = ax.figure.axes[-1]
    label = " ".join((bar.get_ylabel() or bar.get_xlabel()).split())
    assert label == "larger principal stress (MPa)"
    parts = ds.pbd.components()
    for k in range(2):
        np.testing.assert_array_equal(parts[f"stress_{k + 1}"], both[..., k])
    (line,) = ds.pbd.history("stress_2", particle=9).lines
    np.testing.assert_array_equal(line.get_ydata(), both[:, 8, 1])
    assert ds.pbd.curve("stress_1").get_ylabel().startswith("larger principal stress")
    pbdkit.report(ds, tmp_path / "strip.html")
    assert "smaller principal stress" in (tmp_path / "strip.html").read_text()
