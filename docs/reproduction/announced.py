"""The page of what the paper announces: anisotropy, and plastic-like pieces."""

import numpy as np
from drawing import LINES, abreast, curves
from runs import Floats, Sheet, run_text

SIZE, STEPS = 61, 60
PULLS, SPEED = (3.0, 5.2, 7.0), 1.2
"""Thresholds of the torn sheet, which decide how far it is pulled, and its pull a step."""
POINT = """version: 1
name: point-{name}
lattice: {lattice}
body: {{type: grid, columns: {size}, rows: {size}}}
neighbours: {neighbours}
rule: {{type: barycentre}}
leaders:
  - select: {{nearest: [{centre}]}}
    motion: {{type: displace, displacement: [1.0, 0.0]}}
    until: 1
steps: {steps}
record: {{at: [{half}, {steps}]}}
diagnostics: [{{type: displacement}}]
"""
SQUARE, FOUR = "{type: square, a: 1.0}", "{type: coordination, shells: 1}"
CASES = {
    "square": (SQUARE, FOUR, 1.0, [(1, 0), (0, 1)]),
    "weighted": (
        SQUARE,
        "{type: euclidean, radius: 1.0, weights: [1.0, 0.25]}",
        1.0,
        [(1, 0), (0, 1), (0, 2)],
    ),
    "rectangular": (
        "{type: rectangular, a: 1.0, b: 0.6}",
        "{type: chebyshev, shells: 1}",
        0.6,
        [(1, 0), (0, 0.6), (1, 0.6), (1, -0.6)],
    ),
}
"""Lattice, neighbours, row distance, and one of each pair of rest offsets, for the prediction."""
TORN = """version: 1
name: torn-lambda
lattice: {{type: square, a: 1.0}}
body: {{type: grid, columns: 10, rows: 10}}
rule: {{type: barycentre}}
fracture: {{type: threshold, thresholds: [{threshold}], placement: {placement}}}
leaders:
  - {{select: {{edge: left}}, motion: {{type: hold}}}}
  - select: {{edge: right}}
    motion: {{type: velocity, velocity: [{speed}, 0.0], steps: 10}}
    until: {until}
steps: {steps}
record: {{every: 10}}
diagnostics: [{{type: displacement}}, {{type: pe1-intact}}]
"""
SETTLED = 1500


def point_text(name: str) -> str:
    """The experiment of a point disturbance."""
    lattice, neighbours, b, _ = CASES[name]
    centre = f"[{SIZE // 2}, {SIZE // 2 * b:g}]"
    return POINT.format(
        name=name,
        lattice=lattice,
        neighbours=neighbours,
        size=SIZE,
        centre=centre,
        steps=STEPS,
        half=STEPS // 2,
    )


def spreading(sheet: Sheet) -> Floats:
    """D_x and D_y: half the growth of the second moments of u_x, a step."""
    place = sheet.on_grid(sheet.position[:1])[0]
    u = sheet.u[-2:, ..., 0]
    weight = u / u.sum(axis=(1, 2), keepdims=True)
    mean = (weight[..., None] * place).sum(axis=(1, 2))
    moment = (weight[..., None] * (place - mean[:, None, None]) ** 2).sum(axis=(1, 2))
    return (moment[1] - moment[0]) / (2 * (STEPS - STEPS // 2))


def elastic_signs() -> dict[str, float]:
    """What an elastic body would show and a diffusing one does not, with weighted neighbours.

    cross: the largest u_y where a point was pushed along x. turned: how much u_x after that differs
    from u_y after a push along y, which would feel another stiffness.
    """
    text = point_text("weighted")
    along_x = run_text(text).u
    along_y = run_text(text.replace("displacement: [1.0, 0.0]", "displacement: [0.0, 1.0]")).u
    assert along_y[..., 1].any()
    return {
        "cross": float(np.abs(along_x[..., 1]).max()),
        "turned": float(np.abs(along_x[..., 0] - along_y[..., 1]).max()),
    }


def predicted(name: str) -> Floats:
    """Half the mean square of the rest offsets along each axis."""
    offsets = np.array(CASES[name][3])
    return (offsets**2).mean(axis=0) / 2


def torn_text(threshold: float, placement: float, until: int = 400, steps: int = SETTLED) -> str:
    """A sheet torn apart; its right column leads to step `until`."""
    return TORN.format(
        speed=SPEED, threshold=threshold, placement=placement, until=until, steps=steps
    )


def strain(sheet: Sheet) -> float:
    """The strain of the piece at the clamp, from its left to its torn column, at the end."""
    u = sheet.u[-1, :-1, :, 0].mean(axis=1)
    return float((u[-1] - u[0]) / (len(u) - 1))


def page() -> str:
    """Markdown of the whole page."""
    return f"""# Anisotropy and plasticity, as the paper announces them

Made by `python docs/reproduction`; every number is measured in that run.

{_anisotropy()}
{_plasticity()}"""


def _anisotropy() -> str:
    sheets = {name: run_text(point_text(name)) for name in CASES}
    found = {name: spreading(sheet) for name, sheet in sheets.items()}
    titles = {n: f"{n}\nD_x/D_y = {found[n][0] / found[n][1]:.3f}" for n in CASES}
    picture = abreast(
        {titles[n]: s for n, s in sheets.items()}, STEPS, "u", "anisotropy.png", (0, 60, 0, 60)
    )
    rows = "\n".join(
        f"| {name} | {d[0]:.4f} | {d[1]:.4f} | {d[0] / d[1]:.4f} | "
        f"{predicted(name)[0] / predicted(name)[1]:.4f} | {(d[0] / d[1]) ** 0.5:.3f} |"
        for name, d in found.items()
    )
    signs = elastic_signs()
    return f"""## Anisotropy

One particle in the middle of a sheet of {SIZE} × {SIZE} is moved by 1 along x in one step and then
follows. Its displacement spreads; D is half the growth of the second moment of u_x per step,
between steps {STEPS // 2} and {STEPS}, and the prediction is half the mean square of the rest
offsets. √(D_x/D_y) is the ratio of the widths of the spot.

| | D_x | D_y | D_x/D_y | predicted | width x / width y |
| --- | --- | --- | --- | --- | --- |
{rows}

![The displacement {STEPS} steps after a point was moved](../pictures/reproduction/{picture})

Weighted euclidean neighbours on the square lattice, w_y = 1/4, so that the neighbours two rows up
and down count as near as those one column away:

```yaml
{point_text("weighted")}```

A rectangular lattice, all eight neighbours:

```yaml
{point_text("rectangular")}```

The anisotropy is of the neighbourhood, not of a stiffness: along the axis in which a neighbourhood
reaches further the body relaxes faster. With weighted neighbours a push along x moves no particle
along y (at most {signs["cross"]:.1g}), and a push along y spreads as one along x does (within
{signs["turned"]:.0e}), where in an elastic body it would meet shear instead of stretch.
"""


def _plasticity() -> str:
    placements = np.array([0.8, 0.9, 1.0, 1.1, 1.2])
    lines, table = {}, []
    for threshold in PULLS:
        strains = np.array([strain(run_text(torn_text(threshold, p))) for p in placements])
        lines[f"threshold {threshold:g}"] = (placements, strains)
        cells = " | ".join(f"{s:.5f}" for s in strains)
        table.append(f"| {threshold:g} | {cells} |")
    assert len(lines) <= len(LINES)
    axes = ("placement λ", "strain that stays")
    graph = curves(lines, axes, "permanent-strain.png")
    pieces = {f"λ = {p}": run_text(torn_text(5.2, p)) for p in (0.8, 1.0, 1.2)}
    picture = abreast(pieces, SETTLED, "pe1_intact", "lambda.png", (-2, 12, -2, 11))
    loose = {p: run_text(torn_text(5.2, p, until=20, steps=300)) for p in (0.8, 1.0, 1.2)}
    drift = {p: float(s.u[-1, -1, 5, 0] - s.u[-11, -1, 5, 0]) / 100 for p, s in loose.items()}
    head = " | ".join(f"λ = {p:g}" for p in placements)
    return f"""## Pieces after a fracture: plastic-like and elastic-like

After a fracture each end of a broken bond sees a fictitious point at m_j + λ R. The paper says that
its distance makes edges that recover (λ = 1), loosen or contract. A sheet is torn at 1.2 a step,
and the piece at the clamp settles for {SETTLED} steps; its strain is measured between its left and
its torn column:

| threshold | {head} |
| --- | {" | ".join("---" for _ in placements)} |
{chr(10).join(table)}

![The strain that stays, against λ, for three thresholds](../pictures/reproduction/{graph})

![The pieces at the clamp, step {SETTLED}: λ = 0.8, 1, 1.2](../pictures/reproduction/{picture})

The strain that stays is λ − 1, uniform over the piece, whatever the threshold, and so however far
the piece was pulled before it tore. It is the effect of a load on the broken edge that never ends,
and no plastic strain in the usual sense, which would depend on the deformation before.

```yaml
{torn_text(5.2, 1.2, steps=400)}```

Released at step 20 instead of held, the torn column, which has one broken side, settles at no place
at all unless λ = 1: at the end of {300} steps it moves by {drift[0.8]:.4f}, {drift[1.0]:.4f} and
{drift[1.2]:.4f} a step for λ = 0.8, 1 and 1.2, for ever, by (1 − λ)/4.

```yaml
{torn_text(5.2, 1.2, until=20, steps=300)}```
"""
