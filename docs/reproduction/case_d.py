"""Case d: fracture of the square lattice, with one and two shells."""

import numpy as np
from claims import Claim, Section
from drawing import configurations, histories
from runs import Floats, Sheet, edges_first, parted, rebound, run, steps_text, sweep

COLUMN, ROW = 7, 5
"""Particle 103: two columns left of the leaders, just above the middle."""
THRESHOLDS = np.arange(2.25, 7.01, 0.25)
SPARED = "fracture.frame_bonds=false"
LASTING = 12
"""A rebound that begins after this step is not of the pull, which ends at step 10."""


def x_of(sheet: Sheet) -> Floats:
    """x displacement of the marked particle."""
    return sheet.u[:, COLUMN, ROW, 0]


def section() -> Section:
    """All of case d."""
    names = ("paper/d1", "paper/d2", "paper/d2-frame-bonds", "paper/d2-chebyshev")
    pictures = [
        (
            configurations(run("paper/d1"), [1, 5, 7, 8, 9, 100], "d1-pe1.png"),
            "Figure 14: paper/d1, threshold 6: the rows part together at time 8",
        ),
        (
            configurations(run("paper/d2"), [1, 7, 8, 9, 10, 100], "d2-pe1.png"),
            "Figure 15: paper/d2, thresholds 6: the outermost rows part at time 9, the rest at 10",
        ),
        (
            configurations(run("paper/d1-early"), [1, 5, 6, 7, 100], "d1-early-pe1.png"),
            "Figure 14 at the paper's times: paper/d1-early, threshold 4.75",
        ),
        (
            configurations(run("paper/d2-early"), [1, 5, 6, 7, 8, 100], "d2-early-pe1.png"),
            "Figure 15 at the paper's times: paper/d2-early, thresholds 4.75",
        ),
        (
            histories({n: (run(n), COLUMN, ROW) for n in names}, "d-103.png", 150, log=True),
            "Figure 16: x, y and PE1 of particle 103 (134 with Chebyshev neighbours)",
        ),
    ]
    words = (
        "1.2 a step for ten steps, then held, thresholds 6.0, all our choice: `paper/d1` with one "
        "shell, `paper/d2` with two. “Parts” is the step in which the leader of a row loses its "
        "last bond to the column beside it."
    )
    return Section("Case d: simple fracture", words, [*_line(), *_rebound(), *_energy()], pictures)


def _line() -> list[Claim]:
    one, two, lag = run("paper/d1"), run("paper/d2"), run("paper/d1-lag")
    swept = {
        "one shell": sweep("paper/d1", THRESHOLDS),
        "one shell and lag 1": sweep("paper/d1", THRESHOLDS, "frame.lag=1"),
        "two shells": sweep("paper/d2", THRESHOLDS),
        "24 neighbours": sweep("paper/d2-chebyshev", THRESHOLDS),
    }
    first = {
        label: [t for t, sheet in sheets.items() if edges_first(parted(sheet))]
        for label, sheets in swept.items()
    }
    share = {n: f"{len(first[n])} of {len(swept[n])} thresholds" for n in swept}
    found = "; ".join(
        f"{label}: {len(first[label])} of {len(swept[label])}"
        + (f" ({', '.join(f'{t:g}' for t in first[label])})" if first[label] else "")
        for label in swept
    )
    rows = {label: steps_text(parted(s)) for label, s in (("1", one), ("2", two), ("lag", lag))}
    far, slow = _ten()
    return [
        Claim(
            "choosing a distance fracture of about 10 units",
            f"at 1.2 a step for ten steps the longest bond is {far:.2f}, at 0.35 {slow:.2f}: a "
            "threshold of 10 breaks nothing. The leaders would have to go on to step "
            f"{_first_break_at_ten()}",
            far > 10 or slow > 10,
            "1.2 a step for twenty steps instead of ten",
            _first_break_at_ten() <= 20,
        ),
        Claim(
            "the vertical fracture line is different in first or second gradient",
            f"rows, bottom to top, part at steps {rows['1']} with one shell, {rows['2']} with two",
            rows["1"] != rows["2"],
        ),
        Claim(
            "points close to the frame are detached before the others [first gradient]",
            f"`paper/d1`: {rows['1']}, all at once; `paper/d1-lag`: {rows['lag']}. Thresholds "
            f"from {THRESHOLDS[0]:g} to {THRESHOLDS[-1]:g} at which all rows part, and among them "
            f"those at which the edges do first: {found}",
            len(first["one shell"]) == len(swept["one shell"]),
            f"`paper/d1-lag`, at {share['one shell and lag 1']}",
            edges_first(parted(lag)),
        ),
        Claim(
            "points close to the frame are detached before the others [second gradient]",
            f"`paper/d2`: {rows['2']}; at {share['two shells']} that were tried in all, and with "
            f"24 neighbours at {share['24 neighbours']}",
            len(first["two shells"]) == len(swept["two shells"]),
            f"`paper/d2`, at {share['two shells']}",
            edges_first(parted(two)),
        ),
        Claim(
            "this effect is more marked in second gradient case",
            f"edge before the middle by {_lead(one)} steps with one shell, {_lead(two)} with two; "
            f"at {share['one shell']} and {share['two shells']}",
            _lead(two) > _lead(one),
        ),
        Claim(
            "time (1, 5, 6, 7 and 100) … (1, 5, 6, 7, 8 and 100) [when it tears]",
            f"at threshold 6 the sheets are whole to time 7 and 8; at 4.75 the rows part at times "
            f"{_times(run('paper/d1-early'))} and {_times(run('paper/d2-early'))}",
            max(_steps(one)) <= 6,
            "`paper/d1-early` and `paper/d2-early`",
            max(_steps(run("paper/d1-early"))) <= 6 and max(_steps(run("paper/d2-early"))) <= 7,
        ),
    ]


def _steps(sheet: Sheet) -> list[int]:
    return [step for step in parted(sheet) if step is not None]


def _times(sheet: Sheet) -> str:
    return " ".join(str(step + 1) for step in _steps(sheet))


def _lead(sheet: Sheet) -> int:
    """Steps by which the edge rows part before the middle ones."""
    rows = _steps(sheet)
    return max(rows) - max(rows[0], rows[-1])


def _ten() -> tuple[float, float]:
    """The longest bond between the leaders and the column beside them, at 1.2 and 0.35."""
    fast, slow = run("paper/a-text").u, run("paper/a").u
    return tuple(1 + float((u[:11, 9, 5, 0] - u[:11, 8, 5, 0]).max()) for u in (fast, slow))  # type: ignore[return-value]


def _first_break_at_ten() -> int:
    on = run("paper/d1", "fracture.thresholds=[10.0]", "leaders.1.motion.steps=20", "steps=20")
    broken = on.ds["broken_step"].values
    return int(broken[broken > 0].min()) if (broken > 0).any() else 999


def _rebound() -> list[Claim]:
    one, two = run("paper/d1"), run("paper/d2")
    spared, wide = run("paper/d2-frame-bonds"), run("paper/d2-chebyshev")
    back, dip = rebound(x_of(spared)), rebound(x_of(wide))
    assert back is not None
    assert dip is not None
    families = {
        "two shells": sweep("paper/d2", THRESHOLDS),
        "two shells, frame bonds spared": sweep("paper/d2", THRESHOLDS, SPARED),
        "24 neighbours": sweep("paper/d2-chebyshev", THRESHOLDS),
    }
    found = "; ".join(f"{label}: {_kinds(sheets)}" for label, sheets in families.items())
    kept = spared.residual()
    return [
        Claim(
            "x of 103: after the fracture a sort of rebound [second gradient]",
            f"`paper/d2`: x falls without a turn after its top at step {int(x_of(two).argmax())}. "
            f"`paper/d2-frame-bonds`: {back[1]:.3f} at step {back[0]}, later {back[2]:.3f}, for "
            f"good. `paper/d2-chebyshev`, number {wide.number(COLUMN, ROW)}: a dip to {dip[1]:.3f} "
            f"at step {dip[0]} while the leaders move, then {dip[2]:.3f}, and back. Thresholds: "
            f"{found}",
            rebound(x_of(two)) is not None,
            "`paper/d2-frame-bonds` (lasting) or `paper/d2-chebyshev` (a dip during the pull)",
            back[0] > LASTING,
        ),
        Claim(
            "differently from first gradient mode",
            f"one shell: none at {len(sweep('paper/d1', THRESHOLDS))} thresholds"
            if not any(rebound(x_of(s)) for s in sweep("paper/d1", THRESHOLDS).values())
            else "one shell rebounds too at some thresholds",
            rebound(x_of(one)) is None,
        ),
        Claim(
            "some fast point on its right try to deviate it to the right",
            "`paper/d2-frame-bonds`: bonds to frame points which stay near the torn column pull "
            f"the edge; without those the piece comes back (`paper/d2`: {two.residual():.3f} left "
            "at step 400)",
            rebound(x_of(two)) is not None,
            "`paper/d2-frame-bonds`, where it is the frame",
            back[0] > LASTING,
        ),
        Claim(
            "when the group is compacted they go back all together to initial configuration",
            f"largest displacement of the piece at step 400: {one.residual():.3f} in d1, "
            f"{two.residual():.3f} in d2, {wide.residual():.1g} in `paper/d2-chebyshev`, but "
            f"{kept:.2f} in `paper/d2-frame-bonds`, the variant with the lasting rebound",
            max(one.residual(), two.residual()) < 0.1,
        ),
    ]


def _kinds(sheets: dict[float, Sheet]) -> str:
    """How many rebound at all, and how many of them after the pull."""
    lows = [low[0] for low in (rebound(x_of(s)) for s in sheets.values()) if low]
    after = sum(low > LASTING for low in lows)
    return f"{len(lows)} of {len(sheets)} ({after} of them after the pull)"


def _energy() -> list[Claim]:
    one = run("paper/d1")
    all_bonds, intact = one.of("pe1")[99, :, 5], one.of("pe1_intact")[99, :, 5]
    return [
        Claim(
            "in the fracture case the pseudo energy plot is less indicative",
            f"step 99, column left of the gap: PE1 {all_bonds[8]:.1f} with the broken bond, "
            f"{intact[8]:.4f} without",
            bool(all_bonds[8] > 10 * intact[8]),
        ),
    ]
