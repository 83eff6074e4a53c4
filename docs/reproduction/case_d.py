"""Case d: fracture of the square lattice, with one and two shells."""

from claims import Claim, Section
from drawing import configurations, histories
from one_threshold import TRIED, fitting, span, times, which
from runs import Sheet, edges_first, parted, rebound, run, steps_text
from torn_square import COLUMN, FAMILIES, LASTING, ROW, SPARED, THRESHOLDS, both, kinds, swept, x_of


def section() -> Section:
    """All of case d."""
    names = ("paper/d1", "paper/d2", "paper/d2-frame-bonds", "paper/d2-chebyshev")
    pictures = [
        (
            configurations(run("paper/d1"), [1, 5, 6, 7, 100], "d1-pe1.png"),
            "Figure 14: paper/d1: the rows part together at time 7",
        ),
        (
            configurations(run("paper/d2"), [1, 5, 6, 7, 8, 100], "d2-pe1.png"),
            "Figure 15: paper/d2: the outermost rows part at time 7, the rest at 8",
        ),
        (
            histories({n: (run(n), COLUMN, ROW) for n in names}, "d-103.png", 150, log=True),
            "Figure 16: x, y and PE1 of particle 103 (134 with Chebyshev neighbours)",
        ),
    ]
    assert (times("d1"), times("d2")) == ((7, 7), (7, 8))
    words = (
        "1.2 a step for ten steps, then held, thresholds 5.2 as in f and g, all our choice: "
        "`paper/d1` with one shell, `paper/d2` with two. “Parts” is the step in which the leader "
        "of a row loses its last bond to the column beside it; “edges first”, that both outermost "
        "rows part before every other row."
    )
    claims = [*_line(), *_rebound(), *_energy()]
    return Section("Case d: simple fracture", words, claims, pictures, both())


def _line() -> list[Claim]:
    one, two, lag = run("paper/d1"), run("paper/d2"), run("paper/d1-lag")
    sheets_of = {label: swept(label) for label in FAMILIES if "spared" not in label}
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
            "the longest bond where bonds are judged (leaders moved, followers not yet) is "
            f"{fast:.2f} at 1.2 a step for ten steps, in step {at}, and {slow:.2f} at 0.35: a "
            f"threshold of 10 breaks nothing, and the sheet parts up to {fast:.2f}. The leaders "
            f"would have to go on to step {late}",
            max(fast, slow) > 10,
            "1.2 a step for twenty steps instead of ten",
            late <= 20,
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
            f"those with edges first: {found}",
            len(first["one shell"]) == len(sheets_of["one shell"]),
            f"`paper/d1-lag`, at {share['one shell and lag 1']}",
            edges_first(parted(lag)),
        ),
        Claim(
            "points close to the frame are detached before the others [second gradient]",
            f"`paper/d2`: {rows['2']}; at {share['two shells']} that were tried in all, and with "
            f"24 neighbours at {share['24 neighbours']}",
            len(first["two shells"]) == len(sheets_of["two shells"]),
            f"`paper/d2`, at {share['two shells']}",
            edges_first(parted(two)),
        ),
        Claim(
            "this effect is more marked in second gradient case",
            f"edges before the rest by {_lead(one)} steps in `paper/d1`, {_lead(two)} in "
            f"`paper/d2` (at the same threshold); at {share['one shell']} and "
            f"{share['two shells']}; under lag 1 with one shell at "
            f"{share['one shell and lag 1']}",
            len(first["one shell"]) < len(first["two shells"]) == len(sheets_of["two shells"]),
            f"`paper/d2`, at {share['two shells']}",
            _lead(two) > _lead(one),
        ),
        Claim(
            "time (1, 5, 6, 7 and 100) … (1, 5, 6, 7, 8 and 100) [when it tears]",
            f"rows part at time {span('d1')} in `paper/d1` and {span('d2')} in `paper/d2`. Of the "
            f"thresholds {TRIED[0]:g} to {TRIED[-1]:g} in steps of 0.1 the last rows part after "
            f"time 5 and by 7 and 8 at {which(fitting('d1', 'd2'))}; at 6 at "
            f"{_times('d1', 6.0)} and {_times('d2', 6.0)}",
            5.2 in fitting("d1", "d2"),
        ),
    ]


def _steps(sheet: Sheet) -> list[int]:
    return [step for step in parted(sheet) if step is not None]


def _times(case: str, threshold: float) -> str:
    return " to ".join(str(time) for time in sorted(set(times(case, threshold) or ())))


def _lead(sheet: Sheet) -> int:
    """Steps by which the edge rows part before the last ones."""
    rows = _steps(sheet)
    return max(rows) - max(rows[0], rows[-1])


def _longest(speed: float) -> tuple[float, int]:
    """The longest bond of d1, where none breaks, and its step."""
    pull = f"leaders.1.motion.velocity=[{speed}, 0.0]"
    return run("paper/d1", "fracture.thresholds=[1000.0]", pull, "steps=20").longest_bond()


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
    families = {n: swept(n) for n in FAMILIES if "24" in n or n.startswith("two")}
    spared_one = rebound(x_of(run("paper/d1", SPARED)))
    found = "; ".join(f"{label}: {kinds(sheets)}" for label, sheets in families.items())
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
            f"one shell rebounds at {kinds(swept('one shell'))}, but `paper/d2` at no more. With "
            f"frame bonds spared one shell {'does' if spared_one else 'does not'}, two shells do",
            rebound(x_of(one)) is None and rebound(x_of(two)) is not None,
            "`paper/d2-frame-bonds` against `paper/d1` with `frame_bonds: false`",
            spared_one is None,
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
