"""Everything that is asked of components, in the order in which it is asked."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.testing.properties import (
    elementwise,
    every,
    lattice_parts,
    quantities,
    repetition,
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
    lattice_parts.has_a_sound_cell,
    lattice_parts.keeps_its_cell_wherever_it_lies,
    lattice_parts.is_mutual,
    lattice_parts.takes_offsets_of_the_cell,
    quantities.labels_its_variables,
    repetition.takes_part,
    quantities.declares_what_it_remembers,
    quantities.draws_what_it_remembers,
    repetition.changes_no_input,
    repetition.remembers_nothing,
    repetition.answers_the_same,
    lattice_parts.takes_sublattices_in_any_order,
    lattice_parts.finds_the_same_anew,
    lattice_parts.takes_every_point_alone,
    elementwise.returns_a_value_a_particle,
    repetition.is_finite,
    quantities.renews_what_it_remembers,
    elementwise.keeps_single_precision,
    elementwise.takes_particles_in_any_order,
    elementwise.is_local,
    elementwise.is_seen_alike_from_both_ends,
    elementwise.breaks_as_declared,
    elementwise.breaks_beyond_its_strain,
    quantities.measures_what_it_declares,
    quantities.takes_rows_in_any_order,
    steps.rests,
    steps.follows_translations,
    steps.superposes,
    steps.continues_where_it_stopped,
    steps.is_the_same_compiled,
)


def properties_of(component: type[Component]) -> list[Property]:
    """Those that are asked of components of this class."""
    return [p for p in PROPERTIES if issubclass(component, p.interfaces)]
