"""Parameters that vary from place to place: valid experiments, and the errors of others."""

from __future__ import annotations

import gc
import json
import random
import sys
from typing import Any

import numpy as np
import pytest
import xarray
from jsonschema import Draft202012Validator

import pbdkit
from pbdkit.model.reading import FileResolver
from pbdkit.model.validation import read_field
from pbdkit.plugin.fields import Gridded, as_varying
from pbdkit.scene.scene import build_scene

DISC = {"type": "disc", "radius": 2.0, "centre": [4.0, 2.0]}
GIVEN: dict[str, Any] = {
    "name": "plate",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "rectangle", "width": 8.0, "height": 4.0},
    "regions": {"disc": DISC},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "steps": 2,
}


def with_rule(**rule: Any) -> dict[str, Any]:
    return GIVEN | {"rule": GIVEN["rule"] | rule}


def test_written_field_is_read_back(tmp_path):
    grid = {"x": [-1.0, 9.0], "y": [0.0], "values": [[1.0], [2.0]]}
    fields = (
        {"stiffness": {"otherwise": 1.0, "disc": 10.0}},
        {"poisson_ratio": {"otherwise": 0.3, "disc": 0.0}},
        {"stiffness": grid},
        {"stiffness": lambda x, y: np.exp(x / 8) + 0 * y},
    )
    for rule in fields:
        experiment = pbdkit.Experiment(**with_rule(**rule))
        written = json.loads(experiment.model_dump_json())
        again = pbdkit.Experiment(**written)
        assert again == experiment
        assert again.model_dump_json() == experiment.model_dump_json()
        Draft202012Validator(json.loads(schema())).validate(written)


def schema() -> str:
    from pbdkit.model.schema import experiment_schema
    from pbdkit.plugin.registry import Registry

    return json.dumps(experiment_schema(Registry(), installed=False))


def test_variable_file_is_read_beside_the_experiment(tmp_path):
    values = xarray.DataArray(
        [[1.0, 2.0, 3.0], [2.0, 3.0, 4.0]],
        coords={"y": [-2.0, 6.0], "x": [-2.0, 4.0, 10.0]},
        dims=("y", "x"),
    )
    values.to_dataset(name="E").to_netcdf(tmp_path / "modulus.nc", engine="h5netcdf")
    text = json.dumps(with_rule(stiffness={"file": "modulus.nc", "variable": "E"}))
    (tmp_path / "plate.yaml").write_text(text)
    experiment = pbdkit.load(tmp_path / "plate.yaml")
    field = experiment.rule.varying["stiffness"]
    x, y = np.array([1.0, 4.0]), np.array([2.0, 6.0])
    np.testing.assert_allclose(field.at(x, y, {}), values.interp(x=("n", x), y=("n", y)))
    assert pbdkit.Experiment(**experiment.model_dump(mode="json")) == experiment


@pytest.fixture
def field_file(tmp_path):
    values = xarray.DataArray(
        np.arange(1.0, 55.0).reshape(9, 6), {"x": np.arange(9.0), "y": np.arange(6.0)}, ("x", "y")
    )
    path = tmp_path / "m.nc"
    values.to_dataset(name="E").to_netcdf(path, engine="h5netcdf")
    return path


def test_damaged_field_file_is_refused_by_name_without_output(field_file, monkeypatch):
    """Whatever the libraries below make of it: bytes changed by chance, the end missing."""
    noise: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", noise.append)
    sound, refused = field_file.read_bytes(), list[str]()
    for seed in range(8):
        by_chance = random.Random(seed)
        damaged = bytearray(sound)
        for _ in range(by_chance.choice([1, 2, 5, 20])):
            start = by_chance.randrange(len(damaged))
            damaged[start : start + 8] = by_chance.randbytes(8)
        field_file.write_bytes(damaged[: by_chance.choice([None, len(damaged) // 2])])
        try:
            read_field({"file": "m.nc", "variable": "E"}, FileResolver(field_file.parent))
        except ValueError as error:
            refused.append(str(error))
    gc.collect()
    assert len(refused) > 4
    assert all(text.startswith(f"{field_file}") and "\n" not in text for text in refused)
    assert not noise


@pytest.mark.parametrize("fault", [RuntimeError, OSError])
def test_exception_while_reading_a_field_names_the_file(field_file, fault, monkeypatch):
    library = f"raise {fault.__name__}('Unspecified error in\\n  H5DSget_num_scales')"
    (field_file.parent / "h5netcdf.py").write_text(library)
    monkeypatch.syspath_prepend(field_file.parent)
    text = json.dumps(with_rule(stiffness={"file": "m.nc", "variable": "E"}))
    (field_file.parent / "plate.yaml").write_text(text)
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.load(field_file.parent / "plate.yaml")
    assert "rule.stiffness" in str(caught.value)
    assert str(caught.value).endswith(
        f"{field_file}: cannot be read as netCDF-4: Unspecified error in H5DSget_num_scales"
    )


def test_grid_is_bilinear_inside_and_undefined_outside():
    field = Gridded([0.0, 1.0, 3.0], [0.0, 2.0], [[1.0, 3.0], [2.0, 4.0], [4.0, 6.0]])
    x, y = np.meshgrid(np.linspace(0.0, 3.0, 7), np.linspace(0.0, 2.0, 5))
    np.testing.assert_allclose(field.at(x, y, {}), 1.0 + x + y)
    assert np.isnan(field.at(np.array([-0.1]), np.array([1.0]), {})).all()


@pytest.mark.parametrize(
    ("rule", "place", "text"),
    [
        ({"stiffness": {"otherwise": 1.0, "disk": 2.0}}, "rule.stiffness", "did you mean 'disc'"),
        ({"stiffness": {"disc": 2.0}}, "rule.stiffness", "`otherwise` is missing"),
        ({"stiffness": {"otherwise": 1.0, "disc": "x"}}, "rule.stiffness", "'disc' should be a"),
        ({"stiffness": {"otherwise": 1.0, "disc": -2.0}}, "rule.stiffness", "disc: should be gre"),
        ({"poisson_ratio": {"otherwise": 0.3, "disc": 0.7}}, "rule.poisson_ratio", "got 0.7"),
        ({"stiffness": {"file": "no.nc", "variable": "E"}}, "rule.stiffness", "does not exist"),
        ({"stiffness": {"file": "no.nc"}}, "rule.stiffness", "requires the keys file and variable"),
        (
            {"stiffness": {"x": [1, 0], "y": [0], "values": [[1], [2]]}},
            "rule.stiffness",
            "increasing",
        ),
        ({"stiffness": {"x": [0], "y": [0], "values": [[1, 2]]}}, "rule.stiffness", "1 lists of 1"),
        ({"stiffness": {"x": [0], "y": [0], "values": "?"}}, "rule.stiffness", "base 64"),
        (
            {"stiffness": lambda x, y: 1 - 2 * (x > 6)},
            "rule.stiffness",
            "the smallest value: should be",
        ),
        ({"plane": {"otherwise": "stress"}}, "rule.plane", "should be 'stress' or 'strain'"),
    ],
)
def test_errors_are_reported_with_their_place(rule, place, text):
    with pytest.raises(pbdkit.ExperimentError, match="^" + place.replace(".", r"\.")) as caught:
        pbdkit.Experiment(**with_rule(**rule))
    assert text in str(caught.value)


def test_a_place_outside_the_data_is_an_error():
    field = {"x": [0.0, 5.0], "y": [0.0], "values": [[1.0], [2.0]]}
    with pytest.raises(
        pbdkit.ExperimentError, match=r"rule\.stiffness: has no value at \(6\.5, 0\.5\)"
    ):
        pbdkit.run(with_rule(stiffness=field), progress=False)


def test_regions_are_named_places():
    for regions, text in (
        ({"file": DISC}, "and must not be one of otherwise, file, steps"),
        ({"grid": {"type": "grid", "columns": 3, "rows": 3}}, "use a rectangle"),
    ):
        with pytest.raises(pbdkit.ExperimentError, match=text):
            pbdkit.Experiment(**GIVEN | {"regions": regions})


def test_leaders_are_selected_by_region():
    leaders = [{"select": {"region": "disc"}, "motion": {"type": "hold"}}]
    ds = pbdkit.run(GIVEN | {"leaders": leaders}, progress=False)
    X = ds["reference"].values
    inside = np.hypot(*(X - DISC["centre"]).T) <= 2.0
    np.testing.assert_array_equal(ds["kind"].isel(time=-1).values == 0, inside)
    leaders[0]["select"] = {"region": "disk"}
    with pytest.raises(pbdkit.ExperimentError, match=r"select\.region: there is no region"):
        pbdkit.run(GIVEN | {"leaders": leaders}, progress=False)


def test_each_material_is_identified():
    experiment = pbdkit.Experiment(**with_rule(poisson_ratio={"otherwise": 0.3, "disc": 0.1}))
    materials = experiment.materials()
    assert {name: one.rule.poisson_ratio for name, one in materials.items()} == {
        "otherwise": 0.3,
        "disc": 0.1,
    }
    first = pbdkit.identify(materials["otherwise"])
    assert pbdkit.identify(experiment).as_dict() == first.as_dict()


@pytest.mark.parametrize("given", [1.0, 3, None, "0.3", [1.0]])
def test_other_values_are_left_to_the_parameter(given):
    assert as_varying(given) is None


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        (
            {"fracture": {"type": "strain", "failure": {"otherwise": 0.1}, "scatter": 0.2}},
            r"fracture\.failure: 'strain' draws a random number for each bond",
        ),
        (
            {"rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": {"otherwise": 1}}},
            r"rule\.length: 'strain-gradient' applies a rule to the moves of another",
        ),
        (
            {
                "fracture": {
                    "type": "strain",
                    "failure": 0.1,
                    "placement": {"otherwise": 1.0, "disc": 1.2},
                }
            },
            r"fracture\.placement: 'placement' of 'strain' is not a limit of bonds",
        ),
        (
            {
                "fracture": {
                    "type": "damage",
                    "onset": {"x": [0, 8], "y": [0], "values": [[0.05], [0.3]]},
                    "failure": {"x": [0, 8], "y": [0], "values": [[0.4], [0.1]]},
                }
            },
            r"^fracture\.onset: at \(7\.5, 0\): onset 0\.284375 is not below failure 0\.11875",
        ),
    ],
)
def test_unsupported_uses_of_fields_are_refused(parts, text):
    with pytest.raises(pbdkit.ExperimentError, match=text):
        build_scene(pbdkit.Experiment(**GIVEN | parts))
