"""Operators applied twice: the experiment of the rule on whose moves another works.

The moves z of the inner rule stand where displacements do: of followers and leaders alike, and of
frame points as the frame makes them of the body's, z_f = Σ weight · z_b.
"""

from __future__ import annotations

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import AppliesTwice, Remembers
from pbdkit.registry.blame import blaming


def inner_experiment(experiment: Experiment, *, lags: bool) -> Experiment | None:
    """The same experiment with the rule's inner rule; None for rules that have none.

    Raises ExperimentError for frames that `lags`, for bonds that break, neighbours that come and go
    and rules that remember: what the moves of the inner rule are is not told there.
    """
    rule = experiment.rule
    if not isinstance(rule, AppliesTwice):
        return None
    with blaming(rule, "when asked for its inner rule", "rule"):
        inner = rule.inner()
    remembers = isinstance(rule, Remembers) or isinstance(inner, Remembers)
    for unfit, part, remedy in (
        (lags, "frame", "lag: 0"),
        (experiment.fracture.can_break, "fracture", "{type: none}"),
        (experiment.neighbours.nearness(), "neighbours", "reevaluate: false"),
        (remembers, "rule", "one that remembers nothing"),
    ):
        if unfit:
            raise ExperimentError(
                f"'{rule.type}' applies a rule to the moves of another, which does not go with "
                f"this {part}; take {part}: {remedy}",
                (part,),
            )
    return experiment.model_copy(update={"rule": inner})
