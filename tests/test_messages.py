"""Messages for frequent mistakes name the place, the cause and the remedy."""

import re
from typing import Literal

import numpy as np
import pytest
import xarray

import pbdkit
from pbdkit.plugin import Diagnostic, ParticleOperation, Variable

SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "rule": {"type": "barycentre"},
    "frame": {"type": "mean"},
    "steps": 2,
    "diagnostics": [{"type": "broken"}],
    "fracture": {"type": "threshold", "thresholds": [9.0]},
}


class Instance(Diagnostic):
    type: Literal["instance"] = "instance"

    def variables(self):
        return (Variable("extent", (), "extent", "lattice unit"),)

    def measure(self, now):
        return (float(np.abs(now.displacement()).max()),)


PYTHON = {
    "Experiment of a file": (
        lambda ds: pbdkit.Experiment("a.yaml"),
        r"expected parts by keyword, .*pbdkit.load\(...\) returns the experiment in a file",
    ),
    "Experiment.build of a dict": (
        lambda ds: pbdkit.Experiment.build(SHEET),
        r"Experiment.build: expected a source .*, got dict; write Experiment\(\*\*parts\)",
    ),
    "resume of a dataset": (
        lambda ds: pbdkit.resume(ds),
        r"resume: expected the name of the result file .* Dataset; `pbdkit.rerun\(ds\)`",
    ),
    "fit of a list": (
        lambda ds: pbdkit.fit_strength([1.0, 2.0]),
        "expected a fit file, the name of a shipped fit or a dict .*, got an object of type list",
    ),
    "fit to a dataset": (
        lambda ds: pbdkit.fit({"experiment": SHEET, "unknown": {}, "measured": ds}),
        r"fit: measured: expected keys .* got an object of type Dataset; .*measured=dataset",
    ),
    "object in place of a class": (
        lambda ds: pbdkit.run(SHEET, components=[Instance()], progress=False),
        "components: expected the class Instance, got an object of it; give Instance",
    ),
    "kind of a curve": (
        lambda ds: ds.pbd.curve("stress_strain"),
        "no variable 'stress_strain'; a kind is given as kind='stress-strain'",
    ),
    "control of a run": (
        lambda ds: ds.pbd.curve("load_factor"),
        "'load_factor' was not recorded; it is recorded with solver: .*control: ...",
    ),
    "picture of a number": (
        lambda ds: ds.pbd.plot("broken_bonds"),
        r"'broken_bonds' cannot be drawn over the body, .* ds.pbd.curve\('broken_bonds'\)",
    ),
    "vary a word": (
        lambda ds: pbdkit.sweep(SHEET, vary="solver.relaxation"),
        "vary: should be a map of keys, .*; write {solver.relaxation: ...}",
    ),
    "array of three numbers": (
        lambda ds: pbdkit.run(SHEET | {"cuts": [{"from": np.zeros(3), "to": [1.0, 1.0]}]}),
        r"cuts.0.from: should have at most 2 items, got 3",
    ),
    "list of one point": (
        lambda ds: pbdkit.run(SHEET, settings={"cuts": [{"from": [0.5], "to": [1.0, 1.0]}]}),
        r"cuts.0.from.1: is missing; the list needs 2 entries",
    ),
    "component without type": (
        lambda ds: pbdkit.run(SHEET | {"frame": {"layers": 2}}),
        r"frame: `type` is missing; it is one of .*mean, mirror, natural, none",
    ),
}


@pytest.fixture(scope="module")
def dataset():
    return pbdkit.run(SHEET, progress=False)


@pytest.mark.parametrize("name", PYTHON)
def test_python_call(name, dataset):
    call, message = PYTHON[name]
    with pytest.raises(pbdkit.ExperimentError) as caught:
        call(dataset)
    assert re.search(message, str(caught.value)), str(caught.value)


def test_variable_has_no_methods(dataset):
    message = (
        r"`pbd` belongs to datasets: write ds.pbd.plot\(...\), with 'broken_bonds' as the name"
    )
    with pytest.raises(AttributeError, match=message):
        _ = dataset.broken_bonds.pbd.plot


def test_missing_file_has_a_similar_name(tmp_path):
    xarray.Dataset().to_netcdf(tmp_path / "plate-1.nc")
    with pytest.raises(pbdkit.StorageError, match=r"no such file; did you mean 'plate-1\.nc'"):
        pbdkit.open(tmp_path / "plate_1.nc")


COMMANDS = {
    "size with a unit": (
        ["plot", "o.nc", "--size", "20cm", "10cm"],
        "'20cm' is not a number; expected WIDTH HEIGHT: Size of the figure in inches.",
    ),
    "suffix of a curve": (
        ["curve", "o.nc", "-o", "c.txt"],
        "c.txt: the name of a picture must end in .png, .svg, .pdf, that of a table in .csv",
    ),
    "report of a fit": (
        ["report", "fit.json"],
        "fit.json: is not a result; `pbdkit fit FILE --plot OUT.png` draws a fit",
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_command(name, call, tmp_path):
    (tmp_path / "work" / "fit.json").write_text('{"values": {}}')
    words, message = COMMANDS[name]
    done = call(*words)
    assert done.code == 2
    assert message in " ".join(done.err.split()), done.err


class Reading(Diagnostic):
    """A sound diagnostic of which the following change a method."""

    def variables(self):
        return (Variable("extent", (), "extent", "lattice unit"),)


class Writing(Reading):
    type: Literal["writing"] = "writing"

    def measure(self, now):
        u = now.displacement()
        u -= u.mean(axis=0)
        return (float(u.max()),)


class Infinite(Reading):
    type: Literal["infinite"] = "infinite"

    def measure(self, now):
        return (np.nan,)


class OfBody(Instance):
    type: Literal["of-body"] = "of-body"

    def variables(self):
        return (Variable("extent", ("particle",), "extent", "lattice unit"),)

    def measure(self, now):
        return (now.displacement()[now.body, 0],)


class OfNothing(Instance):
    type: Literal["of-nothing"] = "of-nothing"

    def variables(self):
        return (Variable("extent", ("particles",), "extent", "lattice unit"),)


class Halving(ParticleOperation):
    type: Literal["halving"] = "halving"

    @staticmethod
    def displacement(u, new, p):
        x = new.x
        x *= 0.5
        return new


class Incomplete(ParticleOperation):
    type: Literal["incomplete"] = "incomplete"


def test_coordinates_in_place_of_points():
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.load("start").with_settings({"leaders.0.select": {"nearest": ["0 mm", "4 mm"]}})
    message = str(caught.value)
    assert message.endswith(
        "nearest: should be a list of points, got [0 mm, 4 mm]; write [[0 mm, 4 mm]]"
    )


NEW = "make new arrays, `x = x + 1` instead of `x += 1`"
PLUGINS = {
    Writing: ("Diagnostic 'writing' failed at step 0", "read-only; " + NEW),
    Infinite: ("`measure` returned nan as 'extent' of the run; guard divisions", "`may_be_nan"),
    OfBody: ("returned the shape (20,) for 'extent', expected (", "and NaN at frame points"),
    OfNothing: ("'particles', for which it defines no coordinate; did you mean 'particle'?",),
    Halving: ("ParticleOperation 'halving' failed at step 1", NEW, "test_messages.py, line"),
    Incomplete: ("Incomplete does not define displacement(u, new, p)",),
}


@pytest.mark.parametrize("component", PLUGINS, ids=lambda component: component.__name__)
def test_plugin(component):
    field = "operations" if issubclass(component, ParticleOperation) else "diagnostics"
    settings = {field: [{"type": component.type_name()}], "solver.engine": "numpy"}
    errors = pbdkit.PluginError, pbdkit.ExperimentError
    with pytest.raises(errors) as caught:
        pbdkit.run(SHEET, components=[component], settings=settings, progress=False)
    message = str(caught.value)
    assert [words for words in PLUGINS[component] if words not in message] == [], message
