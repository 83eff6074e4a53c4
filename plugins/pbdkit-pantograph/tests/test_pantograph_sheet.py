"""Test pantographic sheets: proposals of fibres, energy, mechanisms, bias extension."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from pbdkit_pantograph import Fibres, Pantograph

import pbdkit

FOLDER = Path(__file__).parent.parent / "experiments"
ZONES = runpy.run_path(str(FOLDER / "zones.py"))
BENDING, SHEAR = 0.2, 0.05
ROOT = 2.0**0.5
SETTLED = (
    "steps=4000",
    "record.every=4000",
    "solver={type: stepping, memory: 0.97, engine: numpy}",
)


def sheet(rule, steps, lattice=None, **parts):
    """A sheet of links of length 1 at ±45°, with nothing around it."""
    return pbdkit.run(
        {
            "name": "sheet",
            "lattice": lattice or {"type": "centred-rectangular", "a": ROOT, "b": ROOT},
            "body": {"type": "grid", "columns": 7, "rows": 12},
            "neighbours": {"type": "fibres"},
            "rule": rule,
            "frame": {"type": "none"},
            "steps": steps,
        }
        | parts,
        components=[Fibres, Pantograph],
        progress=False,
    )


class Plain:
    """The sheet's fibres by hand: links, bends and diagonals as rows of particles."""

    def __init__(self, ds):
        self.X = ds.reference.values
        place = np.round(self.X * ROOT).astype(int)
        row = {tuple(p): n for n, p in enumerate(place)}

        def rows(*steps):
            found = [[row.get((i + m, j + n)) for m, n in steps] for i, j in row]
            return np.array([line for line in found if None not in line])

        here, fibres = (0, 0), ((1, 1), (1, -1))
        self.links = np.concatenate([rows(here, e) for e in fibres])
        self.bends = np.concatenate([rows((-m, -n), here, (m, n)) for m, n in fibres])
        self.across = np.concatenate([rows(here, (2, 0)), rows(here, (0, 2))])
        arms = [n for e in fibres for n in (e, (-e[0], -e[1]))]
        arms += [(2 * m, 2 * n) for m, n in arms]
        self.inner = rows(here, *arms)[:, 0]

    def energy(self, x, bending=BENDING, shear=SHEAR):
        """½ Σ (|D| - l)² over links and, times shear, diagonals, and ½ bending Σ |bend|²."""
        springs = [(self.links, 1.0), (self.across, shear)]
        total = 0.0
        for (one, other), stiffness in ((pairs.T, k) for pairs, k in springs):
            length = np.linalg.norm(x[other] - x[one], axis=1)
            rest = np.linalg.norm(self.X[other] - self.X[one], axis=1)
            total += stiffness * ((length - rest) ** 2).sum() / 2
        a, b, c = self.bends.T
        return total + bending * ((x[a] - 2 * x[b] + x[c]) ** 2).sum() / 2

    def force(self, x, particle):
        """Minus the gradient, by central differences."""
        h, found = 1e-5, np.zeros(2)
        for axis in (0, 1):
            step = np.zeros_like(x)
            step[particle, axis] = h
            found[axis] = (self.energy(x - step) - self.energy(x + step)) / (2 * h)
        return found


RULE = {"type": "pantograph", "bending": BENDING, "shear": SHEAR}
NOISE = {"type": "noise", "amplitude": 0.2}


def test_pivots_move_to_the_mean_of_both_fibre_proposals():
    """(Σ springs + k_b (4 Σ D_1 - Σ D_2)) / (2 + 8 k_b), spelled out for a pivot in the middle."""
    ds = sheet(RULE | {"shear": 0.0}, 1, initial=NOISE, seed=3)
    before, after = ds.position.values
    places = np.round(ds.reference.values * ROOT).astype(int)
    place = dict(zip(map(tuple, places), before, strict=True))
    for n in Plain(ds).inner[:5]:
        i, j = places[n]
        proposals = []
        for m in (1, -1):
            first = [place[i + s, j + s * m] - before[n] for s in (1, -1)]
            second = [place[i + 2 * s, j + 2 * s * m] - before[n] for s in (1, -1)]
            springs = sum(D - D / np.linalg.norm(D) for D in first)
            bent = 4 * sum(first) - sum(second)
            proposals.append((springs + BENDING * bent) / (2 + 8 * BENDING))
        np.testing.assert_allclose(after[n], before[n] + np.mean(proposals, axis=0), atol=1e-13)


def test_every_pivot_moves_along_the_force_including_fibre_ends():
    ds = sheet(RULE, 1, initial=NOISE, seed=4)
    before, after = ds.position.values
    plain = Plain(ds)
    for n in range(0, len(before), 5):
        force, move = plain.force(before, n), after[n] - before[n]
        share = np.linalg.norm(force) / np.linalg.norm(move)
        np.testing.assert_allclose(share * move, force, atol=1e-6)
        assert 1.0 < share < 4 + 16 * BENDING + 4 * SHEAR + 1e-6


@pytest.mark.filterwarnings("ignore:the last state has inverted cells")
@pytest.mark.parametrize("bending", [0.0, BENDING, 20.0])
def test_energy_never_increases(bending):
    for seed in range(5):
        rough = {"type": "noise", "amplitude": 0.9}
        ds = sheet(RULE | {"bending": bending}, 150, initial=rough, seed=seed)
        plain = Plain(ds)
        energy = np.array([plain.energy(x, bending) for x in ds.position.values])
        assert (np.diff(energy) <= 1e-12 * energy[0]).all()
        assert energy[-1] < 0.5 * energy[0]


@pytest.mark.parametrize("angle", [30.0, 90.0, 180.0])
def test_rotated_sheet_stays_at_rest(angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = [[c - 1, -s], [s, c - 1]]
    ds = sheet(RULE, 20, initial={"type": "affine", "gradient": turn})
    np.testing.assert_allclose(ds.position[-1], ds.position[0], atol=1e-12)


def test_scissoring_has_zero_energy_for_free_pivots():
    """Both families turned, by ±15°: the one mechanism of a pantograph."""
    half = np.radians(45 - 15)
    opening = [[ROOT * np.cos(half) - 1, 0], [0, ROOT * np.sin(half) - 1]]
    start = {"type": "affine", "gradient": opening}
    free = sheet(RULE | {"shear": 0.0}, 50, initial=start)
    np.testing.assert_allclose(free.position[-1], free.position[0], atol=1e-12)
    stiff = sheet(RULE, 600, initial=start, solver={"type": "stepping", "memory": 0.8})
    found = ZONES["cells"](stiff).angle
    assert ZONES["cells"](free).angle == pytest.approx(60.0, abs=1e-9)
    assert found == pytest.approx(90.0, abs=0.1)


def test_fibres_are_at_45_degrees_on_a_rotated_lattice():
    lattice = sheet(RULE, 1).attrs["experiment"]
    cell = pbdkit.Experiment(**json.loads(lattice)).lattice.cell()
    for sublattice in (0, 1):
        along, after, across = Fibres().shells_around(cell, sublattice)
        angles = sorted(np.degrees(np.arctan2(o.rest.y, o.rest.x)) for o in along)
        assert angles == pytest.approx([-135, -45, 45, 135])
        for shell, length in ((along, 1.0), (after, 2.0), (across, ROOT)):
            assert [o.length for o in shell] == pytest.approx([length] * 4)


def test_missing_neighbours_of_a_fibre_are_named():
    with pytest.raises(
        pbdkit.ExperimentError, match=r"fibres need a neighbour at \(1\.414, 1\.414\); use a latt"
    ):
        sheet(RULE, 1, neighbours={"type": "coordination", "shells": 1})


@pytest.mark.parametrize("pull", [0.2])
def test_bias_extension_has_the_zones_of_inextensible_fibres(pull):
    """Means of the zones within 8 % of the shear angle of C; links of finite stiffness account for
    it, and the same in the axis's length, which is exact for inextensible ones however C shears."""
    ds = ZONES["pulled"](6, 18, pull, *SETTLED)
    found, expected = ZONES["cells"](ds), ZONES["theory"](pull)
    shear = 90.0 - expected["C"]
    for zone in "ABC":
        mean = found.angle[found.zone == zone].mean()
        assert mean == pytest.approx(expected[zone], abs=0.08 * shear)
    assert np.abs(found.strain).max() < 0.01
    assert ZONES["on_axis"](found) == pytest.approx((1 + pull) / ROOT, rel=0.01)


def test_the_experiment_runs_with_this_plugin():
    ds = pbdkit.run(
        pbdkit.load(FOLDER / "bias-extension.yaml", settings=["steps=50", "solver.engine=numpy"]),
        progress=False,
    )
    assert ds.attrs["status"] == "complete"
    assert "pbdkit-pantograph" in json.loads(ds.attrs["plugins"])
    led = (ds.kind.isel(time=-1) == 0).values
    assert ds.u.isel(time=-1).values[led].max() == pytest.approx(0.1)
