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
    """x displacement of 133."""
    return sheet.u[:, COLUMN, ROW, 0]


def torn(name: str) -> dict[float, Sheet]:
    """The case at every threshold at which all rows part."""
    shells = 1 if name == "paper/f1" else 2
    sheets = {float(t): run(name, f"fracture.thresholds={[float(t)] * shells}") for t in THRESHOLDS}
    return {t: sheet for t, sheet in sheets.items() if None not in parted(sheet)}


def dent(sheet: Sheet) -> float:
    """How far the outer rows of the torn surface stand out beyond its middle, at the end."""
    surface = sheet.u[-1, -2, :, 0]
    return float(min(surface[:2].mean(), surface[-2:].mean()) - surface[4:6].mean())


def section() -> Section:
    """All of case f."""
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
        "Hexagonal lattice, two layers of frame, thresholds 5.2, otherwise as d: `paper/f1`, "
        "`paper/f2`."
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
            f"largest displacement of the piece at step 400: {f1.residual():.2f}, square "
            f"{d1.residual():.3f}; rows part at steps {steps_text(parted(f1))}, square "
            f"{steps_text(parted(d1))}",
            f1.residual() > 10 * d1.residual(),
        ),
        Claim(
            "two points of the frame remain in the middle",
            f"{in_the_gap(f1)} in the gap at step 400; {gaps} at the thresholds "
            f"{which(list(family))}, at which the sheet parts",
            in_the_gap(f1) == 2,
        ),
        Claim(
            "they are stressed from two opposite sides … the average of the displacements",
            f"{in_the_gap(f1)} with the mean, {in_the_gap(run('paper/f1', 'frame.type=first'))} "
            "with one follower each",
            in_the_gap(f1) == 2 and in_the_gap(run("paper/f1", "frame.type=first")) == 0,
        ),
        Claim(
            "a different equilibrium configuration is reached",
            f"at step 400 the piece is off its reference by up to {f1.residual():.2f}; still "
            f"moving by {f1.of('pe2')[400].max():.1g} a step",
            f1.residual() > 0.5,
        ),
        Claim(
            "this results in a concave final surface",
            f"the outer rows of the torn surface stand {dent(f1):.2f} beyond its middle; by more "
            f"than 0.3 at the thresholds {which(dented)} of {which(list(family))}",
            dent(f1) > 0.3,
        ),
        Claim(
            "a rebound mechanism [of 133] can be outlined",
            f"x of 133 falls to {back[1]:.3f} at step {back[0]} and rises to {back[2]:.3f}; "
            f"thresholds with a rebound: {which(turning)} of {which(list(family))}",
            back[0] > 10,
        ),
        Claim(
            "in the square lattice this [rebound] behaviour does not exist",
            "the paper itself shows one in figure 16. Here: none in `paper/d1` and `paper/d2`, but "
            f"one in `paper/d2-frame-bonds`, from {back_square[1]:.3f} to {back_square[2]:.3f}",
            not any(square.values()),
            "`paper/d1` and `paper/d2`, without `paper/d2-frame-bonds`",
            not (square["d1"] or square["d2"]),
        ),
        Claim(
            "j=133 [a central point]",
            f"with two layers of frame 133 is column {COLUMN + 1}, row {ROW + 1} of the body; with "
            "one layer, all that one shell needs, the number of that particle is "
            f"{layer.number(COLUMN, ROW)}",
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
            f"largest displacement of the piece at step 400: {f2.residual():.2f}, one shell "
            f"{f1.residual():.2f}; dent of the surface {dent(f2):.2f}, one shell {dent(f1):.2f}",
            f2.residual() < f1.residual() and abs(dent(f2)) < dent(f1),
        ),
        Claim(
            "no rebound [of 133]",
            "x falls for good after the fracture; thresholds with a rebound: "
            f"{which(turning)} of {which(list(family))}",
            rebound(x_of(f2)) is None,
        ),
        Claim(
            "the equilibrium configuration, after the fracture, is similar to the original",
            f"`paper/f2`: {f2.residual():.2f} off at step 400, on a piece 9 wide, and frame points "
            f"hold it there; `paper/f2-early`, thresholds 5: {early.residual():.3f}; "
            f"`paper/f2-cusp`: {cusped.residual():.3f}. Less than 0.1 "
            f"at thresholds {which(near)} of {which(list(family))}",
            f2.residual() < 0.1,
            "`paper/f2-early` or `paper/f2-cusp`",
            max(early.residual(), cusped.residual()) < 0.1,
        ),
        Claim(
            "after about 100 step … a second fracture happening",
            f"the last bond of `paper/f2` breaks at step {f2_last}. With thresholds 5.2 and 6.0, "
            f"`paper/f2-second-fracture`, one more bond breaks at step {second}, between the "
            f"leaders and the frame; in `paper/f2-cusp` the last breaks at step {cusp}",
            f2_last > 60,
            "`paper/f2-second-fracture` or `paper/f2-cusp`",
            80 <= second <= 130 and 80 <= cusp <= 130,
        ),
        Claim(
            "cuspidal point in X coordinate [of 133], after about 100 step",
            f"`paper/f2`: none. `paper/f2-second-fracture`: none either, the second difference of "
            f"x is at most {kink:.1g} about step {second}: the broken bond is not of the piece. "
            f"`paper/f2-cusp` (thresholds 5.1): a bond of the piece to the frame breaks at step "
            f"{cusp}, and x of 133 falls {bend:.1f} times as fast twenty steps later as before. Of "
            f"{searched} thresholds from 4.9 to 5.3 a bond of the piece breaks between steps 60 "
            f"and 150 at {which(felt)}",
            False,
            "`paper/f2-cusp`",
            80 <= cusp <= 130 and bend > 1.5,
        ),
    ]


def _search() -> tuple[int, list[float]]:
    """How many thresholds were tried, and those at which a bond of the piece breaks late."""
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
