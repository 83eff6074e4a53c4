"""Arguments and results of a diagnostic: read-only tables, the rows of the body, names."""

from typing import ClassVar, Literal

import numpy as np
import pytest
from property_cases import BOTH_ENDS_HELD, LATTICES, experiment

import pbdkit
from pbdkit.io.layout import reserved_names
from pbdkit.lattice.raster import FRAME

CRACKED = {"type": "threshold", "thresholds": [9.0], "cracks": [[[1.75, -9.0], [1.75, 9.0]]]}
CALIBRATED = {
    "lattice": {"type": "square", "a": 1.0},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
}


class Given(pbdkit.Diagnostic):
    """Writes into one of the arrays that it is given."""

    type: Literal["given"] = "given"
    what: str

    def variables(self):
        return (pbdkit.plugin.Variable("given", (), "zero", "1"),)

    def measure(self, now):
        arrays = {
            "body": lambda: now.body,
            "displacement": now.displacement,
            "displacement of some": lambda: now.displacement(np.array([0, 1])),
            "previous_displacement": now.previous_displacement,
            "reference": now.reference,
            "reference of some": lambda: now.reference(np.array([0, 1])),
            "sum_over_neighbours": lambda: now.sum_over_neighbours(lambda d, r: 1.0),
            "gradient": now.cells.gradient,
            "forces": now.forces.on_particles,
            "leaders": lambda: now.leader_groups()[0].rows,
            "shell": lambda: now.bonds().shell,
            "broken_step": lambda: now.bonds().broken_step,
        }
        arrays[self.what]()[...] += 1
        return (0.0,)


@pytest.mark.parametrize(
    "what",
    [
        "body", "displacement", "displacement of some", "previous_displacement", "reference",
        "reference of some", "sum_over_neighbours", "gradient", "forces", "leaders", "shell",
        "broken_step",
    ],
)  # fmt: skip
def test_diagnostic_that_modifies_its_input_is_named(what):
    parts = CALIBRATED | {"fracture": CRACKED, "leaders": BOTH_ENDS_HELD}
    given = experiment(**parts, diagnostics=[Given(what=what)], steps=2)
    with pytest.raises(pbdkit.PluginError, match=r"'given' failed at step 0: .*read-only"):
        pbdkit.run(given, components=[Given], progress=False)


class Centred(pbdkit.Diagnostic):
    """The farthest particle from the centre, measured in place as one may write it."""

    type: Literal["centred"] = "centred"

    def variables(self):
        return (pbdkit.plugin.Variable("farthest", (), "farthest particle", "lattice unit"),)

    def measure(self, now):
        X = now.reference()
        X -= X.mean(axis=0)
        return (np.hypot(*X.T).max(),)


def test_no_diagnostic_changes_the_records():
    settings = ["steps=5", "diagnostics=[{type: centred}]"]
    given = pbdkit.load("paper/a", components=[Centred], settings=settings)
    with pytest.raises(pbdkit.PluginError, match="'centred' failed at step 0"):
        pbdkit.run(given, progress=False)


class Named(pbdkit.Diagnostic):
    """Brings a dimension along."""

    type: Literal["named"] = "named"
    dimension: str
    variable: str = "named"
    at_end: ClassVar[bool] = True

    def variables(self):
        return (pbdkit.plugin.Variable(self.variable, (self.dimension,), "zeros", "1"),)

    def coordinates(self):
        return {self.dimension: np.arange(3)}

    def measure(self, now):
        return (np.zeros(3),)


@pytest.mark.parametrize("name", sorted(reserved_names()))
def test_dimension_with_a_reserved_name_is_refused(name):
    class OwnLength(Named):
        type: Literal["own-length"] = "own-length"
        own_dimension: ClassVar[str] = name

        def coordinates(self):
            return {}

    message = (
        f"declares the dimension '{name}', but the dataset already has a variable or dimension"
    )
    for kind in (Named, OwnLength):
        with pytest.raises(pbdkit.PluginError, match=message):
            pbdkit.run(experiment(diagnostics=[kind(dimension=name)], steps=1), progress=False)


def test_dimension_or_variable_of_another_diagnostic_is_refused():
    for other in (Named(dimension="mine"), Named(dimension="named", variable="mine")):
        given = experiment(diagnostics=[Named(dimension="named", variable="other"), other], steps=1)
        if other.dimension == "named":
            with pytest.raises(pbdkit.PluginError, match="the dimension 'named', but the dataset"):
                pbdkit.run(given, progress=False)
        else:
            with pytest.raises(pbdkit.PluginError, match="the variable 'named', but the dataset"):
                pbdkit.run(given, progress=False)


class Coordination(pbdkit.Diagnostic):
    """The mean number of neighbours of the body: on a perfect lattice that of the lattice."""

    type: Literal["coordination-number"] = "coordination-number"

    def variables(self):
        return (pbdkit.plugin.Variable("mean_neighbours", (), "mean number of neighbours", "1"),)

    def measure(self, now):
        return (now.sum_over_neighbours(lambda d, r: 1.0)[now.body].mean(),)


@pytest.mark.parametrize("lattice", LATTICES)
def test_diagnostic_gets_the_body_rows(lattice):
    asked = [Coordination(), {"type": "pe1"}, {"type": "pe1-intact"}, {"type": "strain"}]
    given = experiment(lattice=lattice, diagnostics=[*asked, {"type": "rotation"}], steps=2)
    ds = pbdkit.run(given, progress=False)
    neighbours = ds.mean_neighbours.values
    assert (neighbours == np.rint(neighbours)).all()
    frame = (ds.kind == FRAME).values
    assert frame.any()
    for name in ("pe1", "pe1_intact", "strain_xx", "strain_xy", "rotation"):
        assert np.array_equal(np.isnan(ds[name].values), frame), name
    assert float(ds.pe1.mean()) == ds.pe1.values[~frame].mean()


class Holed(pbdkit.Diagnostic):
    """NaN at chosen rows."""

    type: Literal["holed"] = "holed"
    of_body: bool

    def variables(self):
        return (pbdkit.plugin.Variable("holed", ("axis", "particle"), "holes", "1"),)

    def measure(self, now):
        return (np.stack([np.where(now.body == self.of_body, np.nan, 0.0)] * 2),)


def test_nan_is_stored_at_frame_points_only():
    ds = pbdkit.run(experiment(diagnostics=[Holed(of_body=False)], steps=1), progress=False)
    assert np.array_equal(np.isnan(ds.holed[0, 0]), ds.kind[0] == FRAME)
    with pytest.raises(pbdkit.PluginError, match="returned nan as 'holed' of the run; guard"):
        pbdkit.run(experiment(diagnostics=[Holed(of_body=True)], steps=1), progress=False)


def test_a_file_of_version_1_opens_and_reruns(tmp_path):
    """There frame points held 0."""
    given = experiment(diagnostics=[{"type": "pe1"}, {"type": "displacement"}], steps=3)
    new = pbdkit.run(given, progress=False)
    assert new.schema_version == "2"
    old = new.assign(pe1=new.pe1.fillna(0.0)).assign_attrs(schema_version="1")
    old.to_netcdf(tmp_path / "old.nc")
    with pbdkit.open(tmp_path / "old.nc") as opened:
        assert opened.schema_version == "1"
        again = pbdkit.rerun(opened, progress=False)
        assert np.array_equal(again.u, opened.u)
        assert np.array_equal(again.pe1.fillna(0.0), opened.pe1)


def test_smallest_cell_area_of_a_concave_cell():
    """A square with a corner at (.4, .4) has .4 of its area."""
    corner = {"select": {"nearest": [[1.0, 1.0]]}}
    leaders = [corner | {"motion": {"type": "displace", "displacement": [-0.6, -0.6]}}]
    others = [{"select": {"nearest": [p]}, "motion": {"type": "hold"}}
              for p in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0])]  # fmt: skip
    asked = [{"type": "smallest-cell-area"}]
    given = experiment(2, 2, leaders=leaders + others, diagnostics=asked, steps=1)
    with pytest.warns(pbdkit.PbdkitWarning, match="folded: 1 of 1 cells have an inverted corner"):
        ds = pbdkit.run(given, progress=False)
    assert ds.smallest_cell_area.values == pytest.approx([1.0, 0.4])
