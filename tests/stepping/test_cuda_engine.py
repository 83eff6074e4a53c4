"""The GPU engine without a GPU: kernels run in numba's simulator, and compiled as far as PTX."""

import os
import re
import subprocess
import sys
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path

import gpu_cases
import numpy as np
import pytest
from property_cases import HOLD_LEFT
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit.components import pbdkit_components
from pbdkit.plugin import FollowerRule, FractureModel, FramePolicy
from pbdkit.stepping import cuda_engine as program, engine_choice as choice, engine_choice as limits
from pbdkit.stepping.engine_choice import choose, gpu_obstacle, make_engine, missing_for_gpu
from pbdkit.stepping.numba_engine.plan import functions_of
from tests.scene.test_leader_groups_directions import CASES, vanes
from tests.stepping.numba_engine.test_engine import ANEW, sheet

ASKED = {"solver": {"type": "stepping", "engine": "gpu"}}


def test_every_kind_of_scene_matches_numpy():
    """In one process of the simulator, which takes seconds to begin; a sixth of the scenes, and
    all of them in the profile `long`."""
    every = 1 if AT_LENGTH else 6
    file = Path(__file__).parents[1] / "gpu_cases.py"
    script = [sys.executable, "-W", "ignore", str(file), str(every)]
    places = os.pathsep.join(sys.path)
    simulated = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": places}
    done = subprocess.run(script, env=simulated, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split("\n")[:-1] == gpu_cases.names(every)


@pytest.fixture
def device(monkeypatch):
    """Set a compute capability to compile for, so that no device is needed."""
    pytest.importorskip("numba_cuda", reason="numba-cuda is not installed: nox -s gpu")
    from numba.cuda import dispatcher
    from numba.cuda.cudadrv import nvvm

    if not nvvm.is_available():
        pytest.skip("CUDA's compiler is not installed: nox -s gpu")
    found = type("Device", (), {"compute_capability": (9, 0)})
    monkeypatch.setattr(dispatcher, "get_current_device", lambda: found)
    return found.compute_capability


def types_of(arrays):
    from numba import int64, typeof, void

    return void(int64, int64, *(typeof(array) for array in arrays.values()))


def text_of(scene, device):
    """The kernel of a scene as PTX."""
    from pbdkit.stepping import cuda_engine as kernel

    made = program.kernel_of(scene)
    run = kernel.make_kernel(made.source, functions_of(made.plan.levels), 1024)
    return kernel.text_of(run, types_of(made.arrays), device)


def assert_rounds_every_operation(text):
    """Nothing is contracted, by the compiler or later by the driver, or approximated."""
    assert "fma" not in text
    assert ".approx" not in text
    kinds = set(re.findall(r"\b(?:add|sub|mul|div|sqrt)(\.[a-z.]*)f(?:32|64)\b", text))
    assert kinds == {".rn."}


@pytest.mark.parametrize("rule", gpu_cases.SHIPPED)
def test_shipped_components_compile_without_calls(rule, device):
    text = text_of(gpu_cases.shipped(rule), device)
    assert_rounds_every_operation(text)
    assert "call" not in text


def test_cases_cover_all_shipped_components():
    interfaces = {"rule": FollowerRule, "fracture": FractureModel, "frame": FramePolicy}
    for field, interface in interfaces.items():
        built_in = {c.type_name() for c in pbdkit_components() if issubclass(c, interface)}
        scenes = map(gpu_cases.shipped, gpu_cases.SHIPPED)
        assert {getattr(scene.experiment, field).type for scene in scenes} == built_in


@pytest.mark.parametrize("name", ["seen by neighbours", "loads"])
def test_other_kinds_of_kernels_compile_too(name, device):
    text = text_of(gpu_cases.scenes()[name], device)
    assert_rounds_every_operation(text)
    assert "call" not in text


def test_several_blocks_call_only_synchronisation(device, monkeypatch):
    monkeypatch.setattr(program, "ALONE", 0)
    text = text_of(gpu_cases.scene_of(sheet()), device)
    assert_rounds_every_operation(text)
    called = set(re.findall(r"\.extern \.func .*?(\w+)\n", text))
    assert called == {"cudaCGGetIntrinsicHandle", "cudaCGSynchronize"}


class Various(pbdkit.FollowerRule):
    """Functions of numpy, as others' rules use them."""

    type: str = "various"

    @staticmethod
    def gather(d, r, w, p):
        size = np.sqrt(np.abs(d.x) + np.maximum(d.y, 0.0)) + np.minimum(np.floor(d.x), 1.0)
        return np.sign(size) * np.square(d.x), pbdkit.plugin.where(d.x > 0.0, d, 0.5 * d)

    @staticmethod
    def apply(total, here, p):
        return total[1] * np.exp(-np.abs(total[0])) / (1.0 + np.hypot(total[0], 1.0))


def test_numpy_functions_compile(device):
    assert "call" not in text_of(gpu_cases.scene_of(sheet(rule=Various())), device)


def test_products_contracted_without_the_option_are_refused(device, monkeypatch):
    from pbdkit.stepping import cuda_engine as kernel

    monkeypatch.setattr(kernel, "_uncontracted", nullcontext)
    with pytest.raises(pbdkit.PbdkitError, match="contracts products and sums in spite of"):
        text_of(gpu_cases.scene_of(sheet()), device)


NEWTON = [{"select": {"edge": "right"}, "motion": {"type": "newton", "mass": 1.0}}]
WALL = {"shape": {"type": "disc", "radius": 1.0, "centre": [20.0, 20.0]}}
SPRINGS = {"type": "springs"}
REFUSED = {
    "neighbours are re-evaluated": sheet(neighbours=ANEW),
    "leaders are clamped": vanes(**CASES["clamped"]),
    "leaders move by Newton's law": sheet(
        **gpu_cases.WHOLE, rule={"type": "springs"}, leaders=NEWTON
    ),
    "leaders lead along an axis": sheet(leaders=[HOLD_LEFT | {"axes": ["x"]}]),
    "obstacles push": sheet(obstacles=[WALL]),
}


@pytest.mark.parametrize("why", REFUSED)
def test_unsupported_features_are_refused_with_a_reason(why, monkeypatch):
    monkeypatch.setattr(choice, "missing_for_gpu", str)
    scene = gpu_cases.scene_of(REFUSED[why] | ASKED)
    assert gpu_obstacle(scene) == why
    with pytest.raises(pbdkit.ExperimentError) as refused:
        choose(scene)
    remedy = f"solver.engine: the GPU engine is not available: {why}; use `engine: auto`"
    assert str(refused.value) == remedy
    assert refused.value.where == ("solver", "engine")


def test_missing_requirement_is_reported(monkeypatch):
    """The package here or elsewhere, the device on machines that have the package."""
    monkeypatch.setattr(limits, "find_spec", lambda name: None)
    scene = gpu_cases.scene_of(sheet(**ASKED))
    with pytest.raises(pbdkit.ExperimentError, match=r"pip install 'pbdkit\[gpu\]'; use `eng"):
        make_engine(scene, choose(scene))
    monkeypatch.setattr(limits, "find_spec", find_spec)
    if find_spec("numba_cuda") and missing_for_gpu():
        assert re.search("no NVIDIA GPU|compiler is missing", missing_for_gpu())


def test_auto_never_selects_it(monkeypatch):
    monkeypatch.setattr(choice, "missing_for_gpu", str)
    body = {"type": "grid", "columns": 400, "rows": 400}
    assert choose(gpu_cases.scene_of(sheet(body=body, steps=5000))).engine == "compiled"
    assert choose(gpu_cases.scene_of(sheet(**ASKED))).engine == "gpu"
