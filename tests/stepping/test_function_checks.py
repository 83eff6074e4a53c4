"""Functions that write into their arguments, or depend on more than these, are found in a run."""

from typing import Literal

import numpy as np
import pytest

import pbdkit
from pbdkit import plugin
from pbdkit.plugin import (
    AppliesTwice,
    FollowerRule,
    FractureModel,
    Remembered,
    RenewsBonds,
    UsesAngles,
    Vector,
    dot,
    length,
    squared_length,
)

CALLS = []


class Plain(FollowerRule):
    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


class Writes(Plain):
    type: Literal["writes"] = "writes"

    @staticmethod
    def gather(d, r, w, p):
        x = d.y
        x *= 0.5
        return Vector(d.x, x), 1.0


class WritesTotal(Plain):
    type: Literal["writes-total"] = "writes-total"

    @staticmethod
    def apply(total, here, p):
        x = total[0].x
        x /= total[1]
        return Vector(x, total[0].y / total[1])


class WritesHere(Plain):
    type: Literal["writes-here"] = "writes-here"

    @staticmethod
    def apply(total, here, p):
        x = here.u.x
        x += 1.0
        return total[0] / total[1]


class Counts(Plain):
    type: Literal["counts"] = "counts"

    @staticmethod
    def gather(d, r, w, p):
        CALLS.append(1)
        return d * len(CALLS), 1.0


class Draws(Plain):
    type: Literal["draws"] = "draws"

    @staticmethod
    def apply(total, here, p):
        return total[0] * np.random.rand() / total[1]


class Norm(Plain):
    type: Literal["norm"] = "norm"

    @staticmethod
    def apply(total, here, p):
        return total[0] / np.sqrt(np.sum(dot(total[0], total[0])) + 1.0)


class PairWrites(UsesAngles, Plain):
    type: Literal["pair-writes"] = "pair-writes"

    @staticmethod
    def gather_pair(d1, d2, r1, r2, w1, w2, p):
        x = d1.x
        x *= 2.0
        return (d1,)


class InnerCounts(AppliesTwice, Plain):
    type: Literal["inner-counts"] = "inner-counts"

    def inner(self):
        return Counts()


NEW = "make new arrays, `x = x + 1` instead of `x += 1`"
KEEPS = "in the second of two equal calls: it keeps values from call to call, or draws random"
FAULTS = {
    Writes: ("`gather` at the neighbour with the site offset (-1, 0) writes into `d.y`", NEW),
    WritesTotal: ("`apply` writes into `total`", NEW),
    WritesHere: ("`apply` writes into its arguments", NEW),
    Counts: ("`gather` at the neighbour with the site offset", "for particle ", KEEPS),
    Draws: ("`apply` returned ", "for particle ", KEEPS),
    Norm: ("`apply` returned ", "is called for this particle alone: it is not elementwise"),
    PairWrites: ("`gather_pair` writes into its arguments", NEW),
    InnerCounts: ("FollowerRule 'counts' failed at the beginning of the run: `gather`", KEEPS),
}


@pytest.mark.parametrize("rule", FAULTS, ids=lambda rule: rule.__name__)
def test_a_fault_is_found_at_the_beginning_of_a_run(rule):
    settings = {"rule": {"type": rule.type_name()}, "steps": 3}
    if rule is InnerCounts:
        settings["frame"] = {"type": "none"}
    with pytest.raises(pbdkit.PluginError) as caught:
        pbdkit.run("paper/a", components=[rule], settings=settings, progress=False)
    message = str(caught.value)
    assert [words for words in FAULTS[rule] if words not in message] == [], message
    assert f"FollowerRule '{'counts' if rule is InnerCounts else rule.type_name()}'" in message


def test_a_sound_rule_is_called_for_few_particles():
    sizes = []

    class Sound(Plain):
        type: Literal["sound"] = "sound"

        @staticmethod
        def gather(d, r, w, p):
            sizes.append(np.size(d.x))
            return d, 1.0

    body = {"type": "grid", "columns": 400, "rows": 300}
    settings = {"rule": {"type": "sound"}, "body": body, "steps": 1, "diagnostics": []}
    pbdkit.run("paper/a", components=[Sound], settings=settings, progress=False)
    checked = [size for size in sizes if size <= 128]
    assert sum(checked) < 1e-2 * sum(sizes)
    assert len(checked) >= 16


class Breaking(FractureModel):
    """A sound model of which the following change a function."""

    limit: float = 0.6

    def constants(self, slot):
        return {"square": (1.0 + self.limit) ** 2 * squared_length(slot.rest)}

    @staticmethod
    def breaks(d, r, c, p):
        return squared_length(r + d) > c.square

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r


class BreaksAny(Breaking):
    type: Literal["breaks-any"] = "breaks-any"

    @staticmethod
    def breaks(d, r, c, p):
        return np.any(squared_length(r + d) > c.square)


class BreaksWrites(Breaking):
    type: Literal["breaks-writes"] = "breaks-writes"

    @staticmethod
    def breaks(d, r, c, p):
        x = d.x
        x += r.x
        return squared_length(d) > c.square


class BreaksCounts(Breaking):
    type: Literal["breaks-counts"] = "breaks-counts"

    @staticmethod
    def breaks(d, r, c, p):
        CALLS.append(1)
        return squared_length(r + d) > c.square * (1.0 + 0.01 * len(CALLS))


class BreaksMisspelt(Breaking):
    type: Literal["breaks-misspelt"] = "breaks-misspelt"

    @staticmethod
    def breaks(d, r, c, p):
        return squared_length(r + d) > c.sqare


class UnequalEnds(Breaking):
    type: Literal["unequal-ends"] = "unequal-ends"

    def constants(self, slot):
        return {"square": 2.0 + slot.rest.x}


class FictitiousNan(Breaking):
    type: Literal["fictitious-nan"] = "fictitious-nan"

    @staticmethod
    def fictitious(u, r, p):
        return u / length(u - u)


class UpdatesNan(RenewsBonds, Breaking):
    type: Literal["updates-nan"] = "updates-nan"

    def remembered(self):
        return (Remembered("largest", "largest strain", "1"),)

    @staticmethod
    def update(d, r, c, p):
        return (np.maximum(c.largest, np.sqrt(length(r + d) - length(r) - 0.01)),)


class UpdatesShape(UpdatesNan):
    type: Literal["updates-shape"] = "updates-shape"

    @staticmethod
    def update(d, r, c, p):
        return (np.zeros(3),)


FRACTURE_FAULTS = {
    BreaksAny: ("`breaks` returned True for a bond with the strain 0, and False", "alone"),
    BreaksWrites: ("`breaks` for bonds along the rest offset (1, 0) writes into", NEW),
    BreaksCounts: ("`breaks` returned ", "for a bond with the strain ", KEEPS, "`RenewsBonds`"),
    BreaksMisspelt: ("in `breaks` for bonds", "'sqare'; did you mean 'square'?", ".py, line "),
    UnequalEnds: ("`constants` returned 3 as 'square' for the rest offset (1, 0), and 1", ".py, "),
    FictitiousNan: ("`fictitious` for bonds", "returned NaN; guard divisions", ".py, line "),
    UpdatesNan: ("`update` for bonds", "returned NaN; guard divisions", ".py, line "),
    UpdatesShape: ("`update` for bonds", "returned the shape (3,) for 64 bonds", ".py, line "),
}


@pytest.mark.parametrize("model", FRACTURE_FAULTS, ids=lambda model: model.__name__)
def test_a_fault_of_a_fracture_model_is_found_at_the_beginning_of_a_run(model):
    settings = {"fracture": {"type": model.type_name()}, "steps": 3}
    with pytest.raises(pbdkit.PluginError) as caught:
        pbdkit.run("paper/d1", components=[model], settings=settings, progress=False)
    message = str(caught.value)
    assert [words for words in FRACTURE_FAULTS[model] if words not in message] == [], message
    assert f"FractureModel '{model.type_name()}' failed at the beginning of the run" in message


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_sound_fracture_model_with_drawn_limits_passes(precision):
    class Scattered(plugin.Draws, Breaking):
        type: Literal["scattered"] = "scattered"

        def remembered(self):
            return (Remembered("strength", "strain at breaking", "1", changes=False),)

        def draw(self, bonds, generator):
            return {"strength": generator.uniform(0.5, 2.0, len(bonds))}

        @staticmethod
        def breaks(d, r, c, p):
            return length(r + d) / length(r) > 1.0 + c.strength

    settings = {
        "fracture": {"type": "scattered"},
        "seed": 1,
        "steps": 3,
        "solver.precision": precision,
    }
    ds = pbdkit.run("paper/d1", components=[Scattered], settings=settings, progress=False)
    assert ds.attrs["status"] == "complete"
