"""What `check` says of a scene's size comes out."""

import tracemalloc

import pytest

import pbdkit
from pbdkit.analysis.forecast import forecast
from pbdkit.results.netcdf import NetcdfSink
from pbdkit.runs.course import Run, record
from pbdkit.scene.scene import build_scene

MIB = 2**20
CHANGES = {
    "plain": [],
    "mixed": ["rule={type: mixed-coordinate, K: 0.1}"],
    "two shells": ["neighbours.shells=2"],
    "fracture": ["fracture={type: threshold, thresholds: [3.0]}"],
    "hexagonal, pe1": ["lattice.type=hexagonal", "diagnostics=[{type: pe1}]"],
}


@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_memory_and_output_are_what_check_says(change, tmp_path):
    settings = ["body.columns=400", "body.rows=300", "steps=4", "record.every=2", "diagnostics=[]"]
    scene = build_scene(pbdkit.load("start", settings=[*settings, *CHANGES[change]]))
    said = forecast(scene)
    path = tmp_path / "out.nc"

    tracemalloc.start()
    record(Run(build_scene(scene.experiment)), NetcdfSink(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak / MIB == pytest.approx(said.memory_mib, rel=0.35)
    assert path.stat().st_size / MIB == pytest.approx(said.output_mib, rel=0.05)


def test_counts_are_those_of_the_dataset():
    experiment = pbdkit.load("paper/f2", settings=["steps=2"])
    said, ds = forecast(build_scene(experiment)), pbdkit.run(experiment, progress=False)
    assert (said.particles, said.bonds) == (ds.sizes["particle"], ds.sizes["bond"])
    assert said.followers == (ds.kind[0] == 1).sum()
