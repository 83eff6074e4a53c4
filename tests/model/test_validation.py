"""Every fault of an experiment is refused with one message: place, field, what is wrong."""
# ruff: noqa: E501  (a row of a table is a line)

from __future__ import annotations

import gc
import re
import time
import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

import pbdkit
from pbdkit.plugin.units import LENGTH
from pbdkit.scene.scene import Scene, build_scene

TENSILE = """\
version: 1
name: tensile
lattice: {type: square, a: 1.0}
body: {type: grid, columns: 4, rows: 3}
neighbours: {type: coordination}
rule: {type: barycentre}
frame: {type: mean}
fracture: {type: none}
leaders:
  - {select: {edge: left}, motion: {type: hold}}
  - {select: {edge: right}, motion: {type: velocity, velocity: [0.1, 0.0], steps: 3}, until: 3}
steps: 10
diagnostics: [{type: pe2}]
"""
Build = Callable[..., Scene]
Refused = Callable[..., str]


def edited(old: str, new: str) -> str:
    assert TENSILE.count(old) == 1, old
    return TENSILE.replace(old, new)


def agrees(message: str, expected: str) -> bool:
    """Equal, or the beginning is where what is expected ends in "..."."""
    return message.startswith(expected[:-3]) if expected.endswith("...") else message == expected


A, STEPS, RULE = "a: 1.0", "steps: 10", "type: barycentre"
INTEGER = "e.yaml:12:1: steps: should be a valid integer, got "
MERGE = "merge keys (<<) are not supported; repeat the keys"
EDITS = {
    "no is a word": (A, "a: no", "e.yaml:3:25: lattice.a: should be a valid number, got 'no'"),
    "inf": (A, "a: .inf", "e.yaml:3:25: lattice.a: should be a finite number, got inf"),
    "nan": (A, "a: .nan", "e.yaml:3:25: lattice.a: should be a finite number, got nan"),
    "a bound of many digits": (A, "a: -1", "e.yaml:3:25: lattice.a: should be greater than or equal to 1e-100, got -1"),
    "overflow": (A, "a: 1e400", "e.yaml:3:25: lattice.a: should be a finite number, got inf"),
    "nan in a list": ("0.1,", ".nan,", "e.yaml:11:65: leaders.1.motion.velocity.0: should be a finite..."),
    "text in a list": ("0.1,", "'0.1',", "e.yaml:11:65: leaders.1.motion.velocity.0: should be a valid..."),
    "text for an integer": (STEPS, "steps: '10'", INTEGER + "'10'; write 10, without quotes"),
    "bool for an integer": (STEPS, "steps: true", INTEGER + "True"),
    "float for an integer": (STEPS, "steps: 10.0", INTEGER + "10.0; write 10"),
    "1e1 for an integer": (STEPS, "steps: 1e1", INTEGER + "10.0; write 10"),
    "huge integer": (STEPS, "steps: 1" + "0" * 99, "e.yaml:12:1: steps: should be less than..."),
    "integer of 5000 digits": (STEPS, "steps: " + "1" * 5000, "e.yaml:12:..."),
    "huge for a number": (A, "a: 1" + "0" * 400, "e.yaml:3:25: lattice.a: should be a valid number, got a huge integer"),
    "huge body": ("columns: 4", "columns: 1" + "0" * 400, "e.yaml:4:..."),
    "newer version": ("version: 1", "version: 2", "e.yaml:1:1: version: this pbdkit supports version 1, got 2"),
    "version 1.0": ("version: 1", "version: 1.0", "e.yaml:1:1: version: should be..."),
    "version true": ("version: 1", "version: true", "e.yaml:1:1: version: should be..."),
    "missing": (STEPS + "\n", "", "e.yaml:1:1: steps: is missing"),
    "given twice": (STEPS, "steps: 10\nsteps: 20", "e.yaml:13:1: steps: occurs twice, first at e.yaml:12:1; remove one"),
    "given twice inside": (A, "a: 1, a: 2", "e.yaml:3:31: lattice.a: occurs twice, first at e.yaml:3:25; remove one"),
    "unknown key": (STEPS, "stepz: 10", "e.yaml:12:1: stepz: unknown key; did you mean 'steps'? (known: version,..."),
    "unknown parameter": ("columns: 4", "colums: 4", "e.yaml:4:20: body.colums: unknown key; did you mean 'columns'? (known: columns, rows)"),
    "centre of a rectangle": ("{type: grid, columns: 4, rows: 3}", "{type: rectangle, width: 4.0, height: 3.0, centre: [0, 0]}", "e.yaml:4:50: body.centre: unknown key; `origin` is its lower left corner (known: width, height, origin)"),
    "modulus of a rule": (RULE, "type: springs, youngs_modulus: 2.1e5", "e.yaml:6:23: rule.youngs_modulus: unknown key; displacements do not depend on it, and rules do not have this parameter; it scales forces and stresses: write it under `units`, or in each diagnostic of forces or stresses (known: ..."),
    "region without a part": (RULE + "}", "type: barycentre}\nregions:\n  hole: {type: disc, radius: 1.0}", "e.yaml:8:3: regions.hole.centre: is missing"),
    "region with a number": (RULE + "}", "type: barycentre}\nregions:\n  hole: {type: disc, centre: [0, 0], radius: -1}", "e.yaml:8:38: regions.hole.radius: should be greater than 0, got -1"),
    "region with a reserved name": (RULE + "}", "type: barycentre}\nregions:\n  file: {type: disc, centre: [0, 0], radius: 1}", "e.yaml:8:3: regions.file: the name of a region may contain ..."),
    "region of sites": (RULE + "}", "type: barycentre}\nregions:\n  hole: {type: grid, columns: 1, rows: 1}", "e.yaml:8:3: regions.hole: a grid counts sites and cannot be a region; use a rectangle"),
    "unknown region in a field": (RULE, "type: springs, stiffness: {otherwise: 1, hole: 2}", "e.yaml:6:49: rule.stiffness.hole: there is no region 'hole' (the experiment has no `regions`; add them)"),
    "misspelt rule": (RULE, "type: baricentre", "e.yaml:6:8: rule.type: unknown type 'baricentre'; did you mean 'barycentre'? (installed: barycentre,..."),
    "misspelt body": ("grid", "gird", "e.yaml:4:8: body.type: unknown type 'gird'; did you mean 'grid'? (known: ..."),
    "misspelt motion": ("hold", "hodl", "e.yaml:10:37: leaders.0.motion.type: unknown type 'hodl'; did you mean 'hold'? (known: ..."),
    "misspelt edge": ("left", "lft", "e.yaml:10:15: leaders.0.select.edge: should be 'left', 'right', 'bottom' or 'top', got 'lft'; did you mean 'left'?"),
    "no type": ("{type: mean}", "{}", "e.yaml:7:1: frame: `type` is missing; it is one of first, mean, mirror, natural, none"),
    "type a number": ("{type: mean}", "{type: 3}", "e.yaml:7:9: frame.type: expected a word, got 3"),
    "a word for a part": ("{type: mean}", "mean", "e.yaml:7:1: frame: expected {type: ..., its parameters}, got 'mean'; write {type: mean}"),
    "nothing for a part": ("{type: mean}", "", "e.yaml:7:1: frame: expected {type: ..., its parameters}, got None"),
    "merge key": ("{type: mean}", "{<<: {type: mean}}", f"e.yaml:7:9: {MERGE}"),
    "tag": ("{type: mean}", "!!python/name:os.system x", "e.yaml:7:8: tags (tag:yaml.org,2002:python/name:os.system) are not supported"),
    "list for a key": (STEPS, "? [a]\n: 1", "e.yaml:12:3: a key must be a word"),
    "tab": (STEPS, "\tsteps: 10", "e.yaml:12:1: not valid YAML: found character '\\t' that cannot start any token; indent with spaces, not with tabs"),
    "decimal comma": (A, "a: 1,5", "e.yaml:3:30: lattice.5: unknown key; write decimals with a point instead of a comma, as in 0.3 (known: ..."),
    "decimal commas in a list": ("[0.1, 0.0]", "[0,1, 0,0]", "e.yaml:11:54: leaders.1.motion.velocity: should have at most 2 items, got 4; write decimals with a point instead of a comma, as in 0.01"),
    "decimal comma in a text": (A, "a: '1,5'", "e.yaml:3:25: lattice.a: should be a valid number, got '1,5'; write 1.5"),
    "percent": (A, "a: 30%", "e.yaml:3:25: lattice.a: should be a valid number, got '30%'; write 0.3"),
    "no space after the colon": (A, "a:1.5", "e.yaml:3:25: lattice.a:1.5: unknown key; write a space after the colon: `a: 1.5` (known: ..."),
    "open bracket": ("[0.1, 0.0]", "[0.1, 0.0", "e.yaml:11:83: not valid YAML: expected ',' or ']', but got '}'; the '[' at 11:64 is not closed, or a comma is missing before"),
    "open quotation": ("name: tensile", "name: 'tensile", "e.yaml:14:1: not valid YAML: found unexpected end of stream; the quotation mark at 2:7 is not closed"),
    "two colons": ("name: tensile", "name: a: b", "e.yaml:2:8: not valid YAML: mapping values are not allowed here; put text with a colon in quotes, ..."),
    "indented otherwise": ("  - {select: {edge: right}", " - {select: {edge: right}", "e.yaml:11:2: not valid YAML: expected <block end>, but found '<block sequence start>'; indent all entries of a group ..."),
    "spacing at the top": (STEPS, "steps: 10\na: 1.0", "e.yaml:13:1: a: unknown key; write it under `lattice`, as in `lattice: {a: ...}` (known: ..."),
    "width at the top": (STEPS, "steps: 10\nwidth: 1.0", "e.yaml:13:1: width: unknown key; write it under `body`, as in `body: {width: ...}` (known: ..."),
    "relaxation at the top": (STEPS, "steps: 10\nrelaxation: 1.0", "e.yaml:13:1: relaxation: unknown key; write it under `solver`, as in `solver: {relaxation: ...}` (known: ..."),
    "unit in other letters": ("name: tensile", "name: tensile\nunits: {length: 1 mm, youngs_modulus: 210 Gpa}", "e.yaml:3:23: units.youngs_modulus: '210 Gpa': there is no unit 'Gpa'; did you mean 'GPa'?"),
    "a speed": ("name: tensile", "name: tensile\nunits: {length: 1 mm/s}", "e.yaml:3:9: units.length: '1 mm/s' is not a length; steps have no duration; write the change in one step, without the unit of time, as in 0.01 mm"),
    "control character": ("tensile", "ten\x07sile", "e.yaml:2:..."),
    "open brace": ("{type: mean}", "{type: mean", "e.yaml:8:9: not valid YAML: ..."),
    "until before from": ("hold}", "hold}, from: 5, until: 2", "e.yaml:10:5: leaders.0: until (2) is before from (5)"),
    "from 0": ("hold}", "hold}, from: 0", "e.yaml:10:50: leaders.0.from: should be greater than or equal to 1, got 0"),
    "two selections": ("left}", "left, numbers: [7]}", "e.yaml:10:6: leaders.0.select: give exactly one of edge, box, numbers, nearest, region"),
    "no selection": ("{edge: left}", "{}", "e.yaml:10:6: leaders.0.select: give exactly one of edge, box, numbers, nearest, region"),
    "nobody selected": ("edge: left", "box: [50, 50, 60, 60]", "e.yaml:10:6: leaders.0.select: selects no particle; the body extends from [0.0, 0.0] to [3.0, 2.0] lattice units"),
    "frame point": ("edge: left", "numbers: [7, 1]", "e.yaml:10:28: leaders.0.select.numbers.1: particle 1 is a frame point; select particles of the body"),
    "number out of range": ("edge: left", "numbers: [31]", "e.yaml:10:25: leaders.0.select.numbers.0: there is no particle 31; they are numbered 1 to 30"),
    "number 0": ("edge: left", "numbers: [0]", "e.yaml:10:25: leaders.0.select.numbers.0: should be greater than or equal to 1, got 0"),
    "contradiction": ("left", "bottom", "e.yaml:11:5: leaders.1: moves particle 22 in step 1 differently from leaders.0; select it in one group only, or end one motion before the other begins"),
    "thresholds": ("none}", "threshold, thresholds: [1.5, 2]}", "e.yaml:8:29: fracture.thresholds: one threshold for each shell is required: there are 2 for 1 shell(s)"),
    "low threshold": ("none}", "threshold, thresholds: [.5]}", "e.yaml:8:42: fracture.thresholds.0: 0.5 is below the rest length 1 of shell 1: every bond would break at rest; increase it"),
    "one variable twice": ("pe2}", "pe2}, {type: pe1}, {type: pe2}", "e.yaml:13:41: diagnostics.2: adds the variable 'pe2'; so does diagnostics.0; remove one"),
    "track out of range": ("pe2", "track, numbers: [7, 31]", "e.yaml:13:42: diagnostics.0.numbers.1: there is no particle 31; they are numbered 1 to 30"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "expected"), EDITS.values(), ids=EDITS)
def test_error_has_its_place(refused: Refused, old: str, new: str, expected: str) -> None:
    message = refused(edited(old, new))
    assert agrees(message, expected), message


TEXTS = {
    "empty": ("", "e.yaml: is empty; `pbdkit init` writes an experiment to start from"),
    "list": ("- 1\n", "e.yaml:1:1: expected keys such as `lattice:` at the top level"),
    "two documents": (TENSILE + "---\nname: b\n", "e.yaml:14:1: a second document; a file contains one experiment"),
    "bad UTF-8": (TENSILE.encode()[:40] + b"\xff", "e.yaml: byte 40 is not UTF-8; save the file as UTF-8"),
    "UTF-16": (TENSILE.encode("utf-16"), "e.yaml: byte 0 is not UTF-8; save the file as UTF-8"),
    "too large": (TENSILE + "#" * 2**20, "e.yaml: is larger than 1 MiB, the maximum for experiments; move tables to CSV files"),
    "alias bomb": ("a: &a [x]\n" + "".join(f"b{n}: &a [*a, *a, *a]\n" for n in range(30)), "e.yaml:2:9: aliases (*a) are not supported; repeat the value"),
    "merge bomb": ("a: &a {k: 1}\n" + "".join(f"b{n}: &a {{<<: [*a, *a]}}\n" for n in range(30)), f"e.yaml:2:9: {MERGE}"),
    "100 000 levels of [": ("a: " + "[" * 100_000, "e.yaml:1:35: nested more than 32 levels deep"),
    "100 000 levels of {": ("{a: " * 100_000, "e.yaml:1:129: nested more than 32 levels deep"),
    "100 000 levels of -": ("- " * 100_000, "e.yaml:1:65: nested more than 32 levels deep"),
    "100 000 unknown keys": (TENSILE + "".join(f"k{n}: 1\n" for n in range(100_000)), "e.yaml:..."),
    "YAML 1.1": ("%YAML 1.1\n---\n" + edited(STEPS, "steps: 010"), "e.yaml:2:..."),
}  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), TEXTS.values(), ids=TEXTS)
def test_invalid_file_is_refused_quickly(
    refused: Refused, text: str | bytes, expected: str
) -> None:
    gc.freeze()  # what other tests have left behind is not gone through
    begun = time.process_time()  # a busy machine does not decide
    message = refused(text)
    assert agrees(message, expected), message
    taken = time.process_time() - begun
    gc.unfreeze()
    assert taken < 5.0


READ = {
    "1e-3 is a number": (edited(A, "a: 1e-3"), lambda e: e.lattice.a == 1e-3),
    "010 is ten": (edited(STEPS, "steps: 010"), lambda e: e.steps == 10),
    "byte order mark": ("\ufeff" + TENSILE, lambda e: e.name == "tensile"),
    "name with folders": (edited("tensile", "Paper-2/a_1.b"), lambda e: e.name == "Paper-2/a_1.b"),
}


@pytest.mark.parametrize(("text", "holds"), READ.values(), ids=READ)
def test_valid_values_are_read(build: Build, text: str, holds: Callable[[Any], bool]) -> None:
    assert holds(build(text).experiment)


NAMES = ["../x", "a/../b", "/x", "..", "a..b", "a//b", "a/", "''", "a b", r"a\b", "C:x", "é"]


@pytest.mark.parametrize(
    ("file", "name"), [("bar-2.yaml", "bar-2"), ("a bar.yaml", "a-bar"), ("..bar.yaml", "bar")]
)
def test_default_name_is_that_of_the_file(tmp_path: Path, file: str, name: str) -> None:
    (tmp_path / file).write_text(edited("name: tensile\n", ""))
    assert pbdkit.load(str(tmp_path / file)).name == name


@pytest.mark.parametrize(
    ("rule", "frame"),
    [
        ({"type": "barycentre"}, "mean"),
        ({"type": "elastic", "poisson_ratio": 0.3}, "natural"),
        ({"type": "springs"}, "natural"),
    ],
)
def test_default_frame_is_natural_with_calibrated_rules(
    tensile: dict[str, Any], rule: dict[str, Any], frame: str
) -> None:
    del tensile["name"]
    tensile.pop("frame", None)
    experiment = pbdkit.Experiment(**tensile | {"rule": rule})
    assert (experiment.name, experiment.frame.type) == ("experiment", frame)


@pytest.mark.parametrize("name", NAMES)
def test_name_cannot_leave_its_directory(refused: Refused, name: str) -> None:
    message = refused(edited("name: tensile", f"name: {name}"))
    assert agrees(
        message, "e.yaml:2:1: name: may contain letters, digits, '.', '_', '-' and '/', ..."
    )


JARGON = {
    "three coordinates": ("[0.1, 0.0]", "[0.1, 0.0, 0.0]"),
    "a number for a list": ("[0.1, 0.0]", "0.1"),
    "no number": ("edge: left", "numbers: []"),
    "a map for a list": ("[{type: pe2}]", "{type: pe2}"),
    "a word for a group": ("{select: {edge: left}, motion: {type: hold}}", "left"),
}


@pytest.mark.parametrize(("old", "new"), JARGON.values(), ids=JARGON)
def test_messages_use_lists_and_maps(refused: Refused, old: str, new: str) -> None:
    message = refused(edited(old, new)).lower()
    assert not [word for word in ("tuple", "dictionary", "instance", "validat") if word in message]


@pytest.mark.parametrize(
    ("name", "expected"),
    {
        "nofile.yaml": "nofile.yaml: is neither a file nor a shipped experiment...",
        "paper/aa": "paper/aa: is neither a file nor a shipped experiment; did you mean 'paper/a'? ...",
        ".": ".: is a folder...",
        "x" * 300: "x...",
    }.items(),
    ids=["missing file", "misspelt shipped name", "folder", "long name"],
)
def test_files_without_an_experiment(name: str, expected: str) -> None:
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.load(name)
    assert agrees(str(caught.value), expected)


def test_threshold_below_the_largest_rest_length_gives_a_warning(build: Build) -> None:
    text = edited("none}", "threshold, thresholds: [1.2]}").replace("coordination", "chebyshev")
    (warning,) = build(text).warnings
    assert warning.startswith("fracture.thresholds.0: 1.2 is below the largest rest length 1.41421")


def test_huge_lattice_is_refused_before_allocation(build: Build) -> None:
    experiment = build(TENSILE).experiment.model_dump(by_alias=True)
    huge = experiment | {"body": {"type": "grid", "columns": 10**9, "rows": 10**9}}
    tracemalloc.start()
    with pytest.raises(pbdkit.ExperimentError, match=r"^body: 1e\+18 particles need about .* GiB"):
        build_scene(pbdkit.Experiment(**huge))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


LEFT = {"edge": "left"}
CORNER = {"numbers": [7]}
HOLD = {"type": "hold"}
DISPLACE = {"type": "displace", "displacement": [0.5, 0.0]}


def velocity(x: float, steps: int) -> dict[str, Any]:
    return {"type": "velocity", "velocity": [x, 0.0], "steps": steps}


def group(select: Any, motion: Any, from_: int = 1, **until: int) -> dict[str, Any]:
    return {"select": select, "motion": motion, "from": from_, **until}


# Particle 7 is the lowest of the left edge. The step is that of the contradiction; 0: none.
GROUPS = {
    "equal": (group(LEFT, HOLD), group(CORNER, HOLD), 0),
    "equal in effect": (group(LEFT, DISPLACE), group(CORNER, velocity(0.5, 1)), 0),
    "different": (group(LEFT, HOLD), group(CORNER, DISPLACE), 1),
    "different later": (group(LEFT, velocity(0.1, 4)), group(CORNER, velocity(0.1, 5)), 5),
    "one after the other": (group(LEFT, HOLD, until=4), group(CORNER, DISPLACE, 5), 0),
    "one step together": (group(LEFT, HOLD, until=5), group(CORNER, DISPLACE, 5), 5),
    "holds where it stands": (group(LEFT, DISPLACE), group(CORNER, HOLD, 5), 0),
    "joins on the way": (group(LEFT, velocity(1, 7)), group(CORNER, velocity(1, 3), 5), 0),
    "joins and stops": (group(LEFT, velocity(1, 7)), group(CORNER, velocity(1, 2), 5), 7),
    "written in reverse": (group(CORNER, HOLD, 3), group(LEFT, velocity(0.1, 7)), 3),
    "after the end of the run": (group(LEFT, HOLD), group(CORNER, DISPLACE, 11), 0),
    "nobody in common": (group({"edge": "right"}, HOLD), group(CORNER, DISPLACE), 0),
}  # fmt: skip


@pytest.mark.parametrize(("first", "second", "step"), GROUPS.values(), ids=GROUPS)
def test_contradictory_groups_are_refused(
    tensile: dict[str, Any], first: Any, second: Any, step: int
) -> None:
    experiment = pbdkit.Experiment(**tensile | {"leaders": [first, second]})
    expected = f"^leaders.1: moves particle 7 in step {step} differently from leaders.0; "
    with pytest.raises(pbdkit.ExperimentError, match=expected) if step else nullcontext():
        assert len(build_scene(experiment).leading) == 2


def test_long_equal_motions_are_compared_quickly(tensile: dict[str, Any]) -> None:
    long = velocity(1e-9, 300_000)
    groups = [group(LEFT, long), group(CORNER, long)]
    experiment = pbdkit.Experiment(**tensile | {"leaders": groups, "steps": 300_000})
    begun = time.process_time()
    assert len(build_scene(experiment).leading) == 2
    assert time.process_time() - begun < 0.5


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("-0.2 mm", "should be greater than 0, got '-0.2 mm'"),
        ("9e9 cm", "should be less than or equal to 200000 cm, got '9e9 cm'"),
    ],
)
def test_bound_of_a_value_with_a_unit_is_in_that_unit(value: str, text: str) -> None:
    class Limited(pbdkit.FollowerRule):
        """A rule with a length between bounds."""

        type: Literal["limited"] = "limited"
        size: Annotated[float, Field(gt=0.0, le=1e6), LENGTH] = 1.0

        gather = apply = staticmethod(lambda *_: None)

    settings = {"units": {"length": "2 mm"}, "rule": {"type": "limited", "size": value}}
    with pytest.raises(pbdkit.ExperimentError, match=f"rule.size: {re.escape(text)}"):
        pbdkit.load("paper/a", components=[Limited], settings=settings)
