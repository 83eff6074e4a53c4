"""Units: inputs that name one, results in mm, MPa and N, the lattice's own numbers as they were."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import jsonschema
import numpy as np
import pytest

import pbdkit
from pbdkit.io.layout import dataset_schema, optional_columns
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.physical import Physical
from pbdkit.model.reading import Source
from pbdkit.model.schema import experiment_schema
from pbdkit.plotting.style import in_its_units
from pbdkit.plugin import units as units_module
from pbdkit.plugin.registry import Registry
from pbdkit.plugin.units import (
    AREA,
    ENERGY,
    FORCE,
    FRACTURE_ENERGY,
    LENGTH,
    STRESS,
    Units,
)
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

UNITS = {"length": "0.25 mm", "youngs_modulus": "206 GPa", "thickness": "3.05 mm"}
BAR: dict[str, Any] = {
    "name": "bar",
    "units": UNITS,
    "lattice": {"type": "square", "a": "0.5 mm"},
    "body": {"type": "rectangle", "width": "4 mm", "height": "0.2 cm"},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "elastic", "poisson_ratio": 0.0},
    "frame": {"type": "natural"},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "displace", "displacement": ["4 µm", 0.0]},
        },
    ],
    "steps": 1,
    "solver": {"type": "equilibrium"},
    "diagnostics": [
        {"type": "displacement"},
        {"type": "stress"},
        {"type": "reaction"},
        {"type": "strain-energy"},
        {"type": "pe1"},
        {"type": "track", "numbers": [3]},
    ],
}
STEPPED = {k: v for k, v in BAR.items() if k not in ("solver", "steps")}


def run(given: dict[str, Any], **changes: Any) -> Any:
    return pbdkit.run(given | changes, progress=False)


def changed(**parts: Any) -> dict[str, Any]:
    """The bar with parts replaced; None leaves one out."""
    return {key: value for key, value in (BAR | parts).items() if value is not None}


@pytest.fixture(scope="module")
def bar() -> Any:
    return run(BAR)


def test_a_bar_has_the_stress_the_force_and_the_energy_of_the_textbook(bar: Any) -> None:
    """Without Poisson's effect: ε = 1e-3, σ = E ε, N = σ w t, W = N Δ / 2."""
    last = bar.isel(time=-1)
    assert last.stress_xx.values == pytest.approx(206.0, rel=1e-9)
    assert last.reaction.values[1, 0] == pytest.approx(206.0 * 2.0 * 3.05, rel=1e-9)
    assert last.strain_energy.item() == pytest.approx(206.0 * 2.0 * 3.05 * 4e-3 / 2, rel=1e-9)
    assert last.u_mm.values[:, 0] == pytest.approx(1e-3 * last.reference_mm.values[:, 0], abs=1e-12)
    units = {name: bar[name].units for name in ("stress_xx", "reaction", "strain_energy", "u_mm")}
    assert [*units.values()] == ["MPa", "N", "mJ", "mm"]


def test_load_and_its_displacement_match_the_textbook() -> None:
    load = {"select": {"edge": "right"}, "force": [1.0e-3, 0.0]}
    held = BAR["leaders"][:1]
    ds = run(BAR, leaders=held, loads=[load], diagnostics=[{"type": "load-displacement"}])
    last, force = ds.isel(time=-1), 1.0e-3 * 206e3 * 3.05 * 0.25
    assert last.load_resultant.values[0, 0] == pytest.approx(force, rel=1e-12)
    assert last.load_displacement_mm.values[0, 0] == pytest.approx(
        force * 4.0 / (206e3 * 2.0 * 3.05), rel=1e-9
    )
    assert (ds.load_resultant.units, ds.load_displacement_mm.units) == ("N", "mm")


def test_shipped_strip_recovers_its_modulus_and_force() -> None:
    ds = run(json.loads(pbdkit.load("modelling/strip").model_dump_json())).isel(time=-1)
    stress = ds.nominal_stress.item()
    assert stress / ds.nominal_strain.item() == pytest.approx(206e3, rel=1e-6)
    assert ds.reaction.values[1, 0] == pytest.approx(stress * 12.5 * 3.05, rel=1e-12)
    middle = np.isclose(ds.reference_mm.values[:, 0], 50.0)
    assert ds.stress_xx.values[middle] == pytest.approx(stress, rel=1e-6)


def test_lattice_values_equal_those_without_units_bit_for_bit(bar: Any) -> None:
    plain = json.loads(pbdkit.Experiment(**BAR).model_dump_json())
    del plain["units"]
    moduli = {"youngs_modulus": 206e3}, {"youngs_modulus": 206e3, "thickness": 3.05}
    given = dict(zip(("stress", "reaction", "strain-energy"), (*moduli, moduli[1]), strict=True))
    plain["diagnostics"] = [d | given.get(d["type"], {}) for d in plain["diagnostics"]]
    other = run(plain)
    assert {*bar.variables} - {*other.variables} == {
        "reference_mm",
        "X_mm",
        "Y_mm",
        "u_mm",
        "track_mm",
    }
    for name in {*other.variables} - {"reaction", "strain_energy"}:
        np.testing.assert_array_equal(bar[name], other[name])
    np.testing.assert_array_equal(bar.reaction, 0.25 * other.reaction)
    assert "units" not in json.loads(other.experiment)
    assert "physical_factor" not in other.position.attrs


def test_variables_have_both_scales(bar: Any) -> None:
    assert bar.position.attrs["units"] == "lattice unit"
    said = bar.pe1.attrs
    assert (said["physical_units"], said["physical_factor"]) == ("mm^2", 0.0625)
    assert in_its_units(bar.position.attrs) == (0.25, "mm")
    own = bar.reaction.attrs
    assert own["lattice_units"] == "youngs_modulus * thickness * lattice unit"
    assert own["lattice_factor"] == pytest.approx(1 / (206e3 * 3.05 * 0.25))
    jsonschema.validate(bar.to_dict(data=False), dataset_schema(Registry()))


def test_accessor_converts_all_variables_with_a_scale(bar: Any) -> None:
    physical = bar.pbd.physical()
    assert physical.position.units == "mm"
    np.testing.assert_array_equal(physical.position, 0.25 * bar.position)
    np.testing.assert_array_equal(physical.u, bar.u_mm)
    np.testing.assert_array_equal(physical.reaction, bar.reaction)
    assert "u_mm" not in physical
    assert {*physical.coords} == {*bar.coords} - {"reference_mm", "X_mm", "Y_mm"}


@pytest.mark.parametrize(
    ("more", "unit", "factor"),
    [({}, "mm^2", 4.0), ({"youngs_modulus": "3 MPa", "thickness": "5 mm"}, "mJ", 60.0)],
)
def test_dissipated_energy_is_converted_to_an_energy(
    more: dict[str, str], unit: str, factor: float
) -> None:
    each = [column for group in optional_columns() for column in group]
    (column,) = (column for column in each if column.name == "dissipated_energy")
    (described,) = Physical(Units(length="2 mm", **more)).columns([column])
    assert described.extra["physical_units"] == unit
    assert described.extra["physical_factor"] == pytest.approx(factor)


def test_units_of_a_converted_dataset_are_known_to_pint(bar: Any) -> None:
    pint = pytest.importorskip("pint", reason="pint is not installed")
    physical, registry = bar.pbd.physical(), pint.UnitRegistry()
    units = {v.attrs["units"] for v in physical.variables.values() if "units" in v.attrs}
    assert {"mm", "mm^2", "MPa", "N", "mJ", "1"} <= units
    for unit in units:
        registry.parse_units(unit)
    assert physical.time.attrs["lattice_units"] == "step"
    assert not bar.attrs["Conventions"].startswith("CF")  # "lattice unit" is no unit of UDUNITS.


def test_dataset_reruns_and_records_in_single_precision(bar: Any) -> None:
    assert pbdkit.rerun(bar, progress=False).equals(bar)
    single = run(BAR, record={"dtype": "float32"})
    assert single.u_mm.dtype == np.float32
    assert single.reference_mm.dtype == np.float64


def test_file_is_continued_bit_for_bit(tmp_path: Any) -> None:
    def made(steps: int) -> Any:
        path, scene = (
            tmp_path / f"{steps}.nc",
            build_scene(pbdkit.Experiment(**STEPPED, steps=steps)),
        )
        record(Simulation.of_scene(scene), NetcdfSink(path))
        return path

    with pbdkit.resume(made(2), steps=4, progress=False) as ds, pbdkit.open(made(4)) as whole:
        assert ds.equals(whole)
        assert ds.u_mm.equals(0.25 * ds.u)


def test_check_prints_the_size_of_the_body(call: Any) -> None:
    Path("bar.json").write_text(json.dumps(BAR))
    assert "size       4 × 2 mm" in call("check", "bar.json").out
    assert json.loads(call("check", "bar.json", "--json").out)["size_mm"] == [4.0, 2.0]


def test_sweep_over_the_lattice_unit_refines_lengths_in_mm() -> None:
    vary = {"units.length": ["0.25 mm", "0.5 mm"], "units.youngs_modulus": ["206 GPa", "70 GPa"]}
    bar = changed(lattice={"type": "square", "a": 2.0}, diagnostics=BAR["diagnostics"][:3])
    ds = pbdkit.sweep(bar, vary=vary, keep={"times": "last"}, workers=1, progress=False).isel(
        time=-1
    )
    force = ds.reaction.isel(leader_group=1, axis=0)
    assert force.values == pytest.approx(2 * 3.05 * np.array([[206.0, 70.0]] * 2))
    assert ds.u_mm.max("particle").values[..., 0] == pytest.approx(np.full((2, 2), 4e-3))
    assert "physical_factor" not in ds.position.attrs  # the scale differs from member to member
    assert ds.position.attrs["physical_units"] == "mm"


def test_sweep_in_lattice_units_changes_only_the_scale() -> None:
    numbers = pbdkit.Experiment(**json.loads(pbdkit.Experiment(**BAR).model_dump_json()))
    vary = {"units.youngs_modulus": ["206 GPa", "103 GPa"]}
    kept = {"times": "last", "variables": ["u_mm", "stress_xx"]}
    ds = pbdkit.sweep(numbers, vary=vary, keep=kept, workers=1, progress=False).isel(time=-1)
    assert ds.stress_xx.mean("particle").values == pytest.approx([206.0, 103.0])
    assert {*ds.data_vars} == {"u_mm", "stress_xx", "status", "message"}


@pytest.mark.parametrize(
    ("quantity", "text", "number"),
    [
        (LENGTH, "5 mm", 20.0),
        (LENGTH, "1e-3 m", 4.0),
        (AREA, "1 mm²", 16.0),
        (STRESS, "206 N/mm**2", 1e-3),
        (FORCE, "1 kN", 1e3 / (206e3 * 3.05 * 0.25)),
        (ENERGY, "2 N mm", 2 / (206e3 * 3.05 * 0.0625)),
    ],
)
def test_third_party_component_takes_units(quantity: Any, text: str, number: float) -> None:
    class Pulled(pbdkit.FollowerRule):
        type: Literal["pulled"] = "pulled"
        by: Annotated[float, quantity]

        @staticmethod
        def gather(d: Any, r: Any, w: Any, p: Any) -> Any:
            return (d,)

        @staticmethod
        def apply(sums: Any, here: Any, p: Any) -> Any:
            return p.by * sums[0]

    for given in (text, number):
        parts = changed(rule={"type": "pulled", "by": given}, diagnostics=[], frame=None)
        made = pbdkit.Experiment.build(Source(data=parts), [Pulled])
        assert made.rule.by == pytest.approx(number, rel=1e-14)  # type: ignore[attr-defined]


SHIFTED = {"type": "affine", "gradient": [["1 mm", 0.0], [0.0, 0.0]]}
STRESS_OF = [{"type": "stress", "youngs_modulus": 70e3}]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"units": None}, "lattice.a: '0.5 mm' has a unit, but the lattice unit is not defined"),
        ({"units": {"length": 0.25}}, "units.length: expected a length with its unit, as in 1 mm"),
        ({"units": {"length": "0 mm"}}, "units.length: should be greater than 0 and finite"),
        (
            {"units": {"length": "3 kg"}},
            "units.length: '3 kg' is not a length; write for instance mm",
        ),
        ({"units": {"length": "3 mn"}}, "units.length: '3 mn': there is no unit 'mn'"),
        (
            {"units": {"length": "3 mm**9**9**9"}},
            "units.length: '3 mm**9**9**9' is not a number with",
        ),
        ({"units": {"lenght": "3 mm"}}, "units.lenght: unknown key; did you mean 'length'?"),
        ({"units": UNITS | {"thickness": "2 GPa"}}, "units.thickness: '2 GPa' is not a length"),
        ({"lattice": {"type": "square", "a": "2 s"}}, "lattice.a: '2 s' is not a length"),
        ({"lattice": {"type": "square", "a": "2"}}, "lattice.a: should be a valid number, got '2'"),
        ({"lattice": {"type": "square", "a": "-1 mm"}}, "lattice.a: should be greater than"),
        ({"initial": SHIFTED}, "got '1 mm'; expected a plain number without a unit"),
        (
            {"units": {"length": "1 mm"}},
            "diagnostics.1.youngs_modulus: is missing; give it here, or as units.youngs_modulus",
        ),
        (
            {"units": {"length": "1 mm", "youngs_modulus": "1 GPa"}},
            "diagnostics.2.thickness: is missing; give it here, or as units.thickness",
        ),
        (
            {"diagnostics": STRESS_OF},
            "70000 differs from 206000 of units.youngs_modulus; remove it",
        ),
    ],
)
def test_errors_have_their_place(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.Experiment(**changed(**parts))
    assert message in str(caught.value)


def test_missing_modulus_has_a_remedy_without_units() -> None:
    parts = {
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "neighbours": {"type": "chebyshev", "shells": 1},
    }
    reaction = [{"type": "reaction"}]
    with pytest.raises(pbdkit.ExperimentError, match=r"units.youngs_modulus; or write youngs_mod"):
        pbdkit.load("paper/a", settings=parts | {"diagnostics": reaction})
    relative = pbdkit.load(
        "paper/a", settings=parts | {"diagnostics": [{"type": "reaction", "youngs_modulus": 1}]}
    )
    assert relative.diagnostics[0].thickness == 1.0


def test_modulus_of_a_diagnostic_is_used_without_one_in_units() -> None:
    ds = run(changed(units={"length": "0.25 mm"}, diagnostics=STRESS_OF))
    assert ds.stress_xx.attrs["units"] == "stress unit"
    assert ds.stress_xx.isel(time=-1).values == pytest.approx(70.0)


def test_force_requires_a_modulus() -> None:
    with pytest.raises(
        ValueError, match=r"a force requires units.youngs_modulus, which is missing"
    ):
        Units(length="1 mm").scale(FORCE)


def test_schema_accepts_numbers_and_strings() -> None:
    schema = experiment_schema(Registry(), installed=False)
    jsonschema.validate(BAR, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(changed(lattice={"type": "square", "a": "mm"}), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(changed(lattice={"type": "square", "a": -1.0}), schema)


def test_without_pint_the_message_names_the_package(monkeypatch: Any) -> None:
    units_module._registry.cache_clear()
    monkeypatch.setitem(sys.modules, "pint", None)
    with pytest.raises(pbdkit.ExperimentError, match=r"pip install 'pbdkit\[units\]'"):
        pbdkit.Experiment(**BAR)


def test_pint_is_imported_only_for_experiments_with_units() -> None:
    look = "pbdkit.load('{}'); print('pint' in sys.modules)"
    looks = [look.format(name) for name in ("material/bar", "modelling/strip")]
    command = [sys.executable, "-c", "\n".join(["import sys, pbdkit", *looks])]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "True"], done.stderr


def test_check_prints_forces_as_in_the_file(call: Any) -> None:
    for load, told in {
        "{select: {edge: right}, force: [2 kN, 0.0]}": "force [2, 0] kN",
        "{select: {edge: right}, force: [20 N, 0.0]}": "force [20, 0] N",
        "{select: {edge: right}, body_force: [0.0, -0.5 N/mm^2]}": "body force [0, -0.5] N/mm²",
    }.items():
        settings = ["--set", f"loads.0={load}", "--set", "units.length=4 mm"]
        assert told in call("check", "modelling/composite-plate", *settings).out


def test_distance_from_equilibrium_is_printed_in_mm(call: Any) -> None:
    given = ["paper/a", "--set", "units={length: 2 mm}"]
    told = call("check", *given, "--verbose").out
    assert "moves by 0.7 mm per step, which brings the body 4.09 mm from equilibrium" in told
    assert "more than a bond (2 mm)" in told
    assert "mm from equilibrium if the leaders continue at their fastest" in told


def test_quantities_in_target_units_are_read_without_pint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pbdkit.plugin.units._registry", lambda: pytest.fail("pint is used"))
    assert Units(length="2.5 mm", youngs_modulus="3000 MPa").length_mm == 2.5


def dogbone(*settings: str) -> pbdkit.Experiment:
    return pbdkit.load("modelling/dogbone-to-failure", settings=settings)


def test_a_strength_is_divided_by_youngs_modulus() -> None:
    assert dogbone("fracture.failure=66 MPa").fracture.failure == pytest.approx(0.02)
    damage = "fracture={type: damage, onset: 0.033 GPa, failure: 0.2}"
    assert dogbone(damage).fracture.onset == pytest.approx(0.01)
    with pytest.raises(pbdkit.ExperimentError, match="'66 mm' is not a stress; write for instance"):
        dogbone("fracture.failure=66 mm")
    plain = ["units={length: 1 mm}", "diagnostics=[]", "fracture.failure=66 MPa"]
    with pytest.raises(
        pbdkit.ExperimentError, match=r"fracture\.failure: a stress requires units\.you"
    ):
        dogbone(*plain)


class Tough(pbdkit.FractureModel):
    """Has an energy as its parameter."""

    type: Literal["tough"] = "tough"
    energy: Annotated[float, FRACTURE_ENERGY] = 0.1
    can_break = False

    def constants(self, slot: pbdkit.plugin.Slot) -> dict[str, float]:
        return {}

    @staticmethod
    def breaks(d: Any, r: Any, c: Any, p: Any) -> Any:
        return False

    @staticmethod
    def fictitious(u: Any, r: Any, p: Any) -> Any:
        return u


@pytest.mark.parametrize(
    "energy",
    ["6.6 N/mm", "6600 J/m^2", "6.6 kJ/m**2", "2 um", 0.004, "{otherwise: 6.6 N/mm}"],
)
def test_fracture_energy_is_per_area_or_per_length(energy: Any) -> None:
    settings = ["units.length=0.5 mm", f"fracture={{type: tough, energy: {energy}}}"]
    loaded = pbdkit.load("modelling/dogbone-to-failure", components=[Tough], settings=settings)
    assert loaded.fracture.energy == pytest.approx(0.004)


def test_cohesive_takes_measured_material_properties() -> None:
    given = "fracture={type: cohesive, energy: 0.5 N/mm, onset: 66 MPa}"
    fracture = dogbone("units.length=0.5 mm", given).fracture
    assert (fracture.energy, fracture.onset) == pytest.approx((0.5 / 3300 / 0.5, 66 / 3300))


def test_invalid_fracture_energy_is_refused_with_the_expected_unit() -> None:
    with pytest.raises(
        pbdkit.ExperimentError, match="'3 kg' is not a fracture energy; write for instance N/mm"
    ):
        pbdkit.load(
            "modelling/dogbone-to-failure",
            components=[Tough],
            settings=["fracture={type: tough, energy: 3 kg}"],
        )


def test_fields_and_schedules_take_units_like_numbers() -> None:
    steel = "regions={neck: {type: disc, radius: 3.0, centre: [30 mm, 10 mm]}}"
    field = "fracture={type: strain, failure: {otherwise: 66 MPa, neck: 0.01}}"
    (varying,) = dogbone(steel, field).fracture.varying.values()
    assert varying.samples == {"otherwise": pytest.approx(0.02), "neck": 0.01}
    course = "fracture={type: strain, failure: {steps: [0, 9], values: [66 MPa, 33 MPa]}}"
    assert dogbone(course).time_dependent["fracture", "failure"].at(9) == pytest.approx(0.01)
    chance = (
        "fracture={type: strain, failure: {mean: 66 MPa, scatter: 0.1, correlation_length: 4 mm}}"
    )
    (drawn,) = dogbone(chance).fracture.varying.values()
    assert drawn.mean == pytest.approx(0.02)
    with pytest.raises(pbdkit.ExperimentError, match="'66 mm' is not a stress"):
        dogbone("fracture={type: strain, failure: {otherwise: 66 mm}}")


def test_cuts_take_lengths() -> None:
    (cut,) = dogbone("units.length=0.5 mm", "cuts=[{from: [10 mm, 0.0], to: [1 cm, 2 mm]}]").cuts
    assert cut.segment == ((20.0, 0.0), (20.0, 4.0))
