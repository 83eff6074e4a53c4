"""Cases b and c: the Poisson effect by mixed coordinates, with one and two shells."""

import numpy as np
from claims import Claim, Section
from drawing import configurations, histories
from runs import Floats, Sheet, run

COLUMN, ROW = 4, 5
TIMES = [1, 10, 20, 100]
SEEN = 0.05
"""Smallest relative difference that is visible in a figure."""


def narrowing(sheet: Sheet) -> Floats:
    """Return the contraction between the outer rows, (time, column)."""
    return sheet.u[:, :, 0, 1] - sheet.u[:, :, -1, 1]


def edge_excess(column: Floats) -> float:
    """Return the relative excess of PE1 of a column in its outer rows over its middle rows."""
    return float(column[[0, -1]].mean() / column[4:6].mean() - 1)


def half_time(sheet: Sheet) -> int:
    """Return the first step with half the contraction of particle 67 at step 100."""
    y = sheet.u[:, COLUMN, ROW, 1]
    return int(np.flatnonzero(y <= y[100] / 2)[0])


def section_b() -> Section:
    """Return the section of case b."""
    b = run("paper/b")
    pictures = [
        (
            configurations(b, TIMES, "b-pe1.png"),
            "Figure 10: case b, configurations and PE1 at times 1, 10, 20, 100",
        ),
        (
            histories(
                {
                    "K = −0.004 (paper/b)": (b, COLUMN, ROW),
                    "K = −0.008": (run("paper/b", "rule.K=-0.008"), COLUMN, ROW),
                },
                "b-67.png",
                100,
            ),
            "Figure 11: x, y and PE1 of particle 67",
        ),
    ]
    words = (
        "As case a, without the release, with the rule of mixed coordinates: `paper/b`. The paper "
        "does not give K; −0.004 was chosen here."
    )
    return Section("Case b: the Poisson effect", words, _claims_b(), pictures)


def _claims_b() -> list[Claim]:
    b = run("paper/b")
    narrow, y = narrowing(b)[99], b.u[:, COLUMN, ROW, 1]
    wider = narrowing(run("paper/b", "rule.K=0.004"))[99]
    slow = run("paper/b", "solver.relaxation=0.5", "steps=200")
    strong = run("paper/b", "rule.K=-0.008")
    pe1 = b.of("pe1")
    near, middle = ({s: edge_excess(pe1[s, c]) for s in (9, 19, 99)} for c in (8, 4))
    in_a = edge_excess(run("paper/a").of("pe1")[9, 8])
    return [
        Claim(
            "lateral contraction can be seen",
            "At rest the distance between the outer rows is 9. At step 99 it is smaller by "
            f"{narrow.max():.3f} at column {int(narrow.argmax()) + 1}; with K = +0.004 it is "
            f"larger by {-wider.min():.3f}.",
            bool(narrow.max() > 0.01),
        ),
        Claim(
            "there is a relaxation time, because the followers need time",
            f"At step {half_time(b)} the displacement −u_y of particle 67 reaches half of its "
            f"value at step 100. This is {half_time(b) - 10} steps after the leaders have stopped.",
            half_time(b) > 11,
        ),
        Claim(
            "[the relaxation time] is due to the rules expression and can be tuned",
            "K does not change the relaxation time: half of the contraction is reached at step "
            f"{half_time(strong)} with K = −0.008 and at step {half_time(b)} with −0.004. A "
            "relaxation of 0.5 changes it: half of the contraction is reached at step "
            f"{half_time(slow)}.",
            half_time(strong) != half_time(b),
            "`solver.relaxation`, which the paper does not have",
            half_time(slow) > half_time(b),
        ),
        Claim(
            "PE1 … here is more evident the edge effect leading to concavity toward left",
            "In the column left of the leaders, PE1 is larger at the edge than in the middle rows, "
            f"by {near[9]:.2%}, {near[19]:.2%} and {near[99]:.1%} at times 10, 20 and 100 "
            f"({in_a:.2%} in case a at time 10). Its contours are therefore concave toward the "
            "left, which is visible at time 100. In the middle of the sheet the difference at this "
            f"time is {middle[99]:.1%}, and the contours are concave toward the right.",
            near[99] > 0.02 and near[99] > in_a,
        ),
        Claim(
            "the point is above the central line so their y coordinate decrease",
            f"u_y of particle 67 decreases to {y[100]:.4f} at step 100 and never increases.",
            bool(y[100] < 0 and (np.diff(y) <= 1e-15).all()),
        ),
    ]


def section_c() -> Section:
    """Return the section of case c."""
    names = {"1 shell (paper/b)": "paper/b", "2 shells (paper/c)": "paper/c"}
    names["24 neighbours (paper/c-chebyshev)"] = "paper/c-chebyshev"
    pictures = [
        (
            configurations(run("paper/c"), TIMES, "c-pe1.png"),
            "Figure 12: case c, configurations and PE1 at times 1, 10, 20, 100",
        ),
        (
            histories({k: (run(v), COLUMN, ROW) for k, v in names.items()}, "c-67.png", 100),
            "Figures 11 and 13: x, y and PE1 of particle 67",
        ),
    ]
    words = "As case b, with the second shell of neighbours: `paper/c`."
    return Section("Case c: the importance of the gradient", words, _claims_c(), pictures)


def _less(name: str) -> tuple[Floats, list[int]]:
    """Return the contraction of particle 67 at steps 9, 19, 99, and the steps at which that of b is
    less."""
    y, first = -run(name).u[:, COLUMN, ROW, 1], -run("paper/b").u[:, COLUMN, ROW, 1]
    return y[[9, 19, 99]], [int(s) for s in np.flatnonzero(y > first + 1e-15)]


def _listed(values: Floats) -> str:
    return ", ".join(f"{v:.4f}" for v in values)


def _claims_c() -> list[Claim]:
    b, c, wide = run("paper/b"), run("paper/c"), run("paper/c-chebyshev")
    first, _ = _less("paper/b")
    second, above = _less("paper/c")
    third, above_24 = _less("paper/c-chebyshev")
    narrow = [narrowing(sheet)[99].max() for sheet in (b, c, wide)]
    less = [float(1 - narrowing(c)[s].max() / narrowing(b)[s].max()) for s in (9, 19, 99)]
    bow = [s.of("pe1")[9, 8, 0] / s.of("pe1")[9, 8, 5] - 1 for s in (b, c)]
    return [
        Claim(
            "lateral contraction can be seen in a less pronounced way",
            f"The largest contraction at step 99 is {narrow[0]:.3f} in b and {narrow[1]:.3f} in c "
            f"({narrow[2]:.3f} with 24 neighbours). It is smaller in c than in b by "
            f"{less[0]:.1%}, {less[1]:.1%} and {less[2]:.1%} at the paper's times 10, 20 and 100. "
            f"The claim counts as reproduced if these differences exceed {SEEN:.0%}, the smallest "
            "difference that is visible in a figure.",
            min(less) > SEEN,
            "late times (100)",
            less[2] > SEEN,
        ),
        Claim(
            "a lower lateral contraction [of 67], with respect the first gradient case",
            "The contraction is measured by −u_y of particle 67 at steps 9, 19 and 99. It is "
            f"{_listed(first)} in b, and {_listed(second)} in c. It is larger in c than in b at "
            f"steps {above[0]} to {above[-1]}, and smaller afterwards. With 24 neighbours, the "
            f"contraction is {_listed(third)} at steps 9, 19 and 99; at steps {above_24[0]} to "
            f"{above_24[-1]} it is larger than in b.",
            not above,
            f"steps after {above[-1]}",
            bool(second[2] < first[2]),
        ),
        Claim(
            "with a larger number of neighbours the effect is amortized",
            f"−u_y of particle 67 at step 99 is {first[2]:.4f} with 4 neighbours, "
            f"{second[2]:.4f} with 8 and {third[2]:.4f} with 24.",
            bool(first[2] > second[2] > third[2]),
        ),
        Claim(
            "the PE1 plot enhances the convexity of the first line of follower",
            "At step 9, PE1 in the column left of the leaders is larger at the edge than in the "
            f"middle, by {bow[0]:.2%} in b and by {bow[1]:.2%} in c.",
            bool(bow[1] > 2 * bow[0] > 0),
        ),
        Claim(
            "its evolution with time is quite different",
            f"Half of the contraction at step 100 is reached at step {half_time(c)} in c, "
            f"at step {half_time(b)} in b and at step {half_time(wide)} with 24 neighbours. From "
            "step 50 to 100 the contraction increases by "
            f"{c.u[100, 4, 5, 1] / c.u[50, 4, 5, 1] - 1:.0%} in c and by "
            f"{b.u[100, 4, 5, 1] / b.u[50, 4, 5, 1] - 1:.0%} in b.",
            half_time(c) < 0.9 * half_time(b),
        ),
    ]
