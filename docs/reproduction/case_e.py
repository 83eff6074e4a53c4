"""Case e: four inner particles move apart, and Saint-Venant's principle."""

import numpy as np
from claims import Claim, Section
from drawing import configurations, histories
from runs import Sheet, run


def rim_share(sheet: Sheet, index: int) -> float:
    """Return the largest displacement of the rim over that of the leaders at a recorded time."""
    size = np.linalg.norm(sheet.u[index], axis=-1)
    rim = np.concatenate([size[0], size[-1], size[:, 0], size[:, -1]])
    return float(rim.max() / size.max())


def section() -> Section:
    """Return the section of case e."""
    e = run("paper/e")
    pictures = [
        (
            configurations(e, [1, 3, 9, 401], "e.png", over="nothing"),
            "Figure 17: case e, configurations at times 1, 3, 9 and 401; cells are inverted",
        ),
        (
            configurations(e, [9, 401], "e-pe1.png", over="rest"),
            "Figure 17: case e, PE1 at times 9 and 401, drawn on the undeformed sheet",
        ),
        (
            configurations(e, [9, 401], "e-pe2.png", "pe2", over="rest"),
            "Figure 17: case e, PE2 at times 9 and 401, drawn on the undeformed sheet",
        ),
        (
            histories(
                {"two off the leaders": (e, 7, 5), "the rim": (e, 9, 5)}, "e-history.png", 400
            ),
            "x, y and PE1 of two particles in the row of a leader",
        ),
    ]
    words = (
        "Four inner particles move apart along the diagonals by 0.35 per step along each axis for "
        "ten steps and then stop: `paper/e`. These values were chosen here."
    )
    return Section("Case e: Saint-Venant", words, _claims(), pictures)


def _folded(sheet: Sheet, step: int) -> int:
    """Return the number of cells of four particles with a negative area."""
    place = sheet.on_grid(sheet.position)[step]
    one, other = place[1:, 1:] - place[:-1, :-1], place[:-1, 1:] - place[1:, :-1]
    return int((one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0] < 0).sum())


def _claims() -> list[Claim]:
    e, large = run("paper/e"), run("paper/e-40")
    late = [rim_share(large, k) for k in (1, 2, 3)]
    pe1 = e.of("pe1")[8]
    inner = float(pe1[2:8, 2:8].sum() / pe1.sum())
    pe2 = e.of("pe2")[8]
    folded = _folded(e, 8)
    start = next(t for t in range(1, 400) if rim_share(e, t) > 0)
    return [
        Claim(
            "remote particles are not interested in what is going on close to the leaders [time 9]",
            f"At step 8, the displacement of the rim is {rim_share(e, 8):.1%} of that of the "
            f"leaders; the rim first moves at step {start}.",
            rim_share(e, 8) < 0.02,
        ),
        Claim(
            "PE1 and PE2 contour plot [time 9]",
            f"{inner:.1%} of the sum of PE1 belongs to the inner 6 × 6 particles. PE2 in the rim "
            f"is at most {max(pe2[0].max(), pe2[:, 0].max()) / pe2.max():.1%} of its largest "
            f"value. {folded} of 81 cells are inverted: with the chosen displacement the leaders "
            "pass their neighbours.",
            inner > 0.99,
        ),
        Claim(
            "the local action principle [is verified]",
            "The rim is displaced later than the leaders, but its displacement does not decay: it "
            f"is {rim_share(e, 100):.1%} of that of the leaders at step 100, and "
            f"{rim_share(e, 400):.1%} from step 400 on. In a sheet of 40 × 40, it is "
            f"{late[0]:.1g} at step 8, {late[1]:.1%} at step 400 and {late[2]:.1%} at step 4000. "
            "At four times the distance r the final displacement is thus "
            f"{rim_share(e, 400) / late[2]:.2f} times smaller: it decreases as 1/r.",
            rim_share(e, 400) < 0.02,
            "early times (a particle k layers away does not move before step k)",
            rim_share(e, start - 1) == 0.0,
        ),
    ]
