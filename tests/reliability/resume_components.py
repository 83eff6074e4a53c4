"""Stop and resume runs with every component, built in and of the plugins in this repository, by
both engines and other threads, and with the other options of a run.

    python tests/reliability/resume_components.py [--scenes N] [--seed S] [--only NAME]
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from stopping import ENGINES, NUMPY, resumed_otherwise
from trials import BASE, BREAKING, EXPERIMENTS, row

from pbdkit.components import pbdkit_components
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.model.reading import read_text
from pbdkit.plugin import Component
from pbdkit.scene.scene import build_scene
from pbdkit.testing.subject import examples_of, experiments_with, full_name

PLUGINS = Path(__file__).parents[2] / "plugins"
MODULES = {name: f"pbdkit_{name}" for name in ("kagome", "pantograph", "weibull")}
SMALLER = {
    "body": {"type": "grid", "columns": 9, "rows": 7},
    "steps": 12,
    "record": {"every": 3},
}
DIVERGING = {
    "initial": {"type": "noise", "amplitude": 0.01},
    "solver": {"type": "stepping", "relaxation": 4.0},
    "steps": 900,
    "record": {"every": 50},
}
AFTER_FIVE_THOUSAND = {
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "initial": {"type": "noise", "amplitude": 0.01},
    "solver": {"type": "stepping", "relaxation": 2.03},
    "steps": 40000,
    "record": {"every": 3000},
}
SPECIAL: dict[str, dict[str, Any]] = EXPERIMENTS | {
    "diverging": BASE | DIVERGING,
    "diverging late": BASE | AFTER_FIVE_THOUSAND,
    "diverging, nothing recorded": BASE | DIVERGING | {"record": {"every": 900}},
    "zlib, float32": BASE | BREAKING | {"record": {"dtype": "float32", "compression": "zlib"}},
    "float32 steps": BASE | BREAKING | {"solver": {"type": "stepping", "precision": "float32"}},
    "memory": BASE | {"solver": {"type": "stepping", "relaxation": 0.8, "memory": 0.5}},
    "lag": BASE | BREAKING | {"frame": {"type": "mean", "lag": 1}},
    "released": BASE
    | {"leaders": [BASE["leaders"][0], BASE["leaders"][1] | {"from": 5, "until": 17}]},
    "chosen steps": BASE | BREAKING | {"record": {"at": [3, 4, 21]}},
}


def plugins() -> dict[str, list[type[Component]]]:
    """The components of each plugin."""
    found = {}
    for name, module in MODULES.items():
        sys.path.append(str(PLUGINS / f"pbdkit-{name}"))
        found[name] = import_module(module).pbdkit_components()
    return found


def cases(scenes: int) -> Iterator[tuple[str, dict[str, Any], list[type[Component]]]]:
    """Name, experiment, components besides the built-in ones."""
    for name, parts in SPECIAL.items():
        yield name, parts, []
    of_plugins = plugins()
    for name, own in of_plugins.items():
        for file in sorted((PLUGINS / f"pbdkit-{name}" / "experiments").glob("*.yaml")):
            parts = read_text(file.read_text(), file.name).data | {
                "steps": 12,
                "record": {"every": 3},
            }
            yield f"{name}/{file.stem}", parts, own
    for own in ([], *of_plugins.values()):
        for component in own or pbdkit_components():
            for example in examples_of(component):
                yield from in_scenes(example, own, scenes)


def in_scenes(
    example: Component, own: list[type[Component]], scenes: int
) -> Iterator[tuple[str, dict[str, Any], list[type[Component]]]]:
    """In the first scenes that take it, and that are not alike."""
    parts: dict[str, Any] = {"steps": 7}
    if own:
        parts |= {f: p for c in own for f, p in partner(c, example)}
    found = 0
    for experiment in experiments_with(example, parts):
        try:
            build_scene(experiment)
        except ExperimentError:
            continue
        dumped = experiment.model_dump(mode="json", by_alias=True)
        yield f"{full_name(example)}, {found}", dumped, own
        found += 1
        if found == scenes:
            return
    if not found:
        raise ValueError(f"no scene takes {full_name(example)}")


def partner(component: type[Component], example: Component) -> Iterator[tuple[str, Any]]:
    """Neighbours and lattices of a plugin, for what else it offers."""
    made = examples_of(component)[0]
    if type(made).__name__ in ("BondSteps", "Fibres") and type(example) is not component:
        yield "neighbours", made
    if type(made).__name__ == "Kagome" and type(example).__name__ == "BondSteps":
        yield "lattice", made


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--scenes", type=int, default=2)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", default="")
    asked.add_argument("--numpy", action="store_true", help="no compiled engine: seconds a kernel")
    given = asked.parse_args()
    warnings.simplefilter("ignore")
    count = stops = failed = 0
    begun = time.time()
    with tempfile.TemporaryDirectory() as folder:
        for name, parts, own in cases(given.scenes):
            if given.only not in name:
                continue
            draw = random.Random(f"{given.seed}/{name}")
            engines = [NUMPY] if given.numpy else ENGINES
            try:
                found, stopped = resumed_otherwise(parts, Path(folder), draw, own, engines)
            except PbdkitError as error:
                found, stopped = [f"{type(error).__name__}: {error}"], 0
            except Exception:
                found, stopped = [traceback.format_exc()], 0
            count, stops, failed = count + 1, stops + stopped, failed + bool(found)
            for finding in found:
                print(f"{name}: {finding}", flush=True)
    print(f"{time.time() - begun:.0f} s")
    row("runs gone on with that are identical 100 %", f"{count - failed} of {count}, {stops} stops")
    raise SystemExit(failed > 0)


if __name__ == "__main__":
    main()
