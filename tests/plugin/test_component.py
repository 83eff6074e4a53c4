"""A component that loads and then fails is named with its distribution and version; it is never a
bug of pbdkit, and never the user's."""
# ruff: noqa: E501  (a row of a table is a line)

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
from plugin_sources import rule

import pbdkit

Install = Callable[..., None]
Call = Callable[..., Any]

ODD = "--set=rule={type: odd}"
WHO = "FollowerRule 'odd' of pbdkit-odd 0.3 failed "
GATHER, APPLY = "return d, 1.0", "return p.strength * total[0] / total[1]"


def method(body: str) -> tuple[str, str]:
    """A replacement that adds a method to the rule."""
    return "    @staticmethod\n    def gather", f"    {body}\n    @staticmethod\n    def gather"


WRONG = {
    "gather raises": (GATHER, "raise KeyError('g')", "KeyError: 'g' (pbdkit_odd.py, line 11)"),
    "gather exits": (GATHER, "raise SystemExit(4)", "SystemExit: 4 (pbdkit_odd.py, line 11)"),
    "gather gives one number": (GATHER, "return d.x", ", not a tuple; write `(value,)`"),
    "gather gives a bare vector": (GATHER, "return d", "`gather` returned Vector, not a tuple; write `(value,)`"),
    "gather gives nothing": (GATHER, "return None", "`gather` returned None, not a tuple; write `(value,)`"),
    "gather varies": (GATHER, "return (d, 1.0) if r.x > 0 else (d,)", " values for a neighbour and "),
    "apply gives nothing": (APPLY, "return None", "`apply` returned None; return a vector, as `pbdkit.plugin.Vector(x, y)`"),
    "apply gives a tuple": (APPLY, "return total[0].x, total[0].y", "`apply` returned tuple; return a vector, as `pbdkit.plugin.Vector(x, y)`"),
    "apply gives a vector of space": (APPLY, "return pbdkit.plugin.SpaceVector(*total[0], 0.0)", "`apply` returned SpaceVector; return a vector, as `pbdkit.plugin.Vector(x, y)`"),
    "apply gives the sums": (APPLY, "return total", "`apply` returned tuple; return a vector, as `pbdkit.plugin.Vector(x, y)`"),
    "apply gives a number": (APPLY, "return 0.0", "`apply` returned float; return a vector, as `pbdkit.plugin.Vector(x, y)`"),
    "apply gives text": (APPLY, "return 'ab'", "`apply` returned str; return a vector, as `pbdkit.plugin.Vector(x, y)`"),
    "unknown parameter": ("p.strength *", "p.strenth *", "AttributeError: 'Parameters' object has no attribute 'strenth'; did you mean 'strength'? (pbdkit_odd.py, line 15)"),
    "constants are none": (*method("def weights(self, slot, setting): return None"), "TypeError: it returned NoneType; return numbers by name: {'k': 1.0}"),
    "parameters are none": (*method("def parameters(self, setting): return None"), "TypeError: it returned NoneType; return numbers by name: {'k': 1.0}"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "reason"), WRONG.values(), ids=WRONG)
def test_run_and_check_name_the_failing_rule(
    install: Install, call: Call, old: str, new: str, reason: str
) -> None:
    source = rule("odd")
    assert old in source
    install("pbdkit-odd", source.replace(old, new), "0.3")
    for command in ("run", "check"):
        result = call(command, "e.json", ODD)
        assert result.code == 3
        assert result.err.startswith(f"pbdkit: {WHO}")
        assert reason in result.err
    assert not Path("tensile.nc").exists()


NOT_REAL = {
    "a shape of its own": (GATHER, "return pbdkit.plugin.Vector(d.x[..., 0], d.y[..., 0]), 1.0", "`gather` at the neighbour with the site offset (-1, 0) returned "),
    "apply asks": (APPLY, "return total[0] / total[1] if (total[0].x > 0) | (total[0].x <= 0) else 0.0 * total[0]", "ValueError: The truth value of an array with more than one element is ambiguous. Use a.any() or a.all(); use `pbdkit.plugin.where` instead of `if`, `and` and `or` (pbdkit_odd.py, line 15)"),
    "set in place": (APPLY, "total[0].x *= 0.5; return total[0]", "AttributeError: can't set attribute; components of a vector cannot be set; make a new one, as `Vector(0.5 * v.x, v.y)` (pbdkit_odd.py, line 15)"),
    "complex numbers": (APPLY, "return 1j * total[0]", "`apply` returned values of complex128 as its value; return numbers and vectors, computed element by element from the arguments (pbdkit_odd.py, line 13)"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "reason"), NOT_REAL.values(), ids=NOT_REAL)
def test_invalid_displacement_is_refused_before_it_is_applied(
    install: Install, call: Call, old: str, new: str, reason: str
) -> None:
    install("pbdkit-odd", rule("odd").replace(old, new), "0.3")
    result = call("run", "e.json", ODD)
    assert result.code == 3
    places = ("", " in `apply`")
    assert any(f"{WHO}at the beginning of the run{at}: {reason}" in result.err for at in places)


def test_displacement_that_is_not_finite(install: Install, call: Call) -> None:
    source = rule("odd").replace(APPLY, "return float('nan') * total[0]")
    install("pbdkit-odd", source, "0.3")
    result = call("check", "e.json", ODD)
    reason = "ValueError: its move at rest, or a derivative of it, is not finite"
    assert (result.code, f"{WHO}when linearised: {reason}" in result.err) == (3, True)
    result = call("run", "e.json", ODD)
    assert (result.code, "found at step 1, diverged under rule 'odd'" in result.err) == (
        4,
        True,
    )


def test_invalid_default_is_an_error_of_the_plugin(install: Install, call: Call) -> None:
    source = rule("odd").replace("strength: float = 1.0", "strength: float = 'x'")
    install("pbdkit-odd", source, "0.3")
    result = call("run", "e.json", ODD)
    assert result.code == 3
    assert result.err.endswith(
        "'odd' belongs to pbdkit-odd 0.3, which is broken: TypeError: the default of Rule.strength "
        "is invalid: Input should be a valid number, got 'x'\n"
    )


REFUSING = "@__import__('pydantic').field_validator('strength')\n    def v(cls, x): raise ValueError('too strong')"
NOBODYS_FAULT = {
    "no default": ("strength: float", "rule.strength: is missing"),
    "refused by its own validator": (f"strength: float = 1.0\n    {REFUSING}", "rule.strength: too strong"),
}  # fmt: skip


@pytest.mark.parametrize(("new", "message"), NOBODYS_FAULT.values(), ids=NOBODYS_FAULT)
def test_refusal_by_a_component_is_an_experiment_error(
    install: Install, call: Call, new: str, message: str
) -> None:
    install("pbdkit-odd", rule("odd").replace("strength: float = 1.0", new), "0.3")
    result = call("run", "e.json", ODD)
    expected = f"pbdkit: setting rule={{type: odd}}: {message}\n"
    assert (result.code, result.err) == (2, expected)


RAISING = {
    "when it is built": "def model_post_init(self, context): raise OSError('here')",
    "when it is written": (
        "@__import__('pydantic').field_serializer('strength')\n"
        "    def written(self, value): raise OSError('here')"
    ),
    "when it is asked": "def parameters(self, setting): raise SystemExit('here')",
}


@pytest.mark.parametrize("body", RAISING.values(), ids=RAISING)
def test_exception_in_a_component_is_no_bug_of_pbdkit(
    install: Install, call: Call, body: str
) -> None:
    source = rule("raising").replace("strength: float = 1.0", f"strength: float = 1.0\n    {body}")
    install("pbdkit-raising", source, "0.3")
    result = call("run", "e.json", "--set=rule={type: raising}")
    assert (result.code, Path("tensile.nc").exists()) == (3, False)
    assert "FollowerRule 'raising' of pbdkit-raising 0.3 failed to " in result.err
    assert ": here" in result.err
    assert call("schema").code == 0


def test_diagnostic_with_unknown_variables_leaves_the_schema_open(
    probing: Callable[..., None], call: Call
) -> None:
    probing(dims="1 / 0")
    described = json.loads(call("schema", "dataset").out)
    assert "probe" not in described["properties"]["data_vars"]["properties"]
    assert "pe1" in described["properties"]["data_vars"]["properties"]


def test_attributes_without_a_type_are_reported_with_the_remedy():
    with pytest.raises(TypeError) as lazy:

        class Lazy(pbdkit.Diagnostic):
            type = "lazy"

    assert str(lazy.value) == "Lazy.type has no type; write `type: Literal['lazy'] = 'lazy'`"
    with pytest.raises(TypeError, match=r"Slow\.limit has no type; write `limit: int = 3` for a"):

        class Slow(pbdkit.Diagnostic):
            type: Literal["slow"] = "slow"
            limit = 3


def test_assignment_of_a_parameter_names_the_copy_with_a_new_value():
    loaded = pbdkit.load("paper/a")
    with pytest.raises(AttributeError, match=r'experiment\.with_settings\({"steps": 3}\)'):
        loaded.steps = 3
    with pytest.raises(AttributeError, match=r'Grid\.columns cannot.*{"PART.columns": 3}'):
        loaded.body.columns = 3
    changed = loaded.with_settings({"body.columns": 3})
    assert (changed.body.columns, loaded.body.columns) == (3, 10)
