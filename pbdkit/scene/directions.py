"""Directions of particles: which remembered numbers they are, and what they go with."""

from __future__ import annotations

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import TurnsParticles
from pbdkit.interfaces.rule import shares_particles
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import particle_numbers


def rotations_of(experiment: Experiment) -> tuple[tuple[int, int], ...]:
    """Of each rotation that the rule remembers, the places of cosine and sine among its numbers.

    Raises PluginError for a name that is not remembered, or of a number that does not change.
    """
    rule = experiment.rule
    if not isinstance(rule, TurnsParticles):
        return ()
    with blaming(rule, "when asked for its rotations", "rule"):
        pairs = rule.rotations()
    changing = {n.name: m for m, n in enumerate(particle_numbers(experiment)) if n.changes}
    for name in (name for pair in pairs for name in pair):
        if name not in changing:
            raise PluginError(
                f"'{rule.type}' names '{name}' in `rotations`, which it does not remember as a "
                "number that changes"
            )
    return tuple((changing[cosine], changing[sine]) for cosine, sine in pairs)


def check_directions(experiment: Experiment, *, has_frame: bool) -> None:
    """Raises ExperimentError where neighbours would have to show what they do not remember, and
    where leaders are clamped that have no directions."""
    rule = experiment.rule
    if shares_particles(rule):
        for unfit, part, who in (
            (has_frame, "frame", "frame points do"),
            (experiment.fracture.can_break, "fracture", "the points in place of broken bonds do"),
        ):
            if unfit:
                raise ExperimentError(
                    f"with '{rule.type}' neighbours see what is remembered of each other, and "
                    f"{who} not remember; take {part}: {{type: none}}",
                    (part,),
                )
    for n, group in enumerate(experiment.leaders):
        if group.clamped and not rotations_of(experiment):
            raise ExperimentError(
                f"with '{rule.type}' particles have no directions that could be clamped; leave "
                "clamped out",
                ("leaders", n, "clamped"),
            )
