"""Every component: frozen, pure, the same after JSON and after pickling."""

import json
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from pbdkit import Experiment, load
from pbdkit.components import pbdkit_components
from pbdkit.components.elasticity import Elastic
from pbdkit.components.fracture import NoFracture, StrainFracture, Threshold
from pbdkit.components.lattices import Hexagonal
from pbdkit.components.neighbours import Coordination
from pbdkit.components.rules import (
    Barycentre,
    DistanceWeighted,
    MeanDisplacement,
    MixedCoordinate,
    Springs,
)
from pbdkit.lattice.cells import tiling_of
from pbdkit.lattice.neighbourhood import build_neighbourhood
from pbdkit.model.shipped import shipped_names
from pbdkit.plugin import Here, Setting, Vector
from pbdkit.plugin.units import is_needed

REQUIRED = {
    "a": 1.5,
    "b": 0.1,
    "angle": 70.0,
    "K": -0.004,
    "thresholds": [6.0, 0.1],
    "numbers": [3, 1],
    "radius": 1.5,
    "failure": 0.6,
    "onset": 0.2,
    "energy": 0.05,
    "poisson_ratio": 0.3,
    "modulus_ratio": 0.5,
    "shear_ratio": 0.4,
    "length": 0.1,
    "youngs_modulus": 7.0,
    "width": 2.0,
    "between": [[0.0, 0.0], [2.0, 1.0]],
    "at": [1.6, 1.2],
}


def an_instance(component):
    """One of it, with the parameters that it cannot do without."""
    fields = component.model_fields.items()
    given = {f.alias or name: REQUIRED[f.alias or name] for name, f in fields if is_needed(f)}
    return component.model_validate(given)


every_component = pytest.mark.parametrize(
    "component", [an_instance(c) for c in pbdkit_components()], ids=lambda c: type(c).__name__
)
every_experiment = pytest.mark.parametrize("name", shipped_names())
every_rule = pytest.mark.parametrize(
    "rule",
    [
        Barycentre(),
        MeanDisplacement(),
        DistanceWeighted(),
        MixedCoordinate(K=0.3),
        Elastic(poisson_ratio=0.3),
        Springs(),
    ],
    ids=lambda r: r.type,
)


@every_component
def test_components_are_frozen(component):
    before = component.model_dump()
    for name in type(component).model_fields:
        with pytest.raises(AttributeError, match="cannot be assigned"):
            setattr(component, name, getattr(component, name))
    assert component.model_dump() == before
    assert hash(component) == hash(component.model_copy())


@every_component
def test_components_round_trip_through_json_and_pickle(component):
    kind = type(component)
    assert kind.model_validate_json(component.model_dump_json()) == component
    assert kind.model_validate(json.loads(component.model_dump_json())) == component
    assert pickle.loads(pickle.dumps(component)) == component


@every_component
def test_components_refuse_unknown_keys(component):
    with pytest.raises(ValidationError, match="nonsense"):
        type(component).model_validate(component.model_dump() | {"nonsense": 1})


@every_experiment
def test_shipped_experiments_round_trip_through_json_and_pickle(name):
    experiment = load(name)
    as_data = experiment.model_dump()
    assert Experiment(**json.loads(experiment.model_dump_json())).model_dump() == as_data
    assert Experiment(**as_data).model_dump() == as_data
    assert pickle.loads(pickle.dumps(experiment)).model_dump() == as_data


def test_equivalent_experiments_are_equal():
    one, other = load("paper/a"), load("paper/a")
    assert one == other
    assert one != load("paper/b")


def read_only(rng):
    """Return a vector of two arrays that are read-only."""
    return Vector(*map(locked, rng.normal(size=(2, 4, 3))))


def locked(array):
    array.flags.writeable = False
    return array


def constants_of(rule):
    cell = Hexagonal(a=1.0).cell()
    slots = build_neighbourhood(cell, Coordination()).slots
    setting = Setting(cell, slots, Vector(0.0, 0.0), Vector(4.0, 3.0), tiling_of(cell, slots))
    w = SimpleNamespace(**rule.weights(slots[0][0], setting), left=1.0, right=0.5)
    return slots[0][0], w, SimpleNamespace(**rule.parameters(setting))


@every_rule
def test_rules_keep_their_inputs_and_are_deterministic(rule):
    rng = np.random.default_rng(0)
    slot, w, p = constants_of(rule)
    d, here = read_only(rng), Here(read_only(rng), read_only(rng), read_only(rng))

    def target():
        parts = rule.gather(d, slot.rest, w, p)
        total = tuple(
            part.each(lambda x: locked(np.array(x))) if isinstance(part, Vector) else part
            for part in parts
        )
        return np.array(rule.apply(total, here, p))

    assert np.array_equal(target(), target())


@every_rule
def test_rules_are_elementwise(rule):
    rng = np.random.default_rng(0)
    slot, w, p = constants_of(rule)
    d, u, X = read_only(rng), read_only(rng), read_only(rng)
    whole = np.array(rule.apply(rule.gather(d, slot.rest, w, p), Here(u, X, X), p))

    def at(v, place):
        return Vector(float(v.x[place]), float(v.y[place]))

    for place in np.ndindex(4, 3):
        total = rule.gather(at(d, place), slot.rest, w, p)
        one = rule.apply(total, Here(at(u, place), at(X, place), at(X, place)), p)
        assert np.array_equal(np.array(one, float), whole[(slice(None), *place)])


@every_rule
def test_zero_differences_give_zero_displacement(rule):
    slot, w, p = constants_of(rule)
    zero, r = Vector(0.0, 0.0), slot.rest
    parts = [rule.gather(zero, end, w, p) for end in (r, -r)]
    total = tuple(a + b for a, b in zip(*parts, strict=True))
    place = Vector(3.0, 3.0)
    assert rule.apply(total, Here(zero, place, place), p) == zero


@pytest.mark.parametrize(
    "model",
    [
        NoFracture(),
        Threshold(thresholds=(1.5,)),
        Threshold(thresholds=(1.5,), placement=1.2),
        Threshold(thresholds=(1.5,), fictitious="reference"),
        StrainFracture(failure=0.5),
        StrainFracture(failure=0.5, fictitious="reference"),
    ],
    ids=["none", "cell", "loosened", "reference", "strain", "strain, reference"],
)
def test_fracture_functions_are_pure_and_symmetric_in_the_bond_ends(model):
    rng = np.random.default_rng(0)
    slot = build_neighbourhood(Hexagonal(a=1.0).cell(), Coordination()).slots[0][0]
    d, r, c = read_only(rng), slot.rest, SimpleNamespace(**model.constants(slot))
    p = SimpleNamespace(**model.parameters())
    breaks = model.breaks(d, r, c, p)
    back = model.breaks(-d, -r, c, p)
    assert np.array_equal(breaks, back)
    assert np.any(breaks) == model.can_break
    u = read_only(rng)
    lost = np.array([np.broadcast_to(part, (4, 3)) for part in model.fictitious(u, r, p)])
    again = np.array([np.broadcast_to(part, (4, 3)) for part in model.fictitious(u, r, p)])
    assert np.array_equal(lost, again)
    if getattr(model, "fictitious_at", "") == "reference":
        assert np.array_equal(lost, -np.array(u))
    else:
        expected = (getattr(model, "placement", 1.0) - 1.0) * np.array(r)
        assert np.array_equal(lost, np.broadcast_to(expected[:, None, None], lost.shape))
