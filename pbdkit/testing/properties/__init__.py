"""Everything that is asked of components, in the order in which it is asked."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.testing.properties import (
    answers,
    diagnostics,
    elementwise,
    every,
    fracture,
    frames,
    lattices,
    neighbours,
    remembering,
    steps,
)
from pbdkit.testing.property import Property

PROPERTIES: tuple[Property, ...] = (
    every.names_itself,
    every.is_documented,
    every.is_frozen,
    every.refuses_unknown_keys,
    every.survives_json,
    every.survives_pickling,
    lattices.has_a_sound_cell,
    lattices.keeps_its_cell_wherever_it_lies,
    neighbours.is_mutual,
    neighbours.takes_offsets_of_the_cell,
    answers.takes_part,
    remembering.declares_what_it_remembers,
    remembering.draws_what_it_remembers,
    answers.changes_no_input,
    answers.remembers_nothing,
    answers.answers_the_same,
    neighbours.takes_sublattices_in_any_order,
    neighbours.finds_the_same_anew,
    remembering.renews_what_it_remembers,
    elementwise.returns_a_value_a_particle,
    elementwise.keeps_single_precision,
    elementwise.takes_particles_in_any_order,
    elementwise.is_local,
    answers.is_finite,
    fracture.is_seen_alike_from_both_ends,
    fracture.breaks_as_declared,
    fracture.breaks_beyond_its_strain,
    frames.takes_every_point_alone,
    diagnostics.labels_its_variables,
    diagnostics.measures_what_it_declares,
    diagnostics.takes_rows_in_any_order,
    steps.rests,
    steps.follows_translations,
    steps.superposes,
    steps.continues_where_it_stopped,
    steps.is_the_same_compiled,
)


def properties_of(component: type[Component]) -> list[Property]:
    """Those that are asked of components of this class."""
    return [p for p in PROPERTIES if p.is_asked_of(component)]
