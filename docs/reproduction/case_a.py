"""Case a: strain and release."""

import numpy as np
from claims import Claim, Section
from drawing import configurations, histories, numbered
from fits import both, both_text, fit_quality, parabolic
from runs import run

LEFT_OF_MIDDLE, ABOVE = 4, 5
"""Particle 67: column 5 and row 6 of the body, counted from 0 here."""
MIRROR = "frame={type: mirror}"


def section() -> Section:
    """All of case a."""
    a = run("paper/a")
    pictures = [
        (
            configurations(a, [1, 10, 20, 401], "a-pe1.png"),
            "Figure 5: case a, configurations and PE1 at times 1, 10, 20, 401",
        ),
        (
            configurations(run("paper/a-lag"), [1, 10, 20, 401], "a-lag-pe1.png"),
            "The same with paper/a-lag: the convexity",
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
    words = "Square lattice, barycentre, 0.35 a step for ten steps, then released: `paper/a`."
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
            f"the columns 1 to 8 layers from the leaders first move at steps {first}",
            first == list(range(1, 9)),
        ),
        Claim(
            "the x displacement of the points seems do not depend on the y coordinate",
            f"largest difference between rows at any step: {a.spread():.1g}",
            a.spread() < 1e-12,
        ),
        Claim(
            "a light convexity … close to the frame the displacements are lower",
            f"`paper/a`: rows differ by {a.spread():.1g}. `paper/a-lag`, step 9, the column left "
            f"of the leaders: {edge:.3f} at the edge, {middle:.3f} in the middle, largest "
            f"difference {lag.spread():.3f}. `paper/a-chebyshev`: {edge_8:.3f} and "
            f"{middle_8:.3f}, largest difference {eight.spread():.3f}",
            a.spread() > 1e-6,
            "`paper/a-lag` or `paper/a-chebyshev`",
            lower and edge_8 < middle_8,
        ),
        Claim(
            "those close to the frame follow with a little delay owing to the rule of the frame",
            "within a step the leaders move before the frame. With four neighbours no particle "
            f"sees that, and the edge row lags by {a.spread():.1g}; with the four diagonals it "
            f"does ({middle_8 - edge_8:.3f} at step 9), as with a frame one step late "
            f"({middle - edge:.3f})",
            a.spread() > 1e-6,
            "`paper/a-chebyshev` or `paper/a-lag`",
            middle_8 > edge_8 and middle > edge,
        ),
        Claim(
            "avoid this convexity using a different frame or mirroring the followers",
            f"mirror frame: rows differ by {mirrored.spread():.1g} with four neighbours, where "
            f"they differ by {a.spread():.1g} without it; by {mirrored_eight.spread():.3f} with "
            f"eight neighbours, where the mean frame gives {eight.spread():.3f}",
            mirrored_eight.spread() < 1e-6,
            "four neighbours (`paper/a` with `frame: {type: mirror}`), where there is nothing to "
            "avoid",
            mirrored.spread() < 1e-12,
        ),
        Claim(
            "at t=401 the lattice is not back completely … asymptotic process",
            f"largest displacement at step 400: {np.abs(a.u[400]).max():.3f} of "
            f"{np.abs(a.u).max():.2f}",
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
            f"step 9: PE1 {at_9[8]:.2f} in the column left of the leaders, {at_9[9]:.2f} on them, "
            f"{at_9[7]:.2f} one further left",
            int(at_9.argmax()) == 8,
        ),
        Claim(
            "this is also evident in Figure 6 where the PE2 is shown",
            f"PE2 is largest on the leaders: {moving[0, 9]:.3f} against {moving[0, 8]:.3f} left of "
            f"them at step 1, {moving[1, 9]:.3f} against {moving[1, 8]:.3f} at step 9",
            bool((moving[:, 8] > moving[:, 9]).all()),
        ),
        Claim(
            "PE1 [of 67] increases notably when points are pulled but decrease … when they become "
            "followers",
            f"the leaders are released after step 10; PE1 of 67 goes on rising to step {peak} and "
            f"is {fall[0] / pe1[10, LEFT_OF_MIDDLE, ABOVE]:.0f} times as large there as at step "
            f"10. It rises and falls once. In the column left of the leaders it peaks at step "
            f"{peaks[9]}",
            peak <= 11,
            "particles of the column left of the leaders",
            peaks[9] <= 11,
        ),
        Claim(
            "decrease in quite a parabolic-like way",
            f"{both_text(of_67, peak)}. In the end PE1 falls by a constant share a step, "
            f"{1 - tail[1] / tail[0]:.1%} at step 150, {1 - tail[-1] / tail[-2]:.1%} at the last",
            parabolic(both(of_67, peak, 400)),
            f"steps {peak} to 150 of the fall",
            parabolic(both(of_67, peak, 150)),
        ),
        Claim(
            "similarity with Hooke's law where the energy is proportional to the square",
            f"1.2 instead of 0.35 a step multiplies PE1 by {ratio:.4f}; (1.2/0.35)² is "
            f"{(1.2 / 0.35) ** 2:.4f}",
            abs(ratio / (1.2 / 0.35) ** 2 - 1) < 1e-9,
        ),
        Claim(
            "if we change point the shape of the curve remain the same but … more flared",
            f"one peak for each of the columns {list(peaks)}, at steps {list(peaks.values())}; "
            f"width at half height {list(widths.values())} steps",
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
            f"delay: first moves at step {start}. Its speed grows from {speed[0]:.4f} to "
            f"{speed.max():.4f} a step (at step {start + int(speed.argmax())}) and falls to 0 at "
            f"step {top}; a line fits the rise with R² = {rise:.3f}",
            rise > 0.99,
        ),
        Claim(
            "later decrease with parabolic like behaviour to the original position",
            f"{both_text(x, top)}. Over the whole fall they differ by "
            f"{abs(whole[1] - whole[0]):.0e}; {x[400]:.3f} is left of {x[top]:.3f} at step 400",
            parabolic(whole),
            f"steps {top} to 150 of the fall",
            parabolic(both(x, top, 150)),
        ),
        Claim(
            "no oscillation can be observed with this kind of rule",
            f"x of 67 turns {turns} time after it starts to move, and never crosses its rest "
            f"position; with `paper/a-memory` it crosses it {crossings} times to step 200",
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
            "the two contradict each other; the model is linear, so that they differ by a factor "
            f"only (`paper/a-text` less 1.2/0.35 times `paper/a`: {scaled:.1g})",
            False,
        ),
        Claim(
            "points are numbered from left to right and from bottom to up",
            f"67 is to be a central point above the central line. Row by row it would be column "
            f"{row_wise[0] + 1}, row {row_wise[1] + 1} of 10, below that line; column by column "
            f"it is column {column + 1}, row {row + 1}",
            row_wise[1] > 4,
            "the numbers running column by column",
            row == 5,
        ),
    ]
