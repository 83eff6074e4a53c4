"""Case f: fracture of the hexagonal lattice."""

import numpy as np
from claims import Claim, Section
from drawing import configurations, histories
from one_threshold import same_parameters, which
from runs import Floats, Sheet, in_the_gap, parted, rebound, run, steps_text

COLUMN, ROW = 7, 4
"""Particle 133 with two layers of frame."""
THRESHOLDS = np.arange(4.0, 6.61, 0.2).round(2)
TIMES = [1, 7, 8, 9, 10, 12, 27]


def x_of(sheet: Sheet) -> Floats:
    """Return the x displacement of particle 133."""
    return sheet.u[:, COLUMN, ROW, 0]


def torn(name: str) -> dict[float, Sheet]:
    """Return the case at every threshold at which all rows separate."""
    shells = 1 if name == "paper/f1" else 2
    sheets = {float(t): run(name, f"fracture.thresholds={[float(t)] * shells}") for t in THRESHOLDS}
    return {t: sheet for t, sheet in sheets.items() if None not in parted(sheet)}


def dent(sheet: Sheet) -> float:
    """Return the depth of the torn surface: outer rows minus middle rows, at the end."""
    surface = sheet.u[-1, -2, :, 0]
    return float(min(surface[:2].mean(), surface[-2:].mean()) - surface[4:6].mean())


def section() -> Section:
    """Return the section of case f."""
    names = ("paper/f1", "paper/f2", "paper/f2-early", "paper/f2-cusp")
    pictures = [
        (
            configurations(run("paper/f1"), [*TIMES, 400], "f1-pe1.png"),
            "Figure 18: paper/f1, one shell, configurations and PE1",
        ),
        (
            configurations(run("paper/f2"), [*TIMES, 401], "f2-pe1.png"),
            "Figure 20: paper/f2, two shells, configurations and PE1",
        ),
        (
            configurations(run("paper/f2-cusp"), [9, 27, 109, 401], "f2-cusp-pe1.png"),
            "Figure 20 with a second fracture: paper/f2-cusp, PE1 at times 9, 27, 109, 401",
        ),
        (
            histories({n: (run(n), COLUMN, ROW) for n in names}, "f-133.png", 400, log=True),
            "Figures 19 and 21: x, y and PE1 of particle 133",
        ),
    ]
    words = (
        "As case d, on the hexagonal lattice with two layers of frame and thresholds of 5.2: "
        "`paper/f1` with one shell of neighbours, `paper/f2` with two."
    )
    return Section(
        "Case f: the lattice", words, [same_parameters(), *_one_shell(), *_two_shells()], pictures
    )


def _one_shell() -> list[Claim]:
    f1, d1, layer = run("paper/f1"), run("paper/d1"), run("paper/f1", "frame.layers=1")
    back = rebound(x_of(f1))
    names = ("d1", "d2", "d2-frame-bonds")
    square = {n: rebound(run(f"paper/{n}").u[:, 7, 5, 0]) for n in names}
    back_square = square["d2-frame-bonds"]
    assert back is not None
    assert back_square is not None
    family = torn("paper/f1")
    turning = [t for t, sheet in family.items() if rebound(x_of(sheet))]
    dented = [t for t, sheet in family.items() if dent(sheet) > 0.3]
    gaps = sorted({in_the_gap(sheet) for sheet in family.values()})
    return [
        Claim(
            "the behaviour is very different from the square lattice case",
            f"The largest displacement of the piece at step 400 is {f1.residual():.2f}, and "
            f"{d1.residual():.3f} on the square lattice. The rows separate at steps "
            f"{steps_text(parted(f1))}, and {steps_text(parted(d1))} on the square lattice.",
            f1.residual() > 10 * d1.residual(),
        ),
        Claim(
            "two points of the frame remain in the middle",
            f"{in_the_gap(f1)} frame points are in the gap at step 400. This number is "
            f"{which(gaps)} at all thresholds at which the sheet separates "
            f"({which(list(family))}).",
            in_the_gap(f1) == 2,
        ),
        Claim(
            "they are stressed from two opposite sides … the average of the displacements",
            f"The number of points in the gap is {in_the_gap(f1)} with the `mean` frame and "
            f"{in_the_gap(run('paper/f1', 'frame.type=first'))} if each frame point follows one "
            "particle.",
            in_the_gap(f1) == 2 and in_the_gap(run("paper/f1", "frame.type=first")) == 0,
        ),
        Claim(
            "a different equilibrium configuration is reached",
            "At step 400 the largest displacement of the piece from its reference position is "
            f"{f1.residual():.2f}, and the piece still moves by up to "
            f"{f1.of('pe2')[400].max():.1g} per step.",
            f1.residual() > 0.5,
        ),
        Claim(
            "this results in a concave final surface",
            f"The outer rows of the torn surface are {dent(f1):.2f} farther right than its "
            f"middle rows. This difference exceeds 0.3 at the thresholds {which(dented)}. The "
            f"thresholds {which(list(family))} were tried.",
            dent(f1) > 0.3,
        ),
        Claim(
            "a rebound mechanism [of 133] can be outlined",
            f"x of particle 133 decreases to {back[1]:.3f} at step {back[0]} and then increases to "
            f"{back[2]:.3f}. There is a rebound at the thresholds {which(turning)}. The thresholds "
            f"{which(list(family))} were tried.",
            back[0] > 10,
        ),
        Claim(
            "in the square lattice this [rebound] behaviour does not exist",
            "Figure 16 of the paper shows a rebound. There is none in the runs of "
            "`paper/d1` and `paper/d2`. In `paper/d2-frame-bonds`, the x displacement of particle "
            f"103 decreases to {back_square[1]:.3f} and then increases to {back_square[2]:.3f}.",
            not any(square.values()),
            "`paper/d1` and `paper/d2`, but not with `paper/d2-frame-bonds`",
            not (square["d1"] or square["d2"]),
        ),
        Claim(
            "j=133 [a central point]",
            f"With two layers of frame, particle 133 is in column {COLUMN + 1}, row {ROW + 1} of "
            "the body. With one layer, which suffices for one shell, this particle has the "
            f"number {layer.number(COLUMN, ROW)}.",
            layer.number(COLUMN, ROW) == 133,
            "two layers of frame",
            f1.number(COLUMN, ROW) == 133,
        ),
    ]


def _two_shells() -> list[Claim]:
    f1, f2, early = run("paper/f1"), run("paper/f2"), run("paper/f2-early")
    family = torn("paper/f2")
    turning = [t for t, sheet in family.items() if rebound(x_of(sheet))]
    near = [t for t, sheet in family.items() if sheet.residual() < 0.1]
    late = run("paper/f2-second-fracture")
    second = int(late.ds["broken_step"].values.max())
    kink = np.abs(np.diff(x_of(late), 2))[second - 5 : second + 5].max()
    f2_last = int(f2.ds["broken_step"].values.max())
    searched, felt = _search()
    cusped = run("paper/f2-cusp")
    cusp, speed = int(cusped.ds["broken_step"].values.max()), np.diff(x_of(cusped))
    bend = speed[cusp + 20] / speed[cusp - 2]
    return [
        Claim(
            "also in this case second gradient mode attenuates the effects",
            f"The largest displacement of the piece at step 400 is {f2.residual():.2f} "
            f"({f1.residual():.2f} with one shell), and the depth of the concave surface is "
            f"{dent(f2):.2f} ({dent(f1):.2f} with one shell).",
            f2.residual() < f1.residual() and abs(dent(f2)) < dent(f1),
        ),
        Claim(
            "no rebound [of 133]",
            "In `paper/f2`, x decreases monotonically after the fracture. There is a rebound at a "
            f"threshold of {which(turning)}. The thresholds {which(list(family))} were tried.",
            rebound(x_of(f2)) is None,
        ),
        Claim(
            "the equilibrium configuration, after the fracture, is similar to the original",
            f"The largest displacement at step 400 of a piece 9 wide is {f2.residual():.2f} in "
            f"`paper/f2`, where frame points hold it, {early.residual():.3f} in `paper/f2-early` "
            f"(thresholds 5) and {cusped.residual():.3f} in `paper/f2-cusp`. It is below "
            f"0.1 at the thresholds {which(near)}. The thresholds {which(list(family))} were "
            "tried.",
            f2.residual() < 0.1,
            "`paper/f2-early` or `paper/f2-cusp`",
            max(early.residual(), cusped.residual()) < 0.1,
        ),
        Claim(
            "after about 100 step … a second fracture happening",
            f"The last bond of `paper/f2` breaks at step {f2_last}. With thresholds of 5.2 and "
            "6.0 (`paper/f2-second-fracture`) another bond, between the leaders and the frame, "
            f"breaks at step {second}. In `paper/f2-cusp` the last bond breaks at step {cusp}.",
            f2_last > 60,
            "`paper/f2-second-fracture` or `paper/f2-cusp`",
            80 <= second <= 130 and 80 <= cusp <= 130,
        ),
        Claim(
            "cuspidal point in X coordinate [of 133], after about 100 step",
            "There is no cusp in `paper/f2`. There is none in `paper/f2-second-fracture` either, "
            f"because the bond that breaks at step {second} does not belong to the piece: near "
            "this step the second time difference of the x coordinate of particle 133 is at most "
            f"{kink:.1g}. In `paper/f2-cusp` (thresholds 5.1) a bond between the piece and the "
            f"frame breaks at step {cusp}. Twenty steps later, the x coordinate decreases "
            f"{bend:.1f} times as fast as before. {searched} thresholds from 4.9 to 5.3 were "
            "tried. A bond of the piece breaks between steps 60 and 150 at the following ones: "
            f"{which(felt)}.",
            False,
            "`paper/f2-cusp`",
            80 <= cusp <= 130 and bend > 1.5,
        ),
    ]


def _search() -> tuple[int, list[float]]:
    """Return the number of tried thresholds, and those at which a bond of the piece breaks late."""
    tried, late = np.arange(4.9, 5.301, 0.01).round(2), []
    for threshold in tried:
        limits = f"fracture.thresholds=[{threshold}, {threshold}]"
        sheet = run("paper/f2", limits, "steps=200", "record.every=20")
        steps = sheet.ds["broken_step"].values
        ends = sheet.ds["bond_ends"].values[(steps >= 60) & (steps <= 150)] - 1
        piece = sheet.body & (sheet.site[:, 0] < sheet.columns - 1)
        if piece[ends].any():
            late.append(float(threshold))
    return len(tried), late
