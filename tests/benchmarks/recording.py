"""Measure the cost of recording: pbdkit's file, written as `pbdkit run` does, against writing the
same bytes with nothing around them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from pairing import Ratio, ratio
from sheets import Running, moving, scene_of

from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.sinks import OverlappingSink
from pbdkit.simulation import Simulation, record


def recording(size: int, steps: int, every: int) -> tuple[Ratio, str]:
    solver = {"type": "stepping", "engine": "compiled", "threads": 1}
    parts = moving(size, steps=steps, record={"every": every}, solver=solver)
    scene = scene_of(parts)
    stepping = Running(parts, every)
    stepping()
    with tempfile.TemporaryDirectory() as name:
        path, plain = Path(name) / "out.nc", Path(name) / "plain"

        def with_pbdkit():
            path.unlink(missing_ok=True)
            record(Simulation.of_scene(scene), OverlappingSink(NetcdfSink(path, replace=True)))

        with_pbdkit()
        snapshot = np.zeros(path.stat().st_size // (steps // every + 1), np.uint8)

        def by_hand():
            plain.unlink(missing_ok=True)
            with plain.open("wb", buffering=0) as file:
                file.write(snapshot)
                for _ in range(steps // every):
                    stepping()
                    file.write(snapshot)
                os.fsync(file.fileno())

        found = ratio(with_pbdkit, by_hand, 7)
        size_mb = path.stat().st_size / 1e6
    rest = found.first_s - found.second_s
    note = f"{size_mb:.0f} MB in {found.first_s:.2f} s against {found.second_s:.2f} s"
    return found, note + f", {rest * 1e3 / (steps // every + 1):.1f} ms a record more"
