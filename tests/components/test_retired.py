"""Built-in components of earlier versions: read as their successors, with a warning."""

import json
import warnings

import jsonschema
import numpy as np
import pytest

import pbdkit
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.model.schema import experiment_schema
from pbdkit.plugin.registry import Registry
from pbdkit.web.report import RunContent

HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
PULLED = {
    "select": {"edge": "right"},
    "motion": {"type": "displace", "displacement": [0.1, 0.0]},
}
SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 6, "rows": 4},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "leaders": [HELD, PULLED],
    "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0}],
    "steps": 4,
}
OLD = SHEET | {"frame": {"type": "traction-free"}}
ADVICE = "frame.type: 'traction-free' is retired, and is replaced by 'natural' until version 1.0"


@pytest.mark.parametrize("name", ["traction-free", "pbdkit:traction-free"])
def test_retired_type_is_read_as_its_replacement(name):
    with pytest.warns(pbdkit.PbdkitWarning, match=ADVICE) as caught:
        found = pbdkit.Experiment(**SHEET | {"frame": {"type": name}})
    assert found == pbdkit.Experiment(**SHEET)
    assert [warning.filename for warning in caught] == [__file__]
    assert "traction-free" not in found.model_dump_json() + str(found.as_written().data)


def test_rebuilding_an_experiment_does_not_warn_again():
    given = OLD | {"units": {"length": "1 mm"}, "diagnostics": []}
    with pytest.warns(pbdkit.PbdkitWarning, match=ADVICE):
        found = Experiment.build(Source(data=given))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found.of_parts(found.as_written().data) == found


def test_program_warns_once_with_the_place(call, tmp_path):
    (tmp_path / "old.yaml").write_text(json.dumps(OLD))
    file = str(tmp_path / "old.yaml")
    told = json.loads(call("check", file, "--json").out)["warnings"]
    assert [ADVICE in text for text in told].count(True) == 1
    checked = call("check", file)
    assert (checked.out + checked.err).count(f"warning: {file}:1:") == 1
    assert call("run", file, "-o", "out.nc").err.count(ADVICE) == 1
    assert call("run", file, "-o", "out.nc", "--force", "--quiet").err == ""


def test_members_of_a_sweep_give_one_warning(call, tmp_path):
    sweep = {"version": 1, "experiment": OLD, "vary": {"steps": [2, 3, 4]}}
    (tmp_path / "sweep.yaml").write_text(json.dumps(sweep))
    done = call("sweep", str(tmp_path / "sweep.yaml"), "-o", "out", "--workers", "1")
    assert done.code == 0
    assert done.err.count(ADVICE) == 1


@pytest.mark.parametrize(
    ("parts", "place"),
    [
        ({"leaders": [HELD, PULLED | {"select": {"numbers": [9, 10]}}]}, "leaders.1.select"),
        (
            {"loads": [{"select": {"numbers": [9]}, "force": [0.1, 0.0]}]},
            "loads.0.select",
        ),
        ({"diagnostics": [{"type": "track", "numbers": [9]}]}, "diagnostics.0"),
    ],
)
def test_particle_numbers_are_refused_after_renumbering(parts, place):
    with pytest.raises(pbdkit.ExperimentError, match="which is retired; under 'natural'") as error:
        pbdkit.Experiment(**OLD | parts)
    assert str(error.value).startswith(f"{place}.numbers: ")


def test_retired_frame_takes_no_parameter():
    with pytest.raises(pbdkit.ExperimentError, match=r"^frame\.layers: unknown key"):
        pbdkit.Experiment(**OLD | {"frame": {"type": "traction-free", "layers": 2}})


def test_schema_marks_it_as_deprecated():
    schema = experiment_schema(Registry(), installed=False)
    jsonschema.Draft202012Validator(schema).validate(OLD)
    known = schema["properties"]["frame"]["oneOf"]
    assert [one["properties"]["type"]["const"] for one in known if one.get("deprecated")] == [
        "traction-free"
    ]


class Taken(pbdkit.FramePolicy):
    """Has the name of a frame that was built in."""

    type: str = "traction-free"

    def depth(self, reach):
        return 0

    def follow(self, frame):
        raise NotImplementedError


def test_retired_name_stays_reserved():
    with pytest.raises(pbdkit.ExperimentError, match="'traction-free' is the name of a built-in"):
        pbdkit.run(SHEET, components=[Taken], progress=False)


@pytest.fixture
def old_result(tmp_path):
    """Return a result with an experiment that names the frame, as earlier versions wrote it."""
    ds = pbdkit.run(SHEET, progress=False)
    parts = json.loads(ds.experiment) | {"frame": {"type": "traction-free"}}
    ds.attrs["experiment"] = json.dumps(parts)
    ds.to_netcdf(tmp_path / "old.nc")
    return tmp_path / "old.nc"


@pytest.mark.filterwarnings("ignore:.*has no seal:pbdkit.PbdkitWarning")
def test_old_results_open_and_rerun(old_result):
    with pbdkit.open(old_result) as ds:
        with pytest.warns(pbdkit.PbdkitWarning, match=ADVICE):
            again = pbdkit.rerun(ds, progress=False)
        np.testing.assert_array_equal(again.position, ds.position)
        assert ds.pbd.plot() is not None
        assert '"traction-free"' in ds.experiment


@pytest.mark.filterwarnings("ignore:.*has no seal:pbdkit.PbdkitWarning")
def test_operations_on_the_original_scene_are_refused(old_result, call):
    refusal = "requires the scene of the run, but its frame 'traction-free' is retired"
    with pbdkit.open(old_result) as ds:
        with pytest.raises(pbdkit.ExperimentError, match=refusal):
            ds.pbd.curve()
        assert "type: traction-free" in str(RunContent(ds).within(10**6))
    assert refusal in call("explain", str(old_result)).err
    exported = call("export", str(old_result))
    assert (exported.code, exported.err.count(refusal)) == (0, 1)
