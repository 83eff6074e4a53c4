"""Conclusions of the comparison with the paper."""

import numpy as np
from case_e import rim_share
from one_threshold import FIGURES, fitting, which
from runs import edges_first, parted, rebound, run, sweep
from torn_square import x_of
from waves import softening


def lessons() -> str:
    """Return a numbered list with measured values."""
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
        "**The text does not define the figures completely.** The speed is 0.35 in table 1 and "
        "1.2 in case a. K, the speed and duration of cases b to g, λ, the order of frame and "
        "followers within a step, and the treatment of bonds to the frame are not given. No bond "
        "breaks at the given fracture distance of 10. Thresholds of "
        f"{which(fitting('d1', 'd2'))} agree with the times of figures 14 and 15. The thresholds "
        "that agree with the times of figures 14, 15, 18, 20 and 22, if cases d, f and g have the "
        f"same threshold, are {which(fitting(*FIGURES))}.",
        "**The frame has more influence than the rule.** The largest displacement of the torn "
        f"hexagonal sheet at the end is {torn[1]:.2f} with the `mean` frame and {torn[2]:.1g} "
        f"with the `first` frame ({torn[0]:.2f} with one shell and the `mean` frame). That of the "
        f"square sheet is {plain:.3f} if bonds to the frame can break and {spared:.2f} if they "
        "cannot. Concave surfaces, rebounds and points in the gap are caused by frame points "
        "that lie between the pieces.",
        "**The edge effects of case a depend on the order of operations.** With four neighbours "
        f"the displacements of the rows differ by {run('paper/a').spread():.1g}, and with a frame "
        f"delayed by one step by {run('paper/a-lag').spread():.3f}. The separation was tested at "
        f"{len(windows)} thresholds from 5 to 6 in steps of 0.02. With the delayed frame the rows "
        f"next to the frame separate first at {len(lagged)} of them ({_spans(lagged)}), and all "
        "rows separate together at the others. With two shells and no delay "
        f"the rows next to the frame separate first at {len(twice)} thresholds "
        f"({_spans(twice)}).",
        "**The paper's program may have moved its frame one step later.** The convexity of case "
        "a, and the earlier separation of the rows at the frame with one shell, are reproduced "
        "with `lag: 1`, but not with four neighbours and `lag: 0`. The text of the paper does "
        "not state the order.",
        "**A change of the threshold by 0.1 changes the torn sheet for hundreds of steps.** "
        "Figure 21 is reproduced with thresholds of 5.1 (`paper/f2-cusp`): a second fracture at "
        f"step {cusp}, no rebound, and a final displacement of "
        f"{run('paper/f2-cusp').residual():.3f}. With one shell, there is a rebound at 5.1 too "
        f"({turn[1]:.2f} to {turn[2]:.2f}). At 5.2, the final displacement of the sheet with two "
        f"shells is {torn[1]:.2f}.",
        f"**The rebound of figure 16** is permanent ({low[1]:.2f} to {low[2]:.2f}) only if "
        "bonds to the frame never break. The sheet then does not return (largest displacement "
        f"{spared:.2f} at step 400), which contradicts the paper's own description; and "
        "according to case f the square lattice has no rebound.",
    ]


def _spans(thresholds: list[float]) -> str:
    """Return thresholds in steps of 0.02 as a text of ranges."""
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
        "**A second shell is not a second gradient.** For waves along x, eight neighbours have "
        "the same effect as four with 1.5 times the relaxation: the relative stiffness at k = 1 is "
        f"{eight:.4f} with eight and {four:.4f} with four. With 24 neighbours, short waves are "
        f"softer ({soft:.3f}). In gradient elasticity with a positive l² in its energy, short "
        "waves are stiffer than long ones; in the expansion of a lattice l² can be negative.",
        "**The model is diffusion.** Each coordinate diffuses independently. A particle k layers "
        "away does not move before step k, and the number of steps to equilibrium grows with the "
        "square of the size. PE1 of particle 67 is largest at step "
        f"{int(run('paper/a').of('pe1')[:, 4, 5].argmax())}, long after the release at step 10, "
        "and decreases exponentially rather than like a parabola.",
        "**Case e does not verify Saint-Venant's principle.** At the paper's time 9 the "
        f"displacement of the rim is {rim_share(e, 8):.1%} of that of the leaders, because the "
        f"disturbance has only just arrived; at step 400 it is {rim_share(e, 400):.1%}.",
        "**K is not a Poisson's ratio.** The contraction is proportional to K "
        f"({strong:.3f} and {weak:.3f} times as large with 2 and ½ times K) but not to the "
        f"extension: u_y / u_x of the upper row at step 100 varies from {far[1]:.3f} at column 2 "
        f"to {far[8]:.3f} at column 9.",
        "**Large rotations are not represented.** A rotation of the leaders by a right angle "
        f"gives a PE1 of {turned.of('pe1')[-1].max():.1f}; for a rigid rotation of the body PE1 "
        "would be 0.",
        "**PE1 after a fracture** measures the width of the gap instead of the "
        "deformation of the body; use `pe1-intact`.",
        "**λ is not a yield stress.** The final strain of the piece is λ − 1 for every "
        "displacement of the leaders, because the broken edge is permanently loaded. A free piece "
        "with one broken side moves forever if λ differs from 1 "
        "([figures](anisotropy-and-plasticity.md)).",
    ]
