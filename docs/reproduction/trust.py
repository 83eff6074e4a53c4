"""What a reader of the paper should know before trusting it."""

import numpy as np
from case_e import rim_share
from one_threshold import FIGURES, fitting, which
from runs import edges_first, parted, rebound, run, sweep
from torn_square import x_of
from waves import softening


def lessons() -> str:
    """A list, with its numbers."""
    return "\n".join(f"{n}. {text}" for n, text in enumerate((*_settings(), *_meaning()), 1)) + "\n"


def _settings() -> list[str]:
    tried = np.arange(5, 6.001, 0.02).round(2)
    windows = sweep("paper/d1", tried, "frame.lag=1")
    lagged = [t for t, sheet in windows.items() if edges_first(parted(sheet))]
    twice = [t for t, sheet in sweep("paper/d2", tried).items() if edges_first(parted(sheet))]
    plain, spared = run("paper/d2").residual(), run("paper/d2-frame-bonds").residual()
    torn = [run(f"paper/{n}").residual() for n in ("f1", "f2", "g")]
    turn = rebound(run("paper/f1", "fracture.thresholds=[5.1]").u[:, 7, 4, 0])
    assert turn is not None
    cusp = int(run("paper/f2-cusp").ds["broken_step"].values.max())
    low = rebound(x_of(run("paper/d2-frame-bonds")))
    assert low is not None
    return [
        "**The figures cannot be remade from the text.** The speed is 0.35 in table 1 and 1.2 in "
        "case a; K, the speed and duration of b to g, λ, the order of frame and followers within a "
        "step, and whether bonds to the frame break are not given; the fracture distance that is, "
        "10, breaks nothing. The times of figures 14 and 15 fit thresholds of "
        f"{which(fitting('d1', 'd2'))}; those of 14, 15, 18, 20 and 22 with one threshold for d, f "
        f"and g alike {which(fitting(*FIGURES))}.",
        "**The frame decides more than the rule.** The same torn hexagonal sheet is off its "
        f"original shape by {torn[1]:.2f} with the mean frame and {torn[2]:.1g} with the first; "
        f"the square one by {plain:.3f} or {spared:.2f}, as bonds to the frame break or not; "
        f"with one shell the hexagonal one by {torn[0]:.2f}. Concave surfaces, rebounds and points "
        "in the gap come from frame points that stand between the pieces.",
        "**The edge effects of case a come from the order of operations.** With four neighbours "
        f"rows differ by {run('paper/a').spread():.1g}; a frame one step late makes it "
        f"{run('paper/a-lag').spread():.3f}. Under that frame the rows next to it part first at "
        f"{len(lagged)} of {len(windows)} thresholds from 5 to 6 in steps of 0.02 "
        f"({_spans(lagged)}), else all rows part at once; with two shells and no lag at "
        f"{len(twice)} ({_spans(twice)}).",
        "**The paper's program may have moved its frame one step late.** The convexity of case a "
        "and frame rows that part first with one shell are reproduced with `lag: 1`, and with four "
        "neighbours and `lag: 0` they do not. The text does not decide it.",
        "**A tenth of a threshold decides what the torn sheet does for hundreds of steps.** "
        "Figure 21 is reproduced at thresholds 5.1 (`paper/f2-cusp`: a second fracture at step "
        f"{cusp}, no rebound, back to within {run('paper/f2-cusp').residual():.3f}), where "
        f"one shell rebounds as well ({turn[1]:.2f} to {turn[2]:.2f}); at 5.2 the sheet of two "
        f"shells stays {torn[1]:.2f} off.",
        f"**The rebound of figure 16** is reproduced as a lasting one ({low[1]:.2f} to "
        f"{low[2]:.2f}) only where "
        f"bonds to the frame never break, and then the sheet does not come back ({spared:.2f} left "
        "at step 400), against the paper's own words; and case f says that the square lattice has "
        "no rebound.",
    ]


def _spans(thresholds: list[float]) -> str:
    """Thresholds in steps of 0.02, as spans."""
    breaks = np.flatnonzero(np.diff(thresholds) > 0.03) + 1
    parts = np.split(np.array(thresholds), breaks)
    return ", ".join(f"{p[0]:.2f} to {p[-1]:.2f}" if len(p) > 1 else f"{p[0]:.2f}" for p in parts)


def _meaning() -> list[str]:
    soft = softening(np.array([1.0]), "chebyshev", 2)[0]
    eight = softening(np.array([1.0]), "coordination", 2)[0]
    four = softening(np.array([1.0]), "coordination", 1)[0]
    e, turned = run("paper/e"), run("paper/a-rotation")
    strong, weak = (
        run("paper/b", f"rule.K={k}").u[100, 4, 5, 1] / run("paper/b").u[100, 4, 5, 1]
        for k in (-0.008, -0.002)
    )
    far = run("paper/b").u[100, :, 9, 1] / run("paper/b").u[100, :, 9, 0].clip(1e-9)
    return [
        "**A second shell is not a second gradient.** Along x eight neighbours act as four that "
        f"are 1.5 times as fast (relative stiffness of the wave k = 1: {eight:.4f} and "
        f"{four:.4f}); 24 soften short waves more ({soft:.3f}). Gradient elasticity with a "
        "positive l² in its energy stiffens them; an expansion of a lattice may have l² < 0.",
        "**It is diffusion.** Each coordinate diffuses for itself; nothing happens k layers away "
        "before step k, and an equilibrium takes a number of steps that grows with the square of "
        "the size. PE1 of 67 peaks at step "
        f"{int(run('paper/a').of('pe1')[:, 4, 5].argmax())}, long after the release at step 10, "
        "and its fall is exponential rather than parabolic.",
        "**Saint-Venant's principle is not verified by case e.** At its time 9 the rim has "
        f"{rim_share(e, 8):.1%} of the leaders' motion because the disturbance has hardly arrived; "
        f"at step 400 it has {rim_share(e, 400):.1%}.",
        "**K is not a Poisson ratio.** The contraction is proportional to it "
        f"({strong:.3f} and {weak:.3f} times as much for 2 and ½ times K), but is no constant "
        "share of the extension: "
        f"u_y / u_x of the upper row at step 100 runs from {far[1]:.3f} at column 2 to "
        f"{far[8]:.3f} at column 9.",
        "**No large rotations.** A right angle leaves PE1 at "
        f"{turned.of('pe1')[-1].max():.1f} where a rigid turn has 0.",
        "**PE1 after a fracture** measures the gap and not the body; use `pe1-intact`.",
        "**λ is no yield stress.** Whatever the pull was, the piece ends at a strain of λ − 1: "
        "the broken edge is loaded for good. A loose piece with one broken side drifts for ever "
        "when λ differs from 1 ([figures](anisotropy-and-plasticity.md)).",
    ]
