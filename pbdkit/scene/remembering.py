"""The numbers that parts remember, as they declare them."""

from __future__ import annotations

from collections import Counter

from pbdkit.errors import PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import FollowerRule, FractureModel, Remembered, Remembers
from pbdkit.interfaces.answers import as_values
from pbdkit.registry.blame import blaming

Declared = tuple[Remembered, ...]


def bond_numbers(experiment: Experiment) -> Declared:
    """What the fracture model remembers of each bond; nothing where bonds cannot break."""
    return _declared(experiment.fracture, "fracture") if experiment.fracture.can_break else ()


def particle_numbers(experiment: Experiment) -> Declared:
    """What the rule remembers of each particle."""
    return _declared(experiment.rule, "rule")


def _declared(part: FollowerRule | FractureModel, field: str) -> Declared:
    if not isinstance(part, Remembers):
        return ()
    with blaming(part, "when asked what it remembers", field):
        return as_values(part.remembered(), "remembered")


def remembered_names(experiment: Experiment) -> dict[str, str]:
    """Each number's name with the field of the part that remembers it.

    Raises PluginError for a name that is declared twice.
    """
    bonds, particles = bond_numbers(experiment), particle_numbers(experiment)
    counts = Counter(number.name for number in (*bonds, *particles))
    for name, count in counts.items():
        if count > 1:
            raise PluginError(
                f"the number '{name}' is declared {count} times, by FractureModel "
                f"'{experiment.fracture.type}' and FollowerRule '{experiment.rule.type}'; "
                "each needs a name of its own"
            )
    return {n.name: "fracture" for n in bonds} | {n.name: "rule" for n in particles}
