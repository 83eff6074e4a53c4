"""Case d: fracture of the square lattice, with one and two shells."""

from claims import Claim, Section
from drawing import configurations, histories
from one_threshold import TRIED, fitting, span, times, which
from runs import Sheet, edges_first, parted, rebound, run, steps_text
from torn_square import (
    COLUMN,
    FAMILIES,
    LASTING,
    ROW,
    THRESHOLDS,
    UNBREAKABLE,
    both,
    kinds,
    swept,
    x_of,
)


def section() -> Section:
    """Return the section of case d."""
    names = ("paper/d1", "paper/d2", "paper/d2-frame-bonds", "paper/d2-chebyshev")
    pictures = [
        (
            configurations(run("paper/d1"), [1, 5, 6, 7, 100], "d1-pe1.png"),
            "Figure 14: paper/d1: all rows separate at time 7",
        ),
        (
            configurations(run("paper/d2"), [1, 5, 6, 7, 8, 100], "d2-pe1.png"),
            "Figure 15: paper/d2: the outermost rows separate at time 7, the others at 8",
        ),
        (
            histories({n: (run(n), COLUMN, ROW) for n in names}, "d-103.png", 150, log=True),
            "Figure 16: x, y and PE1 of particle 103 (134 with Chebyshev neighbours)",
        ),
    ]
    assert (times("d1"), times("d2")) == ((7, 7), (7, 8))
    words = (
        "The right edge moves by 1.2 per step for ten steps and is then held; the thresholds are "
        "5.2, as in cases f and g. These values were chosen here. `paper/d1` has one shell of "
        "neighbours, `paper/d2` two. A row *separates* in the step in which the last bond between "
        "its leader and the adjacent column breaks. *Edges first* means that both outermost rows "
        "separate before all other rows."
    )
    claims = [*_line(), *_rebound(), *_energy()]
    return Section("Case d: simple fracture", words, claims, pictures, both())


def _line() -> list[Claim]:
    one, two, lag = run("paper/d1"), run("paper/d2"), run("paper/d1-lag")
    sheets_of = {label: swept(label) for label in FAMILIES if "unbreakable" not in label}
    first = {
        label: [t for t, sheet in sheets.items() if edges_first(parted(sheet))]
        for label, sheets in sheets_of.items()
    }
    share = {n: f"{len(first[n])} of {len(sheets_of[n])} thresholds" for n in sheets_of}
    found = "; ".join(
        f"{label}: {len(first[label])} of {len(sheets_of[label])}"
        + (f" ({', '.join(f'{t:g}' for t in first[label])})" if first[label] else "")
        for label in sheets_of
    )
    rows = {label: steps_text(parted(s)) for label, s in (("1", one), ("2", two), ("lag", lag))}
    (fast, at), (slow, _) = _longest(1.2), _longest(0.35)
    late = _first_break_at_ten()
    return [
        Claim(
            "choosing a distance fracture of about 10 units",
            "The lengths of bonds are tested after leaders have moved and before followers move. "
            f"If the leaders move by 1.2 per step, the largest length then occurs in step {at} "
            f"and is {fast:.2f}; if they move by 0.35 per step, the largest length is {slow:.2f}. "
            "Therefore no bond breaks at a threshold of 10; the sheet separates at thresholds up "
            f"to {fast:.2f}. For a bond to break "
            f"at a threshold of 10, the leaders would have to move until step {late}.",
            max(fast, slow) > 10,
            "leaders that move by 1.2 per step for twenty steps instead of ten",
            late <= 20,
        ),
        Claim(
            "the vertical fracture line is different in first or second gradient",
            f"From bottom to top the rows separate at steps {rows['1']} with one shell and "
            f"{rows['2']} with two.",
            rows["1"] != rows["2"],
        ),
        Claim(
            "points close to the frame are detached before the others [first gradient]",
            f"The rows separate at steps {rows['1']} in `paper/d1` and {rows['lag']} in "
            f"`paper/d1-lag`. Thresholds from {THRESHOLDS[0]:g} to {THRESHOLDS[-1]:g} were tried. "
            "Only those at which all rows separate are counted. The number of thresholds at which "
            f"the edges separate first is: {found}.",
            len(first["one shell"]) == len(sheets_of["one shell"]),
            f"`paper/d1-lag`, at {share['one shell and lag 1']}",
            edges_first(parted(lag)),
        ),
        Claim(
            "points close to the frame are detached before the others [second gradient]",
            f"The rows of `paper/d2` separate at steps {rows['2']}. The edges separate first at "
            f"{share['two shells']} with two shells and at {share['24 neighbours']} with 24 "
            "neighbours.",
            len(first["two shells"]) == len(sheets_of["two shells"]),
            f"`paper/d2`, at {share['two shells']}",
            edges_first(parted(two)),
        ),
        Claim(
            "this effect is more marked in second gradient case",
            f"At the same threshold the edges separate {_lead(one)} steps before the last row in "
            f"`paper/d1` and {_lead(two)} step before it in `paper/d2`. The edges separate first "
            "at "
            f"{share['one shell']} with one shell, at {share['two shells']} with two, and at "
            f"{share['one shell and lag 1']} with one shell and a delayed frame.",
            len(first["one shell"]) < len(first["two shells"]) == len(sheets_of["two shells"]),
            f"`paper/d2`, at {share['two shells']}",
            _lead(two) > _lead(one),
        ),
        Claim(
            "time (1, 5, 6, 7 and 100) … (1, 5, 6, 7, 8 and 100) [when it tears]",
            f"The rows separate at time {span('d1')} in `paper/d1` and {span('d2')} in "
            f"`paper/d2`. Thresholds from {TRIED[0]:g} to {TRIED[-1]:g} were tried in steps of "
            "0.1. A threshold agrees with the figures if the last row separates after time 5 in "
            "both cases, not later than time 7 in `paper/d1`, and not later than time 8 in "
            f"`paper/d2`. The thresholds {which(fitting('d1', 'd2'))} agree. At a threshold of 6 "
            f"the rows separate at time {_times('d1', 6.0)} in `paper/d1` and {_times('d2', 6.0)} "
            "in `paper/d2`.",
            5.2 in fitting("d1", "d2"),
        ),
    ]


def _steps(sheet: Sheet) -> list[int]:
    return [step for step in parted(sheet) if step is not None]


def _times(case: str, threshold: float) -> str:
    return " to ".join(str(time) for time in sorted(set(times(case, threshold) or ())))


def _lead(sheet: Sheet) -> int:
    """Return the number of steps by which the edge rows separate before the last row."""
    rows = _steps(sheet)
    return max(rows) - max(rows[0], rows[-1])


def _longest(speed: float) -> tuple[float, int]:
    """Return the longest bond of d1, where none breaks, and its step."""
    pull = f"leaders.1.motion.velocity=[{speed}, 0.0]"
    return run("paper/d1", "fracture.thresholds=[1000.0]", pull, "steps=20").longest_bond()


def _first_break_at_ten() -> int:
    on = run("paper/d1", "fracture.thresholds=[10.0]", "leaders.1.motion.steps=20", "steps=20")
    broken = on.ds["broken_step"].values
    return int(broken[broken > 0].min()) if (broken > 0).any() else 999


def _rebound() -> list[Claim]:
    one, two = run("paper/d1"), run("paper/d2")
    tied, wide = run("paper/d2-frame-bonds"), run("paper/d2-chebyshev")
    back, dip = rebound(x_of(tied)), rebound(x_of(wide))
    assert back is not None
    assert dip is not None
    families = {n: swept(n) for n in FAMILIES if "24" in n or n.startswith("two")}
    tied_one = rebound(x_of(run("paper/d1", UNBREAKABLE)))
    found = "; ".join(f"{label}: {kinds(sheets)}" for label, sheets in families.items())
    kept = tied.residual()
    return [
        Claim(
            "x of 103: after the fracture a sort of rebound [second gradient]",
            "In `paper/d2`, x decreases monotonically after its maximum at step "
            f"{int(x_of(two).argmax())}. In `paper/d2-frame-bonds` it decreases to {back[1]:.3f} "
            f"at step {back[0]} and then increases permanently to {back[2]:.3f}. In "
            f"`paper/d2-chebyshev`, where the particle has the number {wide.number(COLUMN, ROW)}, "
            f"it decreases to {dip[1]:.3f} at step {dip[0]} while the leaders move, increases to "
            f"{dip[2]:.3f}, and returns. The number of thresholds with a rebound is: {found}.",
            rebound(x_of(two)) is not None,
            "`paper/d2-frame-bonds` (a permanent rebound) or `paper/d2-chebyshev` (a rebound while "
            "the leaders move)",
            back[0] > LASTING,
        ),
        Claim(
            "differently from first gradient mode",
            "With one shell, the number of thresholds with a rebound is "
            f"{kinds(swept('one shell'))}, but `paper/d2` has no rebound either. "
            "If bonds to the frame do not break, there is "
            f"{'one' if tied_one else 'no'} rebound with one shell, and one with two shells.",
            rebound(x_of(one)) is None and rebound(x_of(two)) is not None,
            "`paper/d2-frame-bonds`, when it is compared with a run of `paper/d1` that has "
            "`frame_bonds: false`",
            tied_one is None,
        ),
        Claim(
            "some fast point on its right try to deviate it to the right",
            "In `paper/d2-frame-bonds`, the edge is pulled by bonds to frame points that remain "
            "near the torn column. Without these bonds the piece returns: the largest "
            f"displacement in `paper/d2` at step 400 is {two.residual():.3f}.",
            rebound(x_of(two)) is not None,
            "`paper/d2-frame-bonds`, in which frame points have this effect",
            back[0] > LASTING,
        ),
        Claim(
            "when the group is compacted they go back all together to initial configuration",
            "The largest displacement of the piece at step 400 is "
            f"{one.residual():.3f} in d1, {two.residual():.3f} in d2 and {wide.residual():.1g} in "
            f"`paper/d2-chebyshev`, but {kept:.2f} in `paper/d2-frame-bonds`, the variant with the "
            "permanent rebound.",
            max(one.residual(), two.residual()) < 0.1,
        ),
    ]


def _energy() -> list[Claim]:
    one = run("paper/d1")
    all_bonds, intact = one.of("pe1")[99, :, 5], one.of("pe1_intact")[99, :, 5]
    return [
        Claim(
            "in the fracture case the pseudo energy plot is less indicative",
            f"At step 99, PE1 in the column left of the gap is {all_bonds[8]:.1f} if the "
            f"broken bond is included and {intact[8]:.4f} if it is not.",
            bool(all_bonds[8] > 10 * intact[8]),
        ),
    ]
