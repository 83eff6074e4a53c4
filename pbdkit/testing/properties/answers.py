"""What is asked of the answers of every component: that they follow from the question alone."""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces import (
    INTERFACES,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
)
from pbdkit.testing.calls import applied, differences, gathered, here
from pbdkit.testing.property import PropertyError, asked_of
from pbdkit.testing.question import Arrays, Question
from pbdkit.testing.remembering import changed, remembered
from pbdkit.testing.subject import Subject

ALL = tuple(INTERFACES.values())
NEEDS = (
    "has-a-sound-cell",
    "is-mutual",
    "takes-part",
    "declares-what-it-remembers",
    "draws-what-it-remembers",
)
REPEATABLE = (*NEEDS, "changes-no-input", "remembers-nothing", "answers-the-same")
"""What must hold before any comparison of two answers means something."""


def differing(one: Arrays, other: Arrays) -> list[str]:
    """The names of the answers that are not the same to the last bit."""
    names = [name for name in one if name not in other or not _same(one[name], other[name])]
    return names + [name for name in other if name not in one]


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    numbers = a.dtype.kind in "fc"
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=numbers)


@asked_of(*ALL, needs=("has-a-sound-cell", "is-mutual"))
def takes_part(subject: Subject) -> None:
    """A scene can be built with it: at least one of those tried takes it, and none makes it fail
    with anything but an ExperimentError."""
    subject.scene()


@asked_of(FollowerRule, FractureModel, FramePolicy, Diagnostic, needs=NEEDS)
def changes_no_input(subject: Subject) -> None:
    """What it is given it leaves as it is: the arrays belong to the state of the run."""
    for question in subject.questions():
        given = {name: np.array(value) for name, value in question.inputs.items()}
        try:
            with np.errstate(all="ignore"):
                question.ask(given)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise PropertyError(_written(question.what, "what it is given")) from error
        if names := differing(dict(question.inputs), given):
            raise PropertyError(_written(question.what, _listed(names)))


def _written(function: str, where: str) -> str:
    return f"`{function}` writes into {where}: make new arrays, `x = x + 1` and not `x += 1`"


@asked_of(*ALL, needs=(*NEEDS, "changes-no-input"))
def remembers_nothing(subject: Subject) -> None:
    """What it was asked before does not matter: whatever must be remembered belongs to the state of
    the run, or a run that is continued would differ from one that was never interrupted."""
    for question, other in zip(subject.questions(0), subject.questions(-1), strict=False):
        before = remembered(subject.component)
        answers = [question.answer() for _ in range(3)]
        other.answer()
        question.larger().answer()
        later = question.answer()
        kept = changed(before, remembered(subject.component))
        steady = not differing(answers[1], answers[2])
        if differing(answers[2], later) and (steady or kept):
            what = f", and keeps {_listed(kept)} from call to call" if kept else ""
            raise PropertyError(
                f"`{question.what}` answers the same question otherwise after another one{what}"
            )


@asked_of(*ALL, needs=(*NEEDS, "changes-no-input", "remembers-nothing"))
def answers_the_same(subject: Subject) -> None:
    """The same question gets the same answer to the last bit, so that every run can be repeated."""
    for question in subject.questions():
        if names := differing(question.answer(), question.answer()):
            raise PropertyError(
                f"`{question.what}` answers the same question otherwise the second time "
                f"({_listed(names)}): it draws numbers at random that nobody gave "
                "it, or looks at a clock"
            )


@asked_of(*ALL, needs=(*REPEATABLE, "returns-a-value-a-particle"))
def is_finite(subject: Subject) -> None:
    """Finite numbers get finite answers, for a rule also where all neighbours meet in the particle:
    one NaN spreads over the body within a few steps."""
    for question in [*subject.questions(), *_meeting(subject)]:
        for name, value in question.answer().items():
            if value.dtype.kind in "fc" and not np.isfinite(value).all():
                worst = value[~np.isfinite(value)].flat[0]
                raise PropertyError(
                    f"`{question.what}` answers {worst} ({name}): guard the division, as in "
                    "`a / where(b > 0.0, b, 1.0)`"
                )


def _meeting(subject: Subject) -> list[Question]:
    """A rule asked where r + d = 0 along every slot."""
    rule = subject.component
    if not isinstance(rule, FollowerRule):
        return []
    scene = subject.scene()
    arrays = differences(scene, 0) | here(scene, 0)
    for k, slot in enumerate(scene.neighbourhood.slots[0]):
        for c, r in zip("xy", slot.rest, strict=True):
            arrays[f"d{k}.{c}"] = np.full_like(arrays[f"d{k}.{c}"], -r)

    def ask(given: Arrays) -> Arrays:
        return applied(scene, gathered(scene, given), given)

    return [Question("apply, where all neighbours meet in the particle,", arrays, ask)]


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in names[:3])
    return shown + (f" and {len(names) - 3} more" if len(names) > 3 else "")
