"""Mistakes of authors are met in a run, and answered with place, cause and remedy."""

from typing import Literal

import numpy as np
import pytest

import pbdkit


class Plain(pbdkit.FollowerRule):
    share: float = 0.5

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


class DividesByZero(Plain):
    type: Literal["divides"] = "divides"

    @staticmethod
    def apply(total, here, p):
        return total[0] / pbdkit.plugin.length(total[0])


class TakesReference(Plain):
    type: Literal["takes-reference"] = "takes-reference"

    @staticmethod
    def apply(total, here, p):
        return total[0] * here.X.x


class TakesReferenceWhole(Plain):
    type: Literal["takes-whole"] = "takes-whole"

    @staticmethod
    def apply(total, here, p):
        return total[0] + 0.0 * here.centred


class TakesOther(Plain):
    type: Literal["takes-other"] = "takes-other"

    @staticmethod
    def apply(total, here, p):
        return total[0] * p.part


class HasTable(Plain):
    type: Literal["has-table"] = "has-table"
    table: tuple[float, ...] = (0.5, 1.0)
    mode: str = "a"

    @staticmethod
    def apply(total, here, p):
        return total[0] * p.table[0]


class HasMode(HasTable):
    """A text is not a mode."""

    type: Literal["has-mode"] = "has-mode"

    @staticmethod
    def apply(total, here, p):
        return total[0] * (1.0 if p.mode == "a" else 0.5)


class HasWeights(Plain):
    type: Literal["has-weights"] = "has-weights"

    def weights(self, slot, setting):
        return {"nearness": 1.0}

    @staticmethod
    def gather(d, r, w, p):
        return d * w.nearnes, 1.0


class MovesAllButOne(Plain):
    type: Literal["moves-all-but-one"] = "moves-all-but-one"

    @staticmethod
    def apply(total, here, p):
        return pbdkit.plugin.Vector(total[0].x[:-1], total[0].y[:-1])


class GathersAllButOne(Plain):
    type: Literal["gathers-all-but-one"] = "gathers-all-but-one"

    @staticmethod
    def gather(d, r, w, p):
        return pbdkit.plugin.Vector(d.x[:-1], d.y[:-1]), 1.0


class GathersList(Plain):
    type: Literal["gathers-list"] = "gathers-list"

    @staticmethod
    def gather(d, r, w, p):
        return d, [1.0]


class AddsOtherShapes(Plain):
    type: Literal["adds-other-shapes"] = "adds-other-shapes"

    @staticmethod
    def apply(total, here, p):
        return pbdkit.plugin.Vector(total[0].x[:-1] + total[0].x, total[0].y)


class GrowsByCubes(Plain):
    type: Literal["grows-by-cubes"] = "grows-by-cubes"

    @staticmethod
    def apply(total, here, p):
        mean = total[0] / total[1]
        return (1.0 + 1e3 * pbdkit.plugin.squared_length(mean)) * mean


class AssignsItself(Plain):
    type: Literal["assigns-itself"] = "assigns-itself"

    def weights(self, slot, setting):
        self.rest = 1.0
        return {"rest": self.rest}


class StartsAtVector(pbdkit.plugin.RenewsParticles, Plain):
    type: Literal["starts-at-vector"] = "starts-at-vector"

    def remembered(self):
        return (
            pbdkit.plugin.Remembered(
                "way", "way", "lattice unit", initial=pbdkit.plugin.Vector(0.0, 0.0)
            ),
        )

    @staticmethod
    def remember(total, here, p):
        return (here.own.way,)


class Measured(pbdkit.Diagnostic):
    def variables(self):
        return (pbdkit.plugin.Variable("q", ("particle",), "q", "1"),)

    def measure(self, now):
        return np.hypot(*now.displacement().T)


class Array(Measured):
    type: Literal["array"] = "array"


class Alone(Measured):
    type: Literal["alone"] = "alone"

    def variables(self):
        return pbdkit.plugin.Variable("q", ("particle",), "q", "1")


class Misspelt(Measured):
    type: Literal["misspelt"] = "misspelt"

    def measure(self, now):
        return (now.displacment(),)


class Infinite(Measured):
    type: Literal["infinite"] = "infinite"

    def measure(self, now):
        return (np.full(len(now.reference()), np.inf),)


DECLARE = "exist only in rules that declare `uses_reference: ClassVar[bool] = True`"
NO_NUMBER = "is not a number: convert it in `parameters` or `weights`"
TUPLE = ", not a tuple; write `(value,)`"
MISTAKES = {
    DividesByZero: ("particle 25, found at step 1", "a displacement is NaN", "in divide (test_ru",
                    "guard divisions and roots with `pbdkit.plugin.where`"),
    TakesReference: ("test_rule_evaluation.py, line ", "`here.X` and `here.centred`", DECLARE),
    TakesReferenceWhole: ("test_rule_evaluation.py, line ", DECLARE),
    TakesOther: ("has no attribute 'part'", "; `p` contains share", "evaluation.py, line "),
    HasTable: ("`p` contains numbers, and the param", NO_NUMBER, "evaluation.py, line "),
    HasMode: ("`p` contains numbers, and the parameter 'mode'", NO_NUMBER, "evaluation.py, line "),
    HasWeights: ("did you mean 'nearness'?", "evaluation.py, line "),
    MovesAllButOne: ("'moves-all-but-one' failed at the beginning of the run: `apply` returned the",
                     "shape (99,) for 100 particles", "element by element", "evaluation.py, line "),
    GathersAllButOne: ("`gather` at the neighbour with the site offset (-1, 0) returned the shape",
                       "value 1 of 2; return numbers and vectors", "evaluation.py, line "),
    GathersList: ("returned list as value 2 of 2; return numbers", "evaluation.py, line "),
    AddsOtherShapes: ("failed at the beginning of the run in `apply`: ValueError: operands could",
                      "; compute one value for each particle", "evaluation.py, line "),
    AssignsItself: ("AssignsItself.rest cannot be assigned", "as state variables (`Remembered`)",
                    "evaluation.py, line "),
    StartsAtVector: ("the initial value of 'way' is Vector", "not a number", "as way_x and way_y"),
    Array: ("Diagnostic 'array' failed at step 0: `measure` returned ndarray", TUPLE),
    Alone: ("Diagnostic 'alone' failed", "`variables` returned Variable", TUPLE),
    Misspelt: ("no attribute 'displacment'; did you mean 'displacement'?", "evaluation.py, line "),
    Infinite: ("Diagnostic 'infinite' failed at step 0: `measure` returned inf as 'q' of",
               "declare the variable with `may_be_nan=True`"),
}  # fmt: skip


@pytest.mark.parametrize("part", MISTAKES, ids=lambda part: part.__name__)
def test_error_in_a_run_names_place_cause_and_remedy(part):
    named = {"type": part.type_name()}
    settings = {"diagnostics": [named]} if issubclass(part, Measured) else {"rule": named}
    with pytest.raises(pbdkit.PbdkitError) as caught:
        pbdkit.run("paper/a", components=[part], settings=settings | {"steps": 3}, progress=False)
    said = str(caught.value)
    assert [words for words in MISTAKES[part] if words not in said] == [], said


@pytest.mark.parametrize("every", [1, 1000])
def test_nan_after_growing_displacements_is_an_instability(every):
    settings = {"rule": {"type": "grows-by-cubes"}, "steps": 1000, "record.every": every}
    with pytest.raises(pbdkit.DivergedError) as caught:
        pbdkit.run("paper/a", components=[GrowsByCubes], settings=settings, progress=False)
    assert "the steps became unstable; lower solver.relaxation, or use solver: {typ" in str(
        caught.value
    )
    assert "NaN" not in str(caught.value)
