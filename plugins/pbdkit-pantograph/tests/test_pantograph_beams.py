"""Test beams with pivots: exact beams, arcs, mechanisms, pivots that resist."""

import json
from pathlib import Path

import numpy as np
import pytest
from pbdkit_pantograph import PantographBeams

import pbdkit

FOLDER = Path(__file__).parent.parent / "experiments"
EA, EI = 1.0, 0.02
ROOT = 2.0**0.5


def body(columns, rows, steps, memory, **parts):
    """Beams along the axes of a square lattice, with nothing around them."""
    return pbdkit.run(
        {
            "name": "beams",
            "lattice": {"type": "square", "a": 0.5},
            "body": {"type": "grid", "columns": columns, "rows": rows},
            "rule": {"type": "pantograph-beams", "stretching": EA, "bending": EI},
            "frame": {"type": "none"},
            "steps": steps,
            "record": {"every": steps},
            "solver": {"type": "stepping", "memory": memory, "engine": "numpy"},
        }
        | parts,
        components=[PantographBeams],
        progress=False,
    )


def end(edge, motion, **more):
    return {"select": {"edge": edge}, "motion": motion} | more


def shown(ds):
    """The last state: x (particle, axis), angles of both rotations, force (particle, axis)."""
    last = ds.isel(time=-1)
    angles = [np.arctan2(last[f"{k}_sin"], last[f"{k}_cos"]).values for k in ("first", "second")]
    force = np.stack([last.force_x.values, last.force_y.values], axis=1)
    return last.position.values, angles, force


@pytest.mark.parametrize("rows", [1, 3])
def test_cantilever_is_exact_and_fibres_on_perfect_pivots_share_its_load(rows):
    """F = n · 3 EI w/L³ of n fibres: perfect pivots carry no shear from one to the next."""
    tip, length = 1e-5, 1.5
    motion = {"type": "displace", "displacement": [0.0, tip]}
    leaders = [end("left", {"type": "hold"}, clamped=True), end("right", motion)]
    ds = body(4, rows, 240, 0.9, leaders=leaders)
    x, (angle, _), force = shown(ds)
    X = ds.reference.values
    at, tips = X[:, 0], X[:, 0] == length
    exact = tip * (3 * length * at**2 - at**3) / (2 * length**3)
    np.testing.assert_allclose((x - X)[:, 1], exact, atol=1e-8 * tip)
    np.testing.assert_allclose(angle[tips], 1.5 * tip / length, rtol=1e-8)
    load = rows * 3 * EI * tip / length**3
    assert -force[tips, 1].sum() == pytest.approx(load, rel=1e-7)
    assert ds.energy.values[-1].sum() == pytest.approx(load * tip / 2, rel=1e-7)


def arc(links, turn):
    """The state in which a beam is an arc that turns by so much; its tip on a polygon of links of
    their own length, which both ends prescribe."""
    length = 0.5 * links
    steps = turn * (np.arange(links) + 0.5) / links
    corners = 0.5 * np.cumsum(np.exp(1j * np.append(0.0, steps))) - 0.5
    there, turned = corners[-1], np.exp(1j * turn)
    centre = (there - turned * length) / (1 - turned)
    motion = {"type": "rotation", "centre": [centre.real, centre.imag],
              "angle": float(np.degrees(turn)) / 40, "steps": 40}  # fmt: skip
    ends = [end("left", {"type": "hold"}, clamped=True), end("right", motion, clamped=True)]
    return body(links + 1, 1, 40 + 50 * links, 0.85 if links > 2 else 0.5, leaders=ends), corners


def test_beam_between_rotated_grips_is_an_arc_with_second_order_energy():
    """The points lie on a circle; the energy tends to EI θ²/(2 L)."""
    turn, off = np.pi / 2, []
    for links in (2, 4):
        ds, corners = arc(links, turn)
        x, (angle, _), force = shown(ds)
        np.testing.assert_allclose(x[:, 0] + 1j * x[:, 1], corners, atol=1e-7)
        np.testing.assert_allclose(angle, turn * np.arange(links + 1) / links, atol=1e-7)
        np.testing.assert_allclose(force, 0.0, atol=1e-8)
        exact = EI * turn**2 / (2 * 0.5 * links)
        off.append(ds.energy.values[-1].sum() / exact - 1)
    assert np.log2(off[0] / off[1]) == pytest.approx(2.0, abs=0.05)


def pantograph(steps, memory, **parts):
    """Fibres at ±45° with links of length 1."""
    lattice = {"type": "centred-rectangular", "a": ROOT, "b": ROOT}
    given = {"type": "pantograph-beams", "stretching": 1.0, "bending": 0.1}
    return body(1, 1, steps, memory, **{"lattice": lattice, "rule": given} | parts)


def plain_energy(x, angles, X, bending, pivot):
    """The formula of the rule, link by link; `angles` of both families, (family, particle)."""
    t = 2 * np.tan((angles[0] - angles[1]) / 2)
    total = pivot * (t**2).sum() / 2
    row = {tuple(p): n for n, p in enumerate(np.round(X * ROOT).astype(int))}
    for (i, j), n in row.items():
        for family, step in enumerate(((1, 1), (-1, 1))):
            if (k := row.get((i + step[0], j + step[1]))) is not None:
                v, r = complex(*(x[k] - x[n])), complex(*(X[k] - X[n]))
                a, b = (2 * np.tan(np.angle(v / r * np.exp(-1j * angles[family][m])) / 2)
                        for m in (n, k))  # fmt: skip
                total += (abs(v) - 1) ** 2 / 2 + 2 * bending * (a * a + a * b + b * b)
    return total


def test_force_and_energy_match_the_formula_and_energy_never_increases():
    rule = {"type": "pantograph-beams", "stretching": 1.0, "bending": 0.1, "pivot": 0.05}
    grid = {"type": "grid", "columns": 3, "rows": 4}
    ds = pantograph(25, 0.0, body=grid, rule=rule, record={"every": 1}, seed=5,
                    initial={"type": "noise", "amplitude": 0.25})  # fmt: skip
    energy = ds.energy.values[1:].sum(axis=1)
    assert (np.diff(energy) < 0).all()
    assert energy[-1] < 0.2 * energy[0]
    X, x = ds.reference.values, ds.position.values[4]
    angles = [np.arctan2(ds[f"{k}_sin"], ds[f"{k}_cos"]).values[4] for k in ("first", "second")]
    assert energy[4] == pytest.approx(plain_energy(x, angles, X, 0.1, 0.05), rel=1e-10)
    for n in (0, 4, 7):
        for axis, found in enumerate((ds.force_x, ds.force_y)):
            nudge = np.zeros_like(x)
            nudge[n, axis] = 1e-5
            ahead, behind = (plain_energy(x + s * nudge, angles, X, 0.1, 0.05) for s in (1, -1))
            assert found.values[5, n] == pytest.approx((behind - ahead) / 2e-5, abs=1e-8)


def test_mechanism_of_a_pantograph_has_zero_energy():
    """Drawn at two pivots on its axis, a sheet of rigid straight fibres gets narrower: its cells
    are rhombi of side 1, and no energy is left."""
    pulled, length = 0.3, 3 * ROOT
    ends = [
        {"select": {"nearest": [[0.0, ROOT]]}, "motion": {"type": "hold"}},
        {
            "select": {"nearest": [[length, ROOT]]},
            "motion": {"type": "velocity", "velocity": [pulled / 50, 0.0], "steps": 50},
        },
    ]
    sheet = {"type": "rectangle", "width": length + 0.1, "height": 2 * ROOT + 0.1}
    ds = pantograph(600, 0.9, body=sheet, leaders=ends)
    x, _, _ = shown(ds)
    cosine = (length + pulled) / 6
    X = ds.reference.values
    along, across = 2 * cosine / ROOT, 2 * np.sqrt(1 - cosine**2) / ROOT
    expected = np.stack([along * X[:, 0], ROOT + across * (X[:, 1] - ROOT)], axis=1)
    np.testing.assert_allclose(x, expected, atol=1e-6)
    assert ds.energy.values[-1].sum() < 1e-13


def test_elastic_pivots_resist_only_the_angle_between_fibres():
    """Second fibres turned by γ: ½ k t² a pivot, t = 2 tan(γ/2), where fibres hardly bend."""
    angle, spring = 0.4, 0.05
    shear = [[0.0, np.sin(angle)], [0.0, np.cos(angle) - 1]]
    ds = body(
        4, 4, 60, 0.0,
        rule={"type": "pantograph-beams", "stretching": 400.0, "bending": 100.0, "pivot": spring},
        initial={"type": "affine", "gradient": shear},
        leaders=[end(edge, {"type": "hold"}) for edge in ("left", "right", "bottom", "top")],
    )  # fmt: skip
    x, (first, second), _ = shown(ds)
    X = ds.reference.values
    np.testing.assert_allclose(x, X + X @ np.transpose(shear), atol=1e-5)
    np.testing.assert_allclose(second - first, -angle, atol=1e-3)
    energy = 16 * spring * (2 * np.tan(angle / 2)) ** 2 / 2
    assert ds.energy.values[-1].sum() == pytest.approx(energy, rel=1e-3)


def test_too_slender_fibres_are_refused():
    with pytest.raises(pbdkit.ExperimentError, match=r"bending: is less than 1e-10 · stretching"):
        body(3, 3, 1, 0.0, rule={"type": "pantograph-beams", "bending": 1e-12})


@pytest.mark.parametrize("name", ["beams", "bending"])
def test_the_experiments_run_with_this_plugin(name):
    settings = ["steps=3", "solver.engine=numpy", "body.width=8.6"]
    settings.append("leaders.1.select={edge: right}")
    experiment = pbdkit.load(FOLDER / f"{name}.yaml", settings=settings)
    ds = pbdkit.run(experiment, progress=False)
    assert ds.attrs["status"] == "complete"
    assert "pbdkit-pantograph" in json.loads(ds.attrs["plugins"])
