"""Components with state variables: invalid combinations, and their messages."""

from typing import Literal

import numpy as np
import pytest
from property_cases import pull_right
from remembering_parts import Tiring, Weakest

import pbdkit
from pbdkit.plugin import Remembered
from pbdkit.scene.constants import _evaluate as evaluate
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

LEFT = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "rule": {"type": "barycentre"},
    "leaders": [LEFT, pull_right(0.3, 0.1, 5)],
    "steps": 5,
}


class Plain(pbdkit.FractureModel):
    """Breaks nothing; subclasses remember what they should not."""

    type: str = "plain"

    def constants(self, slot):
        return {}

    @staticmethod
    def breaks(d, r, c, p):
        return d.x > 1e9

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r


class Keeping(pbdkit.plugin.Remembers, Plain):
    def remembered(self):
        return (Remembered("age", "age", "step"),)


class Shortened(pbdkit.plugin.Draws, Keeping):
    def draw(self, bonds, generator):
        return {"age": np.zeros(3)}


class Infinite(pbdkit.plugin.Draws, Keeping):
    def draw(self, bonds, generator):
        return {"age": np.full(len(bonds), np.inf)}


class Misspelt(pbdkit.plugin.Draws, Keeping):
    def draw(self, bonds, generator):
        return {"agee": np.zeros(len(bonds))}


class Twice(Keeping):
    def remembered(self):
        return (Remembered("age", "age", "step"), Remembered("age", "age", "step"))


class Taken(Keeping):
    def remembered(self):
        return (Remembered("shell", "age", "step"),)


class Worded(Keeping):
    def remembered(self):
        return (Remembered("the age", "age", "step"),)


class Typed(Keeping):
    def remembered(self):
        return (Remembered("age", "age", "step", dtype="f4"),)


class Generous(pbdkit.plugin.RenewsBonds, Keeping):
    @staticmethod
    def update(d, r, c, p):
        return c.age + 1, c.age


class Bare(pbdkit.plugin.RenewsBonds, Keeping):
    @staticmethod
    def update(d, r, c, p):
        return c.age + 1


class Loose(pbdkit.plugin.Remembers, Plain):
    def remembered(self):
        return Remembered("age", "age", "step")


class Tangled(Plain):
    """Breaks at once, so that fictitious points are used."""

    type: str = "tangled"

    @staticmethod
    def breaks(d, r, c, p):
        return d.x * d.x > 1e-9

    @staticmethod
    def fictitious(u, r, p):
        return 0.0, 0.0


class Measured(Plain):
    @staticmethod
    def breaks(d, r, c, p):
        return d.x


class Silent(Plain):
    @staticmethod
    def breaks(d, r, c, p):
        pass


class Misshapen(Plain):
    @staticmethod
    def breaks(d, r, c, p):
        return d.x[..., :-1] > 0.0


class Constant(Plain):
    def constants(self, slot):
        return 1.0


class Fractional(pbdkit.plugin.RenewsBonds, Keeping):
    def remembered(self):
        return (Remembered("age", "age", "step", dtype="i4"),)

    @staticmethod
    def update(d, r, c, p):
        return (c.age + 0.5,)


class Exploding(pbdkit.plugin.RenewsBonds, Keeping):
    @staticmethod
    def update(d, r, c, p):
        return ((c.age + 1.0) * 1e200,)


class Writing(pbdkit.plugin.RenewsBonds, Keeping):
    @staticmethod
    def update(d, r, c, p):
        c.age[...] = 1.0
        return (c.age,)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (Shortened, r"'plain' draws 'age' with the shape \(3,\), finite: True; expected"),
        (Infinite, r"'plain' draws 'age' with the shape \(\d+,\), finite: False; expected"),
        (
            Misspelt,
            "'plain' draws 'agee', which is not among its state variables; did you mean 'age'?",
        ),
        (Twice, "the number 'age' is declared 2 times, by FractureModel 'plain' and FollowerRule"),
        (Taken, "declares the state variable 'shell' of each bond, but the dataset already has"),
        (Worded, "'the age' is not a valid name of a variable; use letters, digits and _"),
        (Typed, "'age' has the dtype 'f4'; expected one of f8, i1, i2, i4, i8"),
        (Generous, "it returned 2 values for 1 changing state variables; declare `changes=False`"),
        (Bare, "in `update` for .*: `update` returned ndarray, not a tuple; write `\\(value,\\)`"),
        (Loose, "to declare its remembered numbers: `remembered` returned Remembered, not a tuple"),
        (
            Tangled,
            "'tangled' failed .* in `fictitious` for .*: `fictitious` returned tuple; return a vec",
        ),
        (
            Measured,
            (
                "'plain' failed .* in `breaks` for .*: `breaks` returned float64, not booleans; "
                "return a comparison, as in"
            ),
        ),
        (
            Silent,
            (
                "'plain' failed .* in `breaks` for .*: `breaks` returned None, not booleans; "
                "return a comparison, as in"
            ),
        ),
        (
            Misshapen,
            r"`breaks` for .* returned the shape \(63,\) for 64 bonds, in its value; return",
        ),
        (Constant, "to return its constants: TypeError: it returned float; return numbers by name"),
        (Fractional, "beginning of the run in `update`.*same_kind"),
        (Writing, "`update` for bonds .* writes into its arguments; make new arrays"),
    ],
)
def test_component_that_violates_the_interface(model, message):
    with pytest.raises(pbdkit.PluginError, match=f"(?s){message}"):
        pbdkit.run(SHEET | {"fracture": model()}, progress=False)


def test_overflow_ends_the_run():
    with pytest.raises(pbdkit.DivergedError, match="age at step 2") as caught:
        pbdkit.run(SHEET | {"fracture": Exploding()}, progress=False)
    assert np.isfinite(caught.value.dataset.age).all()


class Aged(pbdkit.Diagnostic):
    type: Literal["aged"] = "aged"

    def variables(self):
        return (pbdkit.plugin.Variable("age", (), "oldest bond", "step"),)

    def measure(self, now):
        return (now.remembered("age").max(),)


def test_diagnostic_records_state_variables_under_its_own_name():
    with pytest.raises(
        pbdkit.ExperimentError, match=("adds the variable 'age'; so does fracture; remove one")
    ):
        pbdkit.run(SHEET | {"fracture": Keeping(), "diagnostics": [Aged()]}, progress=False)
    with pytest.raises(pbdkit.PluginError, match="no component has a state variable 'age'"):
        pbdkit.run(SHEET | {"diagnostics": [Aged()]}, progress=False)


class Odd(pbdkit.Diagnostic):
    type: Literal["odd"] = "odd"
    at_end = True
    own_dimension = "odd"

    def variables(self):
        one, other = (pbdkit.plugin.Variable(n, ("odd",), n, "1") for n in ("one", "other"))
        return one, other

    def measure(self, now):
        return np.zeros(3), np.zeros(4)


def test_own_dimension_has_one_length():
    with pytest.raises(pbdkit.PluginError, match=r"shape \(4,\) for 'other', expected \(3,\)"):
        pbdkit.run(SHEET | {"diagnostics": [Odd()]}, progress=False)


def test_rule_with_state_has_no_equilibrium():
    given = SHEET | {"rule": Tiring(), "solver": {"type": "equilibrium"}}
    message = "the rule 'tiring' depends on the history, so that there is no equilibrium that is"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(given, components=[Tiring], progress=False)


def test_without_state_variables_nothing_is_stored():
    whole = initial_state(build_scene(pbdkit.Experiment(**SHEET)))
    assert (whole.broken_step, whole.broken_length) == (None, None)
    assert whole.bond_values == whole.particle_values == ()
    torn = {"type": "threshold", "thresholds": [2.0]}
    state = initial_state(build_scene(pbdkit.Experiment(**SHEET | {"fracture": torn})))
    assert state.bond_values == state.particle_values == ()


def test_bonds_that_keep_changing_are_no_equilibrium(monkeypatch, interpreted):
    class Restless(Weakest):
        type: Literal["restless"] = "restless"

        @staticmethod
        def update(d, r, c, p):
            return c.damage, c.visits + 1

    monkeypatch.setattr("pbdkit.equilibrium.load_stepping.MAX_BOND_CHANGES", 5)
    given = SHEET | {"fracture": Restless(), "solver": {"type": "equilibrium"}}
    with pytest.raises(pbdkit.DivergedError, match="bonds still change after 5 equilibria"):
        pbdkit.run(given, progress=False)


class Scaled(Plain):
    limit: float = 1.0


ALIKE = [np.square, lambda x: float(x) ** 2, lambda x: 2.0]
NOT_BY_PLACE = [np.max, np.size, lambda x: x / np.max(x), lambda x: x - np.mean(x)]


@pytest.mark.parametrize("function", [*ALIKE, *NOT_BY_PLACE])
def test_constants_of_varying_parameters_are_those_of_each_place_alone(function):
    """Functions of parameters need not support arrays."""
    limits = np.array([3.0, 1.0, 2.0, 2.0, 5.0, 4.0])
    found = evaluate(Scaled(), {"limit": limits}, lambda part: {"k": function(part.limit)})["k"]
    np.testing.assert_array_equal(found, [function(limit) for limit in limits.tolist()])
