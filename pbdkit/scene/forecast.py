"""What `check` says of an experiment without running it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.scene.bonds import count_bonds
from pbdkit.scene.leading import kinds_at
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.scene.sizes import MIB, machine_memory, sizes_of


@dataclass(frozen=True)
class Forecast:
    """Counts, with followers at step 1; the scene's memory and its output in MiB; warnings."""

    particles: int
    followers: int
    bonds: int
    memory_mib: float
    output_mib: float
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return asdict(self) | {"warnings": list(self.warnings)}


def forecast(scene: Scene) -> Forecast:
    """The forecast of a scene."""
    sizes = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.count)
    kinds = kinds_at(scene.raster, scene.leading, 1)
    warnings = list(scene.warnings)
    if not (kinds == FOLLOWER).any():
        warnings.append("leaders: everybody leads in step 1, nobody follows")
    if not scene.leading:
        warnings.append("leaders: there are none, nothing will move")
    if sizes.output > machine_memory():
        warnings.append(
            f"record: the output of {sizes.output / 2**30:.3g} GiB exceeds this machine's memory: "
            "record fewer steps to open it at once"
        )
    return Forecast(
        particles=scene.raster.count,
        followers=int(np.count_nonzero(kinds == FOLLOWER)),
        bonds=count_bonds(scene.raster, scene.neighbourhood),
        memory_mib=round(sizes.memory / MIB, 3),
        output_mib=round(sizes.output / MIB, 3),
        warnings=tuple(warnings),
    )


def refuse_too_much_output(scene: Scene) -> None:
    """Raises ExperimentError where the records of a run cannot all be in memory at once."""
    sizes = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.count)
    if sizes.output > machine_memory():
        raise scene.experiment.located(
            ExperimentError(
                f"the records take {sizes.output / 2**30:.3g} GiB, more than this machine's "
                "memory: record fewer steps, or let `pbdkit run` stream them into a file",
                ("record",),
            )
        )
