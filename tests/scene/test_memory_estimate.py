"""The predictions of `check` for the size of a scene are those of the run."""

import json
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record
from pbdkit.stability.forecast import forecast

MIB = 2**20
CHANGES = {
    "plain": [],
    "mixed": ["rule={type: mixed-coordinate, K: 0.1}"],
    "two shells": ["neighbours.shells=2"],
    "fracture": ["fracture={type: threshold, thresholds: [3.0]}"],
    "hexagonal, pe1": ["lattice.type=hexagonal", "diagnostics=[{type: pe1}]"],
}


@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_memory_and_output_match_the_estimate_of_check(change, tmp_path):
    settings = ["body.columns=240", "body.rows=180", "steps=4", "record.every=2", "diagnostics=[]"]
    scene = build_scene(pbdkit.load("start", settings=[*settings, *CHANGES[change]]))
    said = forecast(scene)
    path = tmp_path / "out.nc"

    tracemalloc.start()
    record(Simulation.of_scene(build_scene(scene.experiment)), NetcdfSink(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak / MIB == pytest.approx(said.memory_mib, rel=0.35)
    assert path.stat().st_size / MIB == pytest.approx(said.output_mib, rel=0.05)


@pytest.mark.parametrize("change", ["plain", "fracture"])
def test_sizes_of_small_files_match_the_estimate_of_check(change, tmp_path):
    """Columns take whole chunks of some MiB, of which the last is padded."""
    settings = ["body.columns=40", "body.rows=30", "steps=60", "record.every=1", "diagnostics=[]"]
    scene = build_scene(pbdkit.load("start", settings=[*settings, *CHANGES[change]]))
    path = tmp_path / "out.nc"
    record(Simulation.of_scene(scene), NetcdfSink(path))
    assert path.stat().st_size / MIB == pytest.approx(forecast(scene).output_mib, rel=0.05)


def test_counts_match_the_dataset():
    experiment = pbdkit.load("paper/f2", settings=["steps=2"])
    said, ds = forecast(build_scene(experiment)), pbdkit.run(experiment, progress=False)
    assert (said.particles, said.bonds) == (ds.sizes["particle"], ds.sizes["bond"])
    assert said.followers == (ds.kind[0] == 1).sum()


PEAK = """
import json, sys
from pathlib import Path
from pbdkit.api import load
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.simulation import Simulation, record
from pbdkit.scene.scene import build_scene
from pbdkit.scene.memory_estimate import sizes_of

def run(side):
    size = [f"body.columns={side}", f"body.rows={side}"]
    scene = build_scene(load("paper/a", settings=[*sys.argv[3:], *size]))
    record(Simulation.of_scene(scene), NetcdfSink(Path(sys.argv[1]), replace=True))
    status = Path("/proc/self/status").read_text()
    return scene, 1024 * int(status.split("VmHWM:")[1].split()[0])

_, little = run(12)
scene, peak = run(int(sys.argv[2]))
sizes = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.count)
print(json.dumps([peak - little, sizes.memory]))
"""
"""Memory of a run beyond that of one with a few particles in the same process, and the
prediction."""
CALIBRATED = [
    "rule={type: elastic, poisson_ratio: 0.3}",
    "neighbours={type: chebyshev}",
    "frame={type: natural}",
]
STRESS = "diagnostics=[{type: stress, youngs_modulus: 1.0}, {type: strain}]"
ANEW = "neighbours={type: euclidean, radius: 1.2, reevaluate: true}"
TAKING_MORE = {
    "neighbours found anew": (140, [ANEW]),
    "stress and strain": (220, [*CALIBRATED, STRESS]),
}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system tells no peak")
@pytest.mark.parametrize(("side", "settings"), TAKING_MORE.values(), ids=TAKING_MORE)
def test_peak_memory_matches_the_estimate_of_check(side, settings, tmp_path):
    settings = ["steps=3", "record.every=3", "diagnostics=[]", *settings]
    call = [sys.executable, "-c", PEAK, str(tmp_path / "out.nc"), str(side), *settings]
    used, said = json.loads(subprocess.run(call, capture_output=True, check=True).stdout)
    assert said == pytest.approx(used, rel=0.35)


ALONE = """
import json, sys
from pathlib import Path
from pbdkit.api import load
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.simulation import Simulation, peak_memory, record
from pbdkit.scene.scene import build_scene
from pbdkit.scene.memory_estimate import sizes_of

scene = build_scene(load("paper/a", settings=sys.argv[2:]))
record(Simulation.of_scene(scene), NetcdfSink(Path(sys.argv[1]), replace=True))
peak = peak_memory()
said = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.count).memory
modules = [name for name, of in sys.modules.items() if getattr(of, "__spec__", None)]
print(json.dumps([peak, said, [m for m in modules if not m.startswith(("_", "kernel"))]]))
"""
IMPORTS = """
import contextlib, importlib, json, sys
for name in json.load(sys.stdin):
    with contextlib.suppress(Exception):
        importlib.import_module(name)
from pbdkit.simulation import peak_memory
print(peak_memory())
"""
EQUILIBRIA = {"factors": (80, [*CALIBRATED, "solver.method=lu"]), "grids": (800, [])}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system tells no peak")
@pytest.mark.parametrize(
    ("side", "settings"), in_turn(EQUILIBRIA.values(), 2), ids=in_turn(EQUILIBRIA, 2)
)
def test_memory_of_an_equilibrium_matches_the_estimate_of_check(side, settings, tmp_path):
    """The peak of a fresh process above that of its imports, within 30 %."""
    sides = [f"body.columns={side}", f"body.rows={side}", "solver={type: equilibrium}"]
    few = ["steps=3", "record.every=3", "diagnostics=[]", "leaders.1.until=3"]
    call = [sys.executable, "-c", ALONE, str(tmp_path / "out.nc"), *few, *sides, *settings]
    if not settings:  # The compiler's memory is not part of the estimate.
        small = ["body.columns=40", "body.rows=40", "solver.method=multigrid"]
        subprocess.run([*call, *small], capture_output=True, check=True)
    peak, said, modules = json.loads(subprocess.run(call, capture_output=True, check=True).stdout)
    call = [sys.executable, "-c", IMPORTS]
    found = subprocess.run(
        call, input=json.dumps(modules).encode(), capture_output=True, check=True
    )
    used = peak - int(found.stdout.splitlines()[-1])
    assert said == pytest.approx(used, rel=0.3)
