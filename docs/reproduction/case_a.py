"""Case a: strain and release."""

import numpy as np
from claims import Claim, Section
from drawing import configurations, histories, numbered
from fits import both, both_text, fit_quality, parabolic
from one_threshold import which
from runs import run

LEFT_OF_MIDDLE, ABOVE = 4, 5
"""Particle 67: column 5 and row 6 of the body, counted from 0 here."""
MIRROR = "frame={type: mirror}"


def section() -> Section:
    """Return the section of case a."""
    a = run("paper/a")
    pictures = [
        (
            configurations(a, [1, 10, 20, 401], "a-pe1.png"),
            "Figure 5: case a, configurations and PE1 at times 1, 10, 20, 401",
        ),
        (
            configurations(run("paper/a-lag"), [1, 10, 20, 401], "a-lag-pe1.png"),
            "Case a with the delayed frame of paper/a-lag: rows close to the frame are displaced "
            "less, as in the paper's figure",
        ),
        (
            configurations(a, [2, 10], "a-pe2.png", "pe2"),
            "Figure 6: case a, PE2 at times 2 and 10",
        ),
        (numbered(a, "a-numbers.png"), "Figure 7: the numbered lattice, 67 in bold"),
        (
            histories(
                {
                    label: (run(name), LEFT_OF_MIDDLE, ABOVE)
                    for label, name in (("paper/a", "paper/a"), ("paper/a-lag", "paper/a-lag"))
                },
                "a-67.png",
                400,
            ),
            "Figures 8 and 9: x, y and PE1 of particle 67",
        ),
    ]
    words = (
        "The right edge of a square lattice with the barycentre rule moves by 0.35 per step for "
        "ten steps and is then released: `paper/a`."
    )
    return Section("Case a: simple strain and release", words, _claims(), pictures)


def _claims() -> list[Claim]:
    return [*_fields(), *_energy(), *_history(), *_setting()]


def _fields() -> list[Claim]:
    a, lag, eight = run("paper/a"), run("paper/a-lag"), run("paper/a-chebyshev")
    mirrored = run("paper/a", MIRROR)
    mirrored_eight = run("paper/a-chebyshev", MIRROR)
    first = [int(np.flatnonzero(a.u[:, 9 - k, ABOVE, 0])[0]) for k in range(1, 9)]
    edge, middle = lag.u[9, 8, [0, 5], 0]
    edge_8, middle_8 = eight.u[9, 8, [0, 5], 0]
    lower = edge < middle and lag.spread() > 1e-6
    return [
        Claim(
            "leaders motion implies a displacement of the first layer that propagates",
            "The columns at distances of 1 to 8 layers from the leaders first move at steps "
            f"{which(first)}, in this order.",
            first == list(range(1, 9)),
        ),
        Claim(
            "the x displacement of the points seems do not depend on the y coordinate",
            f"The largest difference between rows at any step is {a.spread():.1g}.",
            a.spread() < 1e-12,
        ),
        Claim(
            "a light convexity … close to the frame the displacements are lower",
            "In `paper/a` the displacements of all rows are equal (difference "
            f"{a.spread():.1g}). For the other two cases the displacement in the column left of "
            f"the leaders was compared at step 9. In `paper/a-lag` it is {edge:.3f} at the edge "
            f"and {middle:.3f} in the middle; the largest difference at any step is "
            f"{lag.spread():.3f}. In `paper/a-chebyshev` it is {edge_8:.3f} at the edge and "
            f"{middle_8:.3f} in the middle; the largest difference is {eight.spread():.3f}.",
            a.spread() > 1e-6,
            "`paper/a-lag` or `paper/a-chebyshev`",
            lower and edge_8 < middle_8,
        ),
        Claim(
            "those close to the frame follow with a little delay owing to the rule of the frame",
            "Within a step the leaders move before the frame. With four neighbours, this order has "
            "no effect, and the displacements of the middle and the edge differ by "
            f"{a.spread():.1g}. At step 9, they differ by {middle_8 - edge_8:.3f} with eight "
            f"neighbours and by {middle - edge:.3f} with a frame delayed by one step.",
            a.spread() > 1e-6,
            "`paper/a-chebyshev` or `paper/a-lag`",
            middle_8 > edge_8 and middle > edge,
        ),
        Claim(
            "avoid this convexity using a different frame or mirroring the followers",
            "With a mirror frame, the displacements of the rows differ by "
            f"{mirrored.spread():.1g} for four neighbours "
            f"({a.spread():.1g} with the mean frame) and by {mirrored_eight.spread():.3f} for "
            f"eight neighbours ({eight.spread():.3f} with the mean frame).",
            mirrored_eight.spread() < 1e-6,
            "four neighbours (`paper/a` with `frame: {type: mirror}`); with four neighbours the "
            "mean frame does not cause a convexity either",
            mirrored.spread() < 1e-12,
        ),
        Claim(
            "at t=401 the lattice is not back completely … asymptotic process",
            f"The largest displacement at step 400 is {np.abs(a.u[400]).max():.3f}; the largest "
            f"at any step is {np.abs(a.u).max():.2f}.",
            bool(np.abs(a.u[400]).max() > 0.01),
        ),
    ]


def _energy() -> list[Claim]:
    a, text = run("paper/a"), run("paper/a-text")
    pe1, pe2 = a.of("pe1"), a.of("pe2")
    at_9 = pe1[9].mean(axis=1)
    peak = int(pe1[:, LEFT_OF_MIDDLE, ABOVE].argmax())
    fall = pe1[peak:, LEFT_OF_MIDDLE, ABOVE]
    of_67 = pe1[:, LEFT_OF_MIDDLE, ABOVE]
    tail = of_67[150:]
    ratio = text.of("pe1")[9, 8, 5] / pe1[9, 8, 5]
    peaks = {c + 1: int(pe1[:, c, ABOVE].argmax()) for c in (2, 4, 6, 8)}
    widths = {c: int((pe1[:, c - 1, ABOVE] > pe1[:, c - 1, ABOVE].max() / 2).sum()) for c in peaks}
    moving = pe2[[1, 9]].mean(axis=2)
    return [
        Claim(
            "the maximum value of PE1 is not on the leader line but just on its left",
            f"At step 9, PE1 is {at_9[8]:.2f} in the column left of the leaders, {at_9[9]:.2f} at "
            f"the leaders, and {at_9[7]:.2f} one column farther left.",
            int(at_9.argmax()) == 8,
        ),
        Claim(
            "this is also evident in Figure 6 where the PE2 is shown",
            f"PE2 is largest at the leaders. At step 1 it is {moving[0, 9]:.3f} there and "
            f"{moving[0, 8]:.3f} in the column left of them, and at step 9 it is "
            f"{moving[1, 9]:.3f} and {moving[1, 8]:.3f}.",
            bool((moving[:, 8] > moving[:, 9]).all()),
        ),
        Claim(
            "PE1 [of 67] increases notably when points are pulled but decrease … when they become "
            "followers",
            "The leaders are released after step 10. PE1 of particle 67 continues to increase "
            f"until step {peak}, to {fall[0] / pe1[10, LEFT_OF_MIDDLE, ABOVE]:.0f} times its value "
            "at step "
            "10, and decreases afterwards. In the column left of the leaders, however, PE1 is "
            f"largest at step {peaks[9]}.",
            peak <= 11,
            "particles of the column left of the leaders",
            peaks[9] <= 11,
        ),
        Claim(
            "decrease in quite a parabolic-like way",
            f"{both_text(of_67, peak)}. At the end, PE1 decreases like an exponential: by a "
            f"constant fraction per step, which is {1 - tail[1] / tail[0]:.1%} at step 150 and "
            f"{1 - tail[-1] / tail[-2]:.1%} at the last step.",
            parabolic(both(of_67, peak, 400)),
            f"steps {peak} to 150 of the decrease",
            parabolic(both(of_67, peak, 150)),
        ),
        Claim(
            "similarity with Hooke's law where the energy is proportional to the square",
            f"A speed of 1.2 instead of 0.35 per step multiplies PE1 by {ratio:.4f}; (1.2/0.35)² "
            f"is {(1.2 / 0.35) ** 2:.4f}.",
            abs(ratio / (1.2 / 0.35) ** 2 - 1) < 1e-9,
        ),
        Claim(
            "if we change point the shape of the curve remain the same but … more flared",
            f"PE1 of columns {which(list(peaks))} has one maximum each, at steps "
            f"{which(list(peaks.values()))}. The widths of the curves at half of their height are "
            f"{which(list(widths.values()))} steps.",
            list(widths.values()) == sorted(widths.values(), reverse=True),
        ),
    ]


def _history() -> list[Claim]:
    a = run("paper/a")
    x = a.u[:, LEFT_OF_MIDDLE, ABOVE, 0]
    start, top = int(np.flatnonzero(x)[0]), int(x.argmax())
    speed = np.diff(x)[start - 1 : top]
    rise = fit_quality(x[start : top + 1], 1)
    turns = int((np.diff(np.sign(np.diff(x[start:]))) != 0).sum())
    swing = run("paper/a-memory").u[:, LEFT_OF_MIDDLE, ABOVE, 0]
    crossings = int((np.diff(np.sign(swing[20:200])) != 0).sum())
    whole = both(x, top, 400)
    return [
        Claim(
            "x increases linearly (velocity is constant), after a delay",
            f"The particle first moves at step {start}, so that there is a delay. Its speed "
            f"increases from {speed[0]:.4f} to {speed.max():.4f} per step (at step "
            f"{start + int(speed.argmax())}) and decreases to 0 at step {top}; a line fits the "
            f"rise with R² = {rise:.3f}.",
            rise > 0.99,
        ),
        Claim(
            "later decrease with parabolic like behaviour to the original position",
            f"{both_text(x, top)}. Over the whole decrease the two values of R² "
            f"differ by {abs(whole[1] - whole[0]):.0e}. At step 400, the displacement is "
            f"{x[400]:.3f}; its "
            f"maximum was {x[top]:.3f}.",
            parabolic(whole),
            f"steps {top} to 150 of the decrease",
            parabolic(both(x, top, 150)),
        ),
        Claim(
            "no oscillation can be observed with this kind of rule",
            f"The direction of the motion of particle 67 along x changes {turns} time, and the "
            "particle never crosses its rest position; in `paper/a-memory` it crosses this "
            f"position {crossings} times by step 200.",
            turns == 1 and bool((x >= 0).all()),
        ),
    ]


def _setting() -> list[Claim]:
    a, text = run("paper/a"), run("paper/a-text")
    scaled = float(np.abs(text.u - a.u * (1.2 / 0.35)).max())
    column, row = a.site[66]
    row_wise = (66 % 12 - 1, 66 // 12 - 1)
    return [
        Claim(
            "speed 1,2 unit/step [the text] … 0.35 unit/step [table 1]",
            "Text and table contradict each other. Because the model is linear, the results "
            "differ only by a factor: `paper/a-text` minus 1.2/0.35 times `paper/a` is "
            f"{scaled:.1g}.",
            False,
        ),
        Claim(
            "points are numbered from left to right and from bottom to up",
            "According to the paper, particle 67 is a central point above the central line. If "
            f"particles are numbered row by row, it is in column {row_wise[0] + 1}, row "
            f"{row_wise[1] + 1} of 10, below that line. If they are numbered column by column, it "
            f"is in column {column + 1}, row {row + 1}.",
            row_wise[1] > 4,
            "numbers that increase column by column",
            row == 5,
        ),
    ]
