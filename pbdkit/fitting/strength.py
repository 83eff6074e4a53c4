"""The strength of bonds and its scatter from repeated tests: from a description to the answer."""

from __future__ import annotations

import numpy as np

from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.first_break import Elastic, knows_forces
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.specimens import Specimen, Specimens, seeded
from pbdkit.fitting.strength_fitted import Checked, FittedStrength, fitted_strength
from pbdkit.fitting.strength_laws import LAWS, OF_FRACTURE, Breaks, Draws, StrengthLaw
from pbdkit.fitting.strength_simulation import simulated
from pbdkit.fitting.strength_specification import StrengthFit


def fit_strength_of(fit: StrengthFit, experiment: Experiment) -> FittedStrength:
    """Carries a strength fit out, on one thread. Raises ExperimentError for what cannot be
    fitted."""
    with one_thread():
        if fit.method == "simulation":
            return _by_simulation(fit, experiment, None)
        found = _by_likelihood(fit, experiment)
        if fit.method == "auto" and found.checked and not found.checked.holds:
            return _by_simulation(fit, experiment, found.checked)
        return found


def _by_likelihood(fit: StrengthFit, experiment: Experiment) -> FittedStrength:
    law = _law(fit, experiment)
    if {*fit.unknown} != {*law.paths}:
        raise ExperimentError(
            f"the likelihood is of {' and '.join(law.paths)}, both: give bounds of these",
            ("unknown",),
        )
    elastic = _elastic(fit, experiment, law)
    full = getattr(elastic.full, "displacement" if fit.measured.of == "displacement" else "force")
    if np.isnan(full):
        raise ExperimentError(
            f"the rule '{experiment.rule.type}' knows no forces; take 'elastic' or another "
            "calibrated rule, or peaks of: displacement",
            ("measured", "of"),
        )
    if full <= 0.0:
        raise ExperimentError(
            f"under the experiment's load the {fit.measured.of} is {full:g}: nothing pulls along "
            "the way of the leader group",
            ("measured", "of"),
        )
    strains = elastic.strains.merged()
    breaks = Breaks(fit.measured.values / full, fit.measured.failed)
    if not (strains.at(breaks.load).max(axis=1) > 0.0).all():
        raise ExperimentError("no bond is drawn out under this load", ("leaders",))
    first, second = (fit.unknown[path] for path in law.paths)
    draws = law.draws(strains, breaks, (first, second))
    found = fitted_strength(fit, law.paths, draws, "likelihood", law)
    return found.with_check(_checked(fit, experiment, law, elastic, found))


def _elastic(fit: StrengthFit, experiment: Experiment, law: StrengthLaw) -> Elastic:
    if experiment.fracture.can_break:
        for path in law.paths:
            experiment = Parameter(path).put(experiment, law.whole(path))
    return Elastic.of(experiment, fit.measured)


def _law(fit: StrengthFit, experiment: Experiment) -> StrengthLaw:
    kind = experiment.fracture.type
    name = fit.law or OF_FRACTURE.get(kind)
    if name is None:
        raise ExperimentError(
            f"of what law strengths are is not known of fracture '{kind}'; give law: weibull or "
            "uniform, or take method: simulation",
            ("law",),
        )
    if OF_FRACTURE.get(kind, name) != name:
        raise ExperimentError(
            f"the strengths of fracture '{kind}' are {OF_FRACTURE[kind]}, not {name}", ("law",)
        )
    return LAWS[name]


def _checked(
    fit: StrengthFit,
    experiment: Experiment,
    law: StrengthLaw,
    elastic: Elastic,
    found: FittedStrength,
) -> Checked | None:
    """Whether specimens of the strengths found fail as their first bond breaks; None where the
    experiment says nothing of what happens then."""
    kind = experiment.fracture.type
    if (
        not fit.check
        or OF_FRACTURE.get(kind) is None
        or elastic.pull is None
        or not elastic.full.force > 0.0
    ):
        return None
    for path in law.paths:
        experiment = Parameter(path).put(experiment, found.values[path].value)
    specimens = Specimens.of(experiment, fit.measured, elastic)
    torn = [specimens.torn(seeded(experiment, fit.seed + n)) for n in range(fit.check)]
    return Checked.of([_excess(each, fit.measured.of) for each in torn], fit.measured.values)


def _excess(specimen: Specimen, of: str) -> float:
    """ln of its peak over that of its first break."""
    assert specimen.first is not None
    return float(np.log(specimen.peak_of(of) / specimen.first_of(of)))


def _by_simulation(
    fit: StrengthFit, experiment: Experiment, checked: Checked | None
) -> FittedStrength:
    for path in fit.unknown:
        Parameter(path).value_in(experiment)
    elastic = None
    if (name := OF_FRACTURE.get(experiment.fracture.type)) and experiment.rule.linear:
        elastic = _elastic(fit, experiment, LAWS[name])
    specimens = Specimens.of(experiment, fit.measured, elastic)
    if not knows_forces(specimens.scene):
        raise ExperimentError(
            f"the rule '{experiment.rule.type}' knows no forces, so that torn specimens have no "
            "peak; take 'elastic' or another calibrated rule",
            ("rule",),
        )
    draws: Draws = simulated(fit, experiment, specimens)
    law = LAWS[name] if name and {*fit.unknown} == {*LAWS[name].paths} else None
    found = fitted_strength(fit, tuple(fit.unknown), draws, "simulation", law)
    return found.with_check(checked)
