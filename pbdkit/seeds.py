"""Random number generators and seeds that are derived from the `seed` of an experiment.

The streams are independent: the random numbers of a component do not depend on how many random
numbers other components generate.
"""

from __future__ import annotations

import numpy as np


def initial_generator(seed: int) -> np.random.Generator:
    """Return the generator of the initial displacements."""
    return np.random.default_rng(seed)


def component_generator(seed: int, field: str) -> np.random.Generator:
    """Return the generator of the component in a field of the experiment, such as "fracture"."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(field.encode())))


def random_field_seed(seed: int, stream: str) -> int:
    """Return the seed of a random field in space, by the name of its stream."""
    sequence = np.random.SeedSequence(seed, spawn_key=tuple(f"{stream} field".encode()))
    return int(sequence.generate_state(1)[0])


def replicate_seeds(seed: int, count: int) -> list[int]:
    """Return the seeds of the replicates of a sweep.

    Notes
    -----
    The k-th seed is ``SeedSequence(seed).spawn(count)[k].generate_state(1)[0]``.
    """
    sequences = np.random.SeedSequence(seed).spawn(count)
    return [int(sequence.generate_state(1)[0]) for sequence in sequences]
