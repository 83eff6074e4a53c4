"""What stands in the way of the GPU engine, told without loading what it needs."""

from __future__ import annotations

from importlib.util import find_spec

from pbdkit.experiment.newton import Newton
from pbdkit.scene.guides import has_guides
from pbdkit.scene.scene import Scene
from pbdkit.stepping.clamps import Clamps


def what_is_missing() -> str:
    """The package, the compiler or the device that is not there; empty where all are."""
    install = "pip install 'pbdkit[gpu]'"
    if not (find_spec("numba") and find_spec("numba_cuda")):
        return f"numba-cuda is not installed: {install}"
    from numba import cuda

    if cuda.config.ENABLE_CUDASIM:
        return ""
    if not cuda.is_available():
        return "there is no GPU, or no driver of NVIDIA's for it"
    return "" if cuda.cudadrv.nvvm.is_available() else f"CUDA's compiler is missing: {install}"


def what_gpus_lack(scene: Scene) -> str:
    """Why a scene cannot be stepped on a GPU; empty where it can."""
    if scene.experiment.neighbours.nearness():
        return "neighbours are found anew"
    if any(isinstance(leading.group.motion, Newton) for leading in scene.leading):
        return "leaders move by Newton's law"
    if Clamps(scene).numbers:
        return "leaders are clamped"
    if has_guides(scene.leading):
        return "leaders lead along an axis"
    return "obstacles push" if scene.barriers else ""
