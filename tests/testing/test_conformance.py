"""The conformance suite: the built-in components pass it, and it finds and names every fault."""

import json
import re
import subprocess
import sys
from contextlib import nullcontext
from typing import Literal

import pytest
from faulty import directions, operations, others, remembering, rules
from faulty.kagome import Kagome, OnKagome
from interpreted_kernels import interpreting
from pydantic import Field
from scene_strategies import in_turn

import pbdkit
from pbdkit.components import pbdkit_components
from pbdkit.components.rules import MixedCoordinate
from pbdkit.plugin import INTERFACES, FollowerRule, FractureModel
from pbdkit.testing import PROPERTIES, conformance, examine, examine_all, examples_of, properties_of
from pbdkit.testing.subject import LATTICES, NEIGHBOURS, full_name

BUILT_IN = [(e, n) for c in pbdkit_components() for n, e in enumerate(examples_of(c))]
FIRST = [example for example, n in BUILT_IN if n == 0]
FURTHER = in_turn([example for example, n in BUILT_IN if n > 0], 6)
ONE_SITE_AND_TWO = {"lattice": [LATTICES["square"], LATTICES["hexagonal"]]}
NEAREST = {"neighbours": [NEIGHBOURS["coordination-1"], NEIGHBOURS["chebyshev-1"]]}

test_built_in_components_conform = conformance(*FIRST)
test_their_further_examples_conform = conformance(*FURTHER, **ONE_SITE_AND_TWO)
OF_THEIR_OWN = [full_name(e) for e in FIRST if isinstance(e, (FollowerRule, FractureModel))]


def is_compiled(node):
    """One example of each built-in component with functions of its own, and where compiling is what
    is tried."""
    test, _, case = node.name.partition("[")
    if test == "test_built_in_components_conform":
        return any(case.startswith(f"{name}-") for name in OF_THEIR_OWN)
    return "compile" in test or case.startswith(rules.Unlike.__name__)


@pytest.fixture(autouse=True)
def mostly_interpreted(request):
    with nullcontext() if is_compiled(request.node) else interpreting():
        yield


SOUND = [
    rules.Sound(),
    rules.Net(),
    others.Rows(),
    others.Following(),
    others.Strain(),
    others.Extent(),
    remembering.Wearing(),
    remembering.Tired(),
    remembering.LastOnes(),
    directions.Vane(),
]

FAULTS = [
    (rules.WritesInput, "changes-no-input", "`gather` writes into `d0.x`"),
    (rules.CountsPlaces, "takes-particles-in-any-order", "if the particles are in another order"),
    (rules.SumsInOrder, "takes-particles-in-any-order", "order in which neighbours are summed"),
    (rules.Doubles, "keeps-single-precision", "`apply` returns float64 for float32"),
    (rules.GathersDoubles, "keeps-single-precision", "such as `length(r)`, in `weights`"),
    (rules.GathersPairsOfDoubles, "keeps-single-precision", "depends on r1 and r2 alone"),
    (rules.LooksAround, "is-local", "alone and among others"),
    (rules.NeedsArrays, "is-local", "fails with plain numbers instead of arrays"),
    (rules.Remembers, "remembers-nothing", "changes `SEEN` between calls"),
    (rules.Counts, "remembers-nothing", "changes `Counts.calls` between calls"),
    (rules.Throws, "answers-the-same", "in the second of two equal calls"),
    (rules.Seeds, "answers-the-same", "seeds or uses the global generator of random numbers"),
    (rules.Drifts, "rests", "a body at rest moves by 1e-09 in step 1 on the square lattice"),
    (rules.DriftsByRounding, "rests", "a body at rest moves by"),
    (rules.Divides, "is-finite", "with all neighbours at the position of the particle"),
    (rules.Square, "returns-a-value-a-particle", "returns the shape (2, 4, 3)"),
    (rules.Varies, "returns-a-value-a-particle", "`gather` returns between 2 and 3 values"),
    (rules.ClaimsLinear, "superposes", "do not declare `linear`"),
    (rules.HoldsOn, "follows-translations", "use differences `d` instead of `here.u`"),
    (
        rules.BearsTwice,
        "bears-loads-as-forces",
        ("`force` with a load is not the value without load plus the"),
    ),
    (rules.HasAScale, "goes-alike-in-all-units", "annotate parameters that are lengths"),
    (rules.Decays, "goes-alike-in-all-units", "are not finite: compare lengths"),
    (rules.LeansRight, "goes-alike-mirrored-and-turned", "or declare `has_axes`"),
    (
        rules.ResistsTurning,
        "moves-rigidly-for-nothing",
        ("forces under a rigid motion of a whole body"),
    ),
    (rules.PullsOneWay, "acts-both-ways-alike", "use the same weight at both ends of a bond"),
    (rules.Gives, "gives-no-energy-back", "let `force` act towards the neighbours"),
    (rules.StoresTwice, "stores-the-work-of-its-forces", "energy is 2 times the work of the fo"),
    (rules.Overstates, "is-as-stiff-as-declared", "is 0.5 times that of `elasticity`"),
    (remembering.Hardens, "does-not-stiffen-by-breaking", "scale the difference of a bond"),
    (rules.Unlike, "is-the-same-compiled", "the compiled engine computes another `u`"),
    (rules.Restarts, "continues-where-it-stopped", "a run continued at step"),
    (rules.Raises, "changes-no-input", "has no attribute 'strength'"),
    (rules.Undescribed, "is-documented", "the parameter `strength` has no description"),
    (rules.Undocumented, "is-documented", "Undocumented has no docstring"),
    (rules.AnyName, "names-itself", 'declare it as `type: Literal["any-name"] = "any-name"`'),
    (rules.CapitalName, "names-itself", "the type 'CapitalName' is not in lower case"),
    (rules.Thawed, "is-frozen", "`type` can be assigned"),
    (
        rules.Unhashable,
        "is-frozen",
        ("use tuples instead of lists, and named fields instead of dicts"),
    ),
    (rules.Lenient, "refuses-unknown-keys", "it accepts unknown keys"),
    (rules.Forgets, "survives-json", "`strength` is 2.0, but 1.0 after JSON"),
    (rules.without_location, "survives-pickling", "define the class at the top of a module"),
    (rules.Chooses, "takes-part", "give compatible components"),
    (others.Twins, "has-a-sound-cell", "(0, 0) and (0, 1) lie at one place, (0.0, 0.0)"),
    (others.Flat, "has-a-sound-cell", "span no area"),
    (
        others.Astray,
        "has-a-sound-cell",
        ("basis site 1 lies a cell or more from the position of its index"),
    ),
    (others.Miscounts, "has-a-sound-cell", "`primitive` counts the step"),
    (others.Skips, "has-a-sound-cell", "`primitive` counts steps that do not occur"),
    (others.Rooted, "keeps-its-cell-wherever-it-lies", "remove `self.origin` from it"),
    (others.OneSided, "is-mutual", "'one-sided' is not mutual"),
    (others.Approximate, "takes-offsets-of-the-cell", "is not an offset of the cell"),
    (others.Favours, "takes-sublattices-in-any-order", "if the order of the sites is reversed"),
    (others.Contradicts, "finds-the-same-anew", "`nearness` selects other neighbours"),
    (operations.Kicks, "rests-as-declared", "moves a particle at rest"),
    (operations.Pins, "rests-as-declared", "holds a particle that the rule moves"),
    (others.Alternates, "takes-every-point-alone", "follows another particle if there are fewer"),
    (others.ClaimsToBeLocal, "follows-nearby-particles", "remove `local`"),
    (others.Shrinks, "follows-translations", "make the weights of each point sum to 1"),
    (others.ClaimsToAnchor, "follows-translations", "but follows every translation"),
    (others.WritesSites, "changes-no-input", "`follow` writes into `site`"),
    (others.Lopsided, "is-seen-alike-from-both-ends", "other values for (-d, -r) than for (d, r)"),
    (others.Directed, "is-seen-alike-from-both-ends", "use lengths and shells, not directions"),
    (others.DeniesBreaking, "breaks-as-declared", "but `breaks` returns True"),
    (others.BreaksAtRest, "rests", "bonds of a body at rest break in step"),
    (others.Measures, "changes-no-input", "`breaks` returned float64, not booleans; return"),
    (others.Tupled, "changes-no-input", "`fictitious` returned tuple; return a vector, as"),
    (others.TakesOurName, "labels-its-variables", "the dataset already has a variable 'site'"),
    (others.NoUnits, "labels-its-variables", "the variable 'extent' has no units"),
    (others.OneShort, "measures-what-it-declares", "'extent' has the shape (55,), not (56,)"),
    (others.Truncates, "measures-what-it-declares", "declared as i4, but measured as float64"),
    (others.FromFirstRow, "takes-rows-in-any-order", "use the rows of `now.rows(numbers)`"),
    (others.KeepsLargest, "remembers-nothing", "changes `KeepsLargest.largest` between calls"),
    (remembering.TakesAName, "declares-what-it-remembers", "every dataset has a variable 'shell'"),
    (remembering.Shouts, "declares-what-it-remembers", "'WEAR' is not named as `my_number` is"),
    (remembering.OfNoUnit, "declares-what-it-remembers", "'wear' has no units"),
    (remembering.StartsHalfway, "declares-what-it-remembers", "starts at 0.5, which i4 does not"),
    (remembering.Misnames, "draws-what-it-remembers", "returns 'strengths'; expected"),
    (remembering.DrawsOne, "draws-what-it-remembers", "with the shape (), not ("),
    (
        remembering.DrawsNothingFinite,
        "draws-what-it-remembers",
        ("values of 'strength' that are not finite"),
    ),
    (remembering.Overflows, "draws-what-it-remembers", "which i1 does not represent"),
    (remembering.DrawsElsewhere, "answers-the-same", "`draw` returns another value in the second"),
    (
        remembering.DrawsByRow,
        "takes-particles-in-any-order",
        ("`draw` derives 'strength' from the number of the row"),
    ),
    (remembering.DrawsAgain, "answers-the-same", "random numbers from its own generator"),
    (remembering.DrawsOnItsOwn, "continues-where-it-stopped", "a repeated run computes another"),
    (remembering.WritesBonds, "changes-no-input", "`draw` writes into `shell`"),
    (remembering.WritesWear, "changes-no-input", "`update` writes into its arguments; make"),
    (remembering.WritesThePath, "changes-no-input", "`remember` writes into `own0`"),
    (remembering.OneTooMany, "renews-what-it-remembers", "returns 3 values for 2 changing"),
    (remembering.ForgetsThePath, "renews-what-it-remembers", "`remember` returns 0 values for 1"),
    (remembering.PathAndMove, "renews-what-it-remembers", "`remember` returns 2 values for 1"),
    (remembering.CountsHalves, "renews-what-it-remembers", "declared as i4; fractions would be"),
    (
        remembering.WearsTogether,
        "is-local",
        ("`update` returns different values for a particle alone"),
    ),
    (
        remembering.SharesThePath,
        "is-local",
        ("`remember` returns different values for a particle alone"),
    ),
    (
        remembering.WearsInOrder,
        "takes-particles-in-any-order",
        "`update` returns another value for a",
    ),
    (remembering.WearsInDoubles, "keeps-single-precision", "`update` returns float64 for float32"),
    (remembering.WearsOneWay, "is-seen-alike-from-both-ends", "`update` returns other values for"),
    (remembering.Misstates, "breaks-beyond-its-strain", "`breaking_strain` and `breaks` disagree"),
    (remembering.Sags, "rests", "a body at rest moves by"),
    (directions.Compass, "follows-rotations", "measure the positions of its neighbours"),
    (directions.PointsNowhere, "declares-what-it-remembers", "has 'vane_tan' in `rotations`"),
    (directions.WritesThere, "changes-no-input", "`gather` writes into `shared"),
    (directions.Creeps, "rests", "a body at rest moves by 1e-09"),
    (remembering.Ragged, "measures-what-it-declares", "'last_square' has the shape"),
    (remembering.Untimely, "measures-what-it-declares", "requires `at_end`"),
]


def made(faulty):
    return faulty(strength=2.0) if faulty is rules.Forgets else faulty()


@pytest.mark.parametrize("component", SOUND, ids=lambda c: c.type)
def test_faulty_examples_without_their_fault_pass(component):
    report = examine(component, **ONE_SITE_AND_TWO, **NEAREST)
    assert report.holds, str(report)


@pytest.mark.parametrize(
    ("faulty", "name", "words"), FAULTS, ids=lambda v: getattr(v, "__name__", "")
)
def test_every_fault_is_detected_and_named(faulty, name, words):
    report = examine(made(faulty), **ONE_SITE_AND_TWO, **NEAREST)
    assert [outcome.property for outcome in report.failed] == [name], str(report)
    assert words in report.failed[0].reason


def test_divergence_with_a_component_is_reported_as_such():
    report = examine(rules.Overshoots(), **ONE_SITE_AND_TWO, **NEAREST)
    (failed,) = report.failed
    assert re.match(r"a run from random displacements diverges at step \d with the", failed.reason)
    assert (
        "scale the move that `apply` returns, so that steps with relaxation 1 are" in failed.reason
    )


def test_reason_for_no_reflection_names_the_lattice_that_a_component_refuses():
    report = examine(rules.Net(), **ONE_SITE_AND_TWO, **NEAREST)
    assert "no scene on the square lattice accepts the component" in report.summary()


def test_every_property_detects_a_fault():
    assert {p.name for p in PROPERTIES} == {name for _, name, _ in FAULTS}


def test_every_property_has_a_description_and_interfaces():
    for asked in PROPERTIES:
        assert len(asked.description) > 30, asked.name
        assert asked.interfaces
        assert set(asked.interfaces) <= set(INTERFACES.values())


def test_no_component_is_excused():
    """Every property of an interface is tested on every component; the built-in ones are tested
    above."""
    for component in pbdkit_components():
        asked = [p.name for p in PROPERTIES if issubclass(component, p.interfaces)]
        for example in examples_of(component):
            assert [p.name for p in properties_of(type(example))] == asked


def test_report_lists_run_and_skipped_properties():
    text = str(examine(rules.Sound()))
    assert text.startswith(
        "FollowerRule sound: 21 properties ran, 0 failed; 3 skipped: it has no state variables"
    )
    assert "  held     rests" in text


def test_properties_that_depend_on_a_failed_one_are_skipped():
    report = examine(rules.WritesInput())
    assert {o.reason for o in report.skipped} == {
        "not tested, since changes-no-input fails",
        "it has no state variables of particles",
    }


def test_examples_come_from_defaults_and_from_fields():
    made = examples_of(MixedCoordinate)
    assert [(e.K, e.axis) for e in made] == [(-0.004, "x"), (-0.004, "y")]


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (
            Field(description="k"),
            ("Needy.k has neither a default nor an example: write `k: ... = Field("),
        ),
        (Field(1.0, examples=["a"]), "Needy rejects its examples {'k': 'a'}: k: Input should be"),
    ],
)
def test_class_without_usable_examples_is_reported(field, words):
    annotations = {"type": Literal["needy"], "k": float}
    needy = type(
        "Needy", (rules.Sound,), {"type": "needy", "k": field, "__annotations__": annotations}
    )
    with pytest.raises(pbdkit.PluginError, match=re.escape(words)):
        examples_of(needy)
    (report,) = examine_all([needy])
    assert not report.holds
    assert words in report.failed[0].reason


class Unfinished(pbdkit.FollowerRule):
    """A rule without the method `apply`."""

    type: Literal["unfinished"] = "unfinished"

    @staticmethod
    def gather(d, r, w, p):
        return (1.0,)


def test_class_that_lacks_a_method_is_reported():
    for report in (examine(Unfinished), *examine_all([Unfinished])):
        assert [outcome.property for outcome in report.failed] == ["has-examples"]
        assert "Unfinished cannot be created: " in report.failed[0].reason
        assert "apply" in report.failed[0].reason
    with pytest.raises(pbdkit.PluginError, match="Unfinished cannot be created"):
        conformance(Unfinished)


def test_class_is_tested_by_its_first_example():
    first = examine(rules.Sound(), **ONE_SITE_AND_TWO, **NEAREST)
    assert examine(rules.Sound, **ONE_SITE_AND_TWO, **NEAREST) == first


def test_component_of_its_own_lattice_is_tested_on_that():
    reports = list(examine_all([Kagome, OnKagome]))
    assert [report.holds for report in reports] == [True, True], "\n".join(map(str, reports))
    assert "takes-part" in [outcome.property for outcome in examine(OnKagome()).failed]
    assert examine(OnKagome(), lattice=Kagome()).holds


def test_without_a_component_there_is_nothing_to_test():
    with pytest.raises(ValueError, match="requires at least one component"):
        conformance()


ONE_LINE = """
from {module} import Mine
from pbdkit.testing import conformance

test_conformance = conformance(Mine())
"""
SOURCE = """
from typing import Literal
import pbdkit

class Mine(pbdkit.FollowerRule):
    "Half of the mean displacement."
    type: Literal["mine"] = "mine"

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return SHARE * total[0] / total[1]

@pbdkit.hookimpl
def pbdkit_components():
    return [Mine]
"""


def test_one_line_suffices_for_pytest(tmp_path):
    drifting = SOURCE.replace("SHARE *", "pbdkit.plugin.Vector(1e-9, 0.0) +").replace("mine", "bad")
    for module, source in {"good": SOURCE, "bad": drifting}.items():
        (tmp_path / f"{module}_rules.py").write_text(source.replace("SHARE", "0.5"))
        (tmp_path / f"test_{module}.py").write_text(ONE_LINE.format(module=f"{module}_rules"))
    call = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "."]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1, done.stdout
    for name, failed in {"mine": 0, "bad": 1}.items():
        summary = f"FollowerRule {name}: 21 properties ran, {failed} failed; 3 skipped: it"
        assert summary in done.stdout
    assert "does not declare `linear`" in done.stdout
    assert "FollowerRule bad: rests: a body at rest moves by 1e-09" in done.stdout
    assert re.search(r"^1 failed, 41 passed, 24 skipped", done.stdout, re.MULTILINE), done.stdout


def test_plugins_check_tests_a_distribution(install, call):
    install("pbdkit-good", SOURCE.replace("SHARE", "0.5"))
    install(
        "pbdkit-bad",
        SOURCE.replace("SHARE *", "pbdkit.plugin.Vector(1e-9, 0.0) +").replace("mine", "bad"),
    )
    good = call("plugins", "check", "pbdkit_good")
    assert good.code == 0
    assert "FollowerRule mine: 21 properties ran, 0 failed; 3 skipped: it has no state" in good.out
    assert "1 example of its components passed all properties" in good.out
    both = call("plugins", "check")
    assert both.code == 3
    assert "failed  rests: a body at rest moves by 1e-09" in both.out
    assert "mine: 21 properties ran, 0 failed" in both.out


def test_plugins_check_as_json_and_in_full(install, call):
    install("pbdkit-good", SOURCE.replace("SHARE", "0.5"))
    answer = json.loads(call("plugins", "check", "pbdkit-good", "--json").out)
    assert answer["holds"] is True
    assert {o["state"] for o in answer["reports"][0]["outcomes"]} == {"held", "skipped"}
    assert "  held     rests" in call("plugins", "check", "pbdkit-good", "--verbose").out


def test_plugins_check_reports_untestable_plugins(install, call):
    nothing = call("plugins", "check")
    assert (nothing.code, "no plugin is installed" in nothing.err) == (3, True)
    unknown = call("plugins", "check", "pbdkot")
    assert (unknown.code, "did you mean 'pbdkit'?" in unknown.err) == (3, True)
    install("pbdkit-torn", "import there_is_no_such_module")
    torn = call("plugins", "check", "pbdkit-torn")
    assert (torn.code, "pbdkit-torn 1.0 is broken: " in torn.err) == (3, True)
    assert "hold" not in torn.out
