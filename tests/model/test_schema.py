"""The schemas in schemas/ are current, and describe what is accepted and made."""

import json
import math
from pathlib import Path

import jsonschema
import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.equilibrium import breaking_kernel
from pbdkit.fitting.fit_file import fit_schema, shipped_fits
from pbdkit.io.layout import dataset_schema
from pbdkit.model.reading import read_file
from pbdkit.model.schema import experiment_schema
from pbdkit.model.shipped import read_experiment, shipped_names
from pbdkit.plugin.registry import Registry
from pbdkit.sweeps.specification import sweep_schema

SCHEMAS = Path(__file__).parents[2] / "schemas"
EXPERIMENT = experiment_schema(Registry(), installed=False)
DATASET = dataset_schema(Registry(), installed=False)
SWEEP, FIT = sweep_schema(), fit_schema()
of_experiment, of_dataset, of_sweep, of_fit = map(
    jsonschema.Draft202012Validator, (EXPERIMENT, DATASET, SWEEP, FIT)
)


@pytest.mark.parametrize(
    ("name", "schema"),
    [("experiment", EXPERIMENT), ("dataset", DATASET), ("sweep", SWEEP), ("fit", FIT)],
)
def test_committed_schema_is_current(name, schema):
    committed = json.loads((SCHEMAS / f"{name}.schema.json").read_text())
    assert committed == json.loads(json.dumps(schema)), "make it anew, see CONTRIBUTING.md"
    jsonschema.Draft202012Validator.check_schema(schema)


@pytest.mark.parametrize("name", in_turn(shipped_names(), 2))
def test_shipped_experiments_and_their_datasets_are_described(name, monkeypatch):
    monkeypatch.setattr(breaking_kernel, "COMPILING_S", math.inf)  # compiles nothing
    data = read_experiment(name).data
    of_experiment.validate(data)
    settings = ["steps=4", "record={every: 1}"]
    if any(cut.get("at", 0) > 4 for cut in data.get("cuts", [])):
        settings.append("cuts=[]")
    if "increments" in data.get("solver", {}):
        settings.append("solver.increments=1")
    experiment = pbdkit.load(name, settings=settings)
    of_experiment.validate(json.loads(experiment.model_dump_json()))
    made = pbdkit.run(experiment, progress=False).to_dict(data=False)
    of_dataset.validate(json.loads(json.dumps(made, default=lambda a: a.tolist())))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("lattice", "type"), "sqare"),
        (("lattice",), {"a": 1.0}),
        (("rule", "k"), 1.0),
        (("leaders", 0, "select"), {}),
        (("steps",), "10"),
        (("stepz",), 10),
    ],
)
def test_the_schema_refuses_what_the_program_refuses(path, value):
    data = read_experiment("paper/a").data
    *parents, last = path
    part = data
    for key in parents:
        part = part[key]
    part[last] = value
    with pytest.raises(jsonschema.ValidationError):
        of_experiment.validate(data)
    with pytest.raises(pbdkit.ExperimentError):
        pbdkit.Experiment(**data)


def test_schema_of_sweeps_describes_the_accepted_keys():
    shipped = SCHEMAS.parent / "docs" / "stability-map.yaml"
    sweep = read_file(shipped).data
    of_sweep.validate(sweep)
    for wrong in ({"varry": {}}, {"keep": {"times": "lost"}}, {"replicates": 0}, {"experiment": 3}):
        with pytest.raises(jsonschema.ValidationError):
            of_sweep.validate(sweep | wrong)


@pytest.mark.parametrize("name", shipped_fits())
def test_shipped_fits_are_described(name):
    data = read_file(Path(pbdkit.__file__).parent / "fits" / f"{name}.yaml").data
    of_fit.validate(data)
    for wrong in ({"unknowns": {}}, {"unknown": 3}, {"measured": {"type": "fields"}}):
        with pytest.raises(jsonschema.ValidationError):
            of_fit.validate(data | wrong)


def test_one_or_several_measurements_are_described():
    data = read_file(Path(pbdkit.__file__).parent / "fits" / "plate-with-hole.yaml").data
    several = [data["measured"], {"type": "curve", "file": "f", "group": 1}]
    of_fit.validate(data | {"measured": several})
