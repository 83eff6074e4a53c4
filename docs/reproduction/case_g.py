"""Case g: the rule of the frame."""

import numpy as np
from case_f import COLUMN, ROW, dent, x_of
from claims import Claim, Section
from drawing import configurations, histories
from runs import in_the_gap, run


def section() -> Section:
    """Return the section of case g."""
    g = run("paper/g")
    names = {"mean (paper/f2)": "paper/f2", "first (paper/g)": "paper/g"}
    series = {k: (run(v), COLUMN, ROW) for k, v in names.items()}
    series["square (paper/d2, 103)"] = (run("paper/d2"), 7, 5)
    pictures = [
        (
            configurations(g, [1, 8, 9, 100], "g-pe1.png"),
            "Figure 22: case g, configurations and PE1 at times 1, 8, 9, 100",
        ),
        (
            histories(series, "g-133.png", 400, log=True),
            "x, y and PE1 of particle 133 in paper/f2 and paper/g, and of particle 103 in paper/d2",
        ),
    ]
    words = (
        "As case f with two shells, but each frame point follows one particle of the body: "
        "`paper/g`."
    )
    return Section("Case g: the rule of the frame", words, _claims_g(), pictures)


def _claims_g() -> list[Claim]:
    f2, g, d2 = run("paper/f2"), run("paper/g"), run("paper/d2")
    far = [float(np.abs(x_of(s)[20:] - d2.u[20:, 7, 5, 0]).mean()) for s in (f2, g)]
    dents = [dent(s) for s in (f2, g, d2)]
    bow = {n: s.u[99, 8, :, 0] for n, s in (("f2", f2), ("g", g), ("d2", d2))}
    bent = {n: float(np.ptp(v)) for n, v in bow.items()}
    return [
        Claim(
            "there are no more points of the frame in the middle",
            f"The number of points in the gap at step 400 is {in_the_gap(g)}; with the `mean` "
            f"frame it is {in_the_gap(f2)}.",
            in_the_gap(g) == 0 and in_the_gap(f2) > 0,
        ),
        Claim(
            "the behaviour is … more similar to the square lattice",
            "The mean difference between x of particle 133 and x of particle 103 in `paper/d2` "
            f"over steps 20 to 400 is {far[1]:.3f}; with the `mean` frame it is {far[0]:.3f}.",
            far[1] < far[0],
        ),
        Claim(
            "also the convexity of the surface fracture is changed … similar to the square lattice",
            "At step 99 the x coordinates of the torn surface span "
            f"{bent['f2']:.2f} with the `mean` frame, {bent['g']:.3f} in this case and "
            f"{bent['d2']:.3f} on the square lattice. The depth of the concave surface in "
            f"these three cases is {dents[0]:.2f}, {dents[1]:.1g} and {dents[2]:.1g} at step 400.",
            bent["g"] < bent["f2"] / 2,
        ),
        Claim(
            "the final configuration can return close to the initial",
            f"The largest displacement of the piece at step 400 is {g.residual():.1g} in "
            f"`paper/g`; in `paper/f2`, which has the `mean` frame, it is {f2.residual():.2f}.",
            g.residual() < 0.01,
        ),
    ]
