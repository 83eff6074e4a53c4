"""Every component that reads positions gets the same: the place in the experiment's coordinates,
the lattice's origin included."""

from typing import ClassVar, Literal

import numpy as np
import pytest

import pbdkit


class Placed(pbdkit.plugin.Draws, pbdkit.plugin.RenewsParticles, pbdkit.FollowerRule):
    """Does not move, and stores the places that it gets."""

    type: Literal["placed"] = "placed"
    uses_reference: ClassVar[bool] = True

    def remembered(self):
        names = ("drawn_x", "drawn_y", "told_x", "told_y", "centred_x", "centred_y")
        return tuple(
            pbdkit.plugin.Remembered(name, name, "1", changes=not name.startswith("drawn"))
            for name in names
        )

    def draw(self, particles, generator):
        return {"drawn_x": particles.X[:, 0], "drawn_y": particles.X[:, 1]}

    @staticmethod
    def gather(d, r, w, p):
        return (d,)

    @staticmethod
    def apply(total, here, p):
        return 0.0 * total[0]

    @staticmethod
    def remember(total, here, p):
        return *here.X, *here.centred


class Marked(pbdkit.plugin.Draws, pbdkit.FractureModel):
    """Never breaks, and remembers the middle of each bond."""

    type: Literal["marked"] = "marked"

    def constants(self, slot):
        return {}

    def remembered(self):
        return tuple(pbdkit.plugin.Remembered(f"middle_{c}", c, "1", changes=False) for c in "xy")

    def draw(self, bonds, generator):
        return {f"middle_{c}": bonds.midpoint[:, n] for n, c in enumerate("xy")}

    @staticmethod
    def breaks(d, r, c, p):
        return d.x > 1e9

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r


LATTICES = [
    {"type": "square", "a": 0.5, "origin": [100.0, 0.0]},
    {"type": "hexagonal", "a": 1.0, "origin": [100.0, -7.0]},
    {"type": "square", "a": 1.0},
]


@pytest.mark.parametrize("lattice", LATTICES, ids=["square", "hexagonal", "at zero"])
def test_rule_random_draws_and_bonds_agree_on_places(lattice):
    given = {
        "name": "places",
        "lattice": lattice,
        "body": {"type": "grid", "columns": 5, "rows": 4},
        "rule": Placed(),
        "fracture": Marked(),
        "frame": {"type": "none"},
        "steps": 1,
    }
    ds = pbdkit.run(given, components=[Placed, Marked], progress=False).isel(time=-1)
    X = ds.reference.values
    np.testing.assert_allclose(X[0], lattice.get("origin", [0.0, 0.0]))
    told, drawn, centred = (
        np.column_stack([ds[f"{what}_x"], ds[f"{what}_y"]]) for what in ("told", "drawn", "centred")
    )
    np.testing.assert_allclose(told, X, rtol=0, atol=1e-12)
    np.testing.assert_allclose(drawn, X, rtol=0, atol=1e-12)
    middle = (X.min(axis=0) + X.max(axis=0)) / 2
    np.testing.assert_allclose(centred, X - middle, rtol=0, atol=1e-12)
    middles = np.column_stack([ds.middle_x, ds.middle_y])
    np.testing.assert_allclose(middles, X[ds.bond_ends.values - 1].mean(axis=1), rtol=0, atol=1e-12)


class Soft(pbdkit.FollowerRule):
    """The mean displacement, half of it right of x = 102."""

    type: Literal["soft"] = "soft"
    uses_reference: ClassVar[bool] = True

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return pbdkit.plugin.where(here.X.x > 102.0, 0.5, 1.0) * total[0] / total[1]


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_two_phase_rule_has_its_interface_at_the_specified_place(engine, interpreted):
    """Against the mean displacement, of which it makes half to the right of x = 102."""
    given = {
        "name": "phases",
        "lattice": {"type": "square", "a": 1.0, "origin": [100.0, 0.0]},
        "body": {"type": "grid", "columns": 6, "rows": 4},
        "rule": Soft(),
        "frame": {"type": "none"},
        "initial": {"type": "noise", "amplitude": 0.1},
        "diagnostics": [{"type": "displacement"}],
        "solver": {"type": "stepping", "engine": engine},
        "steps": 1,
    }
    ds = pbdkit.run(given, components=[Soft], progress=False)
    whole = pbdkit.run(given | {"rule": {"type": "mean-displacement"}}, progress=False)
    share = np.where(ds.reference.values[:, :1] > 102.0, 0.5, 1.0)
    moved, expected = (np.diff(one.u.values, axis=0)[0] for one in (ds, whole))
    np.testing.assert_allclose(moved, share * expected, rtol=0, atol=1e-15)
    assert set(share.ravel()) == {0.5, 1.0}
