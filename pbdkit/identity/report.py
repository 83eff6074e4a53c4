"""An identity as a table to read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from pbdkit.analysis.region import NEUTRAL
from pbdkit.identity.dispersion import Gradient, Range
from pbdkit.identity.elasticity import SAME, Elasticity
from pbdkit.identity.identity import DIFFUSION, NEITHER, Identity, LongWaves

if TYPE_CHECKING:
    from rich.table import Table

SYMMETRIES = {
    "isotropic": "isotropic {}",
    "anisotropic": "anisotropic {}",
    "square": "{} with the symmetry of a square",
    "orthotropic": "orthotropic {}",
    "general": "{} with no axis of symmetry",
}
Row = tuple[str, str]


def verdict(found: Identity) -> str:
    """What it is, in a few words."""
    if found.kind == NEITHER:
        return "neither diffusion nor elasticity"
    return SYMMETRIES[found.symmetry or "general"].format(found.kind)


def table(found: Identity) -> Table:
    """A row a property; h is the spacing."""
    from rich import box
    from rich.table import Table

    rows = Table(box=box.SIMPLE, show_header=False, pad_edge=False)
    rows.add_column(no_wrap=True)
    rows.add_column()
    for name, value in (*_what(found), *_waves(found), *_character(found)):
        rows.add_row(name, value)
    return rows


def _what(found: Identity) -> Iterator[Row]:
    yield "it is", verdict(found)
    for n, reason in enumerate(found.reasons):
        yield "because" if n == 0 else "and", reason
    yield "spacing h", f"{_number(found.spacing)} lattice unit{'s' if found.spacing != 1 else ''}"
    if found.diffusivity is not None:
        yield "diffusivity D", f"{_number(found.diffusivity)} h²/step"
    if found.kind != DIFFUSION and found.body is not None:
        yield from _elastic(found, found.body)


def _elastic(found: Identity, body: Elasticity) -> Iterator[Row]:
    (_, c12, c16), (_, c22, c26), (*_, c66) = body.stiffness / body.stiffness[0, 0]
    ratios = {"C22": c22, "C12": c12, "C66": c66}
    ratios |= {name: c for name, c in (("C16", c16), ("C26", c26)) if abs(c) > SAME}
    text = ", ".join(f"{name} {_number(c)}" for name, c in ratios.items())
    yield "elastic constants", f"{text} in units of C11 = {_number(body.stiffness[0, 0])} h²/step"
    if (ratio := found.poisson_ratio) is not None:
        strain = f", {_number(ratio / (1 + ratio))} in plane strain" if ratio > -0.999 else ""
        yield "Poisson's ratio", f"{_number(ratio)} in plane stress{strain}"
        return
    along = [body.poisson_ratio(angle) for angle in (0.0, 90.0)]
    texts = ["none" if r is None else _number(r) for r in along]
    yield "Poisson's ratio", f"{texts[0]} pulled along x, {texts[1]} along y (plane stress)"
    yield "anisotropy", f"4 C66 / (C11 + C22 - 2 C12) = {_number(body.zener)}, isotropic 1"
    if body.axis is not None:
        yield "axis of symmetry", f"at {_number(body.axis)}°"


def _waves(found: Identity) -> Iterator[Row]:
    if found.long is None:
        return
    one = found.kind == DIFFUSION
    for name, waves in (("fast", found.long.fast), ("slow", found.long.slow)):
        if not one or (name == "fast" and not found.isotropic):
            label = "diffusivity D" if one else f"{name} long waves"
            yield label, _range_text(waves, one=one)
    speeds = [found.speed(d) for d in _ends(found.long)]
    if found.memory == 0.0:
        yield "wave speed", f"none without memory; as memory goes to 1, {_speeds(found.long)}"
    elif None in speeds:
        yield "wave speed", f"none with memory {found.memory:g}"
    else:
        text = _span(*(speed or 0.0 for speed in speeds))
        yield "wave speed", f"{text} h/step with memory {found.memory:g}"
    for gradient in found.long.gradients:
        yield "gradient length²", _gradient_text(gradient)


def _ends(long: LongWaves) -> tuple[float, float]:
    return long.slow.smallest, long.fast.largest


def _speeds(long: LongWaves) -> str:
    return f"{_span(*(float(np.sqrt(max(d, 0.0))) for d in _ends(long)))} h/step"


def _range_text(waves: Range, *, one: bool) -> str:
    unit = "h²/step" if one else "h²/step diffusivity"
    if waves.largest - waves.smallest < 1e-8 * abs(waves.largest):
        return f"{_number(waves.largest)} {unit} in every direction"
    return (
        f"{_number(waves.largest)} {unit} along {_number(waves.at_largest)}°, "
        f"{_number(waves.smallest)} along {_number(waves.at_smallest)}°"
    )


def _gradient_text(gradient: Gradient) -> str:
    where = (
        f"along {_number(gradient.direction)}°, across rows {_number(gradient.rows_apart)} h apart"
    )
    fast, slow = gradient.material
    values = _number(fast) if abs(fast - slow) < 1e-9 else f"{_number(fast)} and {_number(slow)}"
    return f"{values} h² {where}"


def _span(low: float, high: float) -> str:
    return _number(low) if high - low < 1e-9 * high else f"{_number(low)} to {_number(high)}"


def _character(found: Identity) -> Iterator[Row]:
    spectrum, yes = found.spectrum, {True: "yes", False: "no"}
    turning = f", imaginary parts up to {_number(spectrum.imaginary)}"
    yield (
        "eigenvalues",
        f"{_number(spectrum.smallest)} to {_number(spectrum.largest)}"
        + turning * (spectrum.imaginary > NEUTRAL),
    )
    yield "relaxation", _relaxation_text(found)
    yield "linear", yes[found.linear]
    yield "symmetric", "yes, k weighs for j as j for k" if found.symmetric else "no"
    yield "turns with the body", yes[found.turns]
    yield "rests at free edges", yes[found.rests_at_edges]


def _relaxation_text(found: Identity) -> str:
    with_memory = f" with memory {found.memory:g}" if found.memory else ""
    bound = found.spectrum.largest_stable_relaxation
    if bound is not None:
        return f"stable below {_number(bound)}{with_memory}"
    grows = found.spectrum.largest > 1.0 + NEUTRAL or abs(found.memory) >= 1.0
    return f"diverges at any{with_memory}" if grows else "no bound"


def _number(value: float) -> str:
    """Six digits; what is rounding, in units of the spacing, is 0."""
    return f"{round(value, 11) + 0.0:.6g}"
