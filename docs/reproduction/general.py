"""What the paper says of the model as a whole: introduction, sections 3 and 5, conclusions."""

import numpy as np
from announced import point_text, spreading
from claims import Claim, Section
from drawing import curves
from runs import Floats, Sheet, run, run_parts, run_text
from waves import softening

NOISE = "initial={type: noise, amplitude: 1.0e-6}"


def section() -> Section:
    """All claims of no case in particular."""
    ks = np.linspace(0.05, 2.0, 14)
    bent = {
        label: (ks, softening(ks, *metric))
        for label, metric in (
            ("4 neighbours", ("coordination", 1)),
            ("8 neighbours, 2 shells", ("coordination", 2)),
            ("24 neighbours, Chebyshev 2", ("chebyshev", 2)),
        )
    }
    bent["gradient elasticity, l = 0.5"] = (ks, 1 + 0.25 * ks**2)
    pictures = [
        (
            curves(
                bent,
                ("wave number k", "stiffness(k) / stiffness(0)"),
                "stiffness.png",
                ylim=(0.2, 2.05),
            ),
            "What a second shell does to waves along x: it softens short ones, where second "
            "gradient elasticity stiffens them; the two lower curves of 4 and 8 neighbours are one",
        )
    ]
    words = "Claims of the introduction, sections 3 and 5 and the conclusions that can be tested."
    return Section("The model as a whole", words, [*_rules(), *_shape(), *_cost()], pictures)


def _rules() -> list[Claim]:
    a, wide, lagged = run("paper/a"), run("paper/d2-chebyshev"), run("paper/c")
    first = [int(np.flatnonzero(s.u[:, 4, 5, 0])[0]) for s in (a, lagged, wide)]
    waves = np.array([0.5, 1.0])
    soft = {m: softening(waves, *m) for m in (("coordination", 2), ("chebyshev", 2))}
    plain = softening(waves, "coordination", 1)
    same = float(np.abs(soft[("coordination", 2)] - plain).max())
    noisy = [
        np.abs(run("paper/a-weighted", f"solver.relaxation={w}", "leaders=[]", NOISE).u).max(
            axis=(1, 2, 3)
        )
        for w in (1.0, 0.6)
    ]
    memory, past = (
        run("paper/a-memory").u[:, 4, 5, 0],
        run("paper/a", "solver.relaxation=1.1", NOISE),
    )
    swings = int((np.diff(np.sign(memory[20:200])) != 0).sum())
    loose = run("paper/a", "neighbours={type: euclidean, radius: 1.5, reevaluate: true}")
    held = run("paper/a", "neighbours={type: euclidean, radius: 1.5}")
    spread = spreading(run_text(point_text("weighted")))
    ratio = float(spread[0] / spread[1])
    differ = float(np.abs(loose.u - held.u).max())
    return [
        Claim(
            "followers will suffer the leaders motion after (k-1) time steps",
            f"67 is 5 layers from the leaders and moves first in step {first[0]}, after "
            f"{first[0] - 1} steps without motion",
            first[0] == 5,
        ),
        Claim(
            "in a time depending on … how many shell of points are being considered",
            f"67 first moves in step {first[0]} with 4 neighbours, {first[1]} with the second "
            f"shell (the diagonals, which reach no further), {first[2]} with two Chebyshev shells",
            first[1] < first[0],
            "Chebyshev neighbours (`paper/d2-chebyshev`)",
            first[2] < first[0],
        ),
        Claim(
            "considering also the second shell of neighbours we obtain second gradient effects",
            "second gradient elasticity stiffens short waves, by 1 + l²k². Measured at k = 0.5 and "
            f"1: {_pair(plain)} with 4 neighbours, {_pair(soft[('coordination', 2)])} with 8 "
            f"(the same within {same:.0e}), {_pair(soft[('chebyshev', 2)])} with 24: softer, "
            "l² < 0",
            bool((soft[("coordination", 2)] > 1).all()),
            "Chebyshev neighbours",
            bool((soft[("chebyshev", 2)] > 1).all()),
        ),
        Claim(
            "introduce relative distance between the points into the rule … Hook law",
            f"as printed the rule is unstable: noise of 1e-6 is {noisy[0][60]:.2g} after 60 steps "
            f"at rest and {noisy[0][400]:.2g} after 400. With a relaxation of 0.6, "
            f"`paper/a-weighted`, it is {noisy[1][400]:.1g}",
            bool(noisy[0][60] < 1e-5),
            "`paper/a-weighted`, relaxation 0.6",
            bool(noisy[1][400] < 1e-5),
        ),
        Claim(
            "force the followers movement to overcome the baricenter … to oscillate",
            "a relaxation of 1.1 with noise of 1e-6 makes rows differ by "
            f"{_rows_differ(past, 100):.1g} after 100 steps and {_rows_differ(past, 400):.1g} "
            f"after 400: no oscillation, it diverges. Memory does it: x of 67 in "
            f"`paper/a-memory` crosses its rest position {swings} times by step 200",
            False,
            "`paper/a-memory`",
            swings >= 2,
        ),
        Claim(
            "the neighbours can dynamically change to every time step",
            "euclidean neighbours within 1.5, found anew at every step, in case a: they do, and "
            f"the sheet does not hold together (up to {differ:.0f} off that with fixed ones)",
            differ > 0,
        ),
        Claim(
            "anisotropies [by weighted distance], anisotropic elastic behaviour",
            f"weighted euclidean neighbours spread a disturbance {1 / ratio:.2f} times as much "
            "along y as along x ([its own page](anisotropy-and-plasticity.md))",
            ratio < 0.5,
        ),
    ]


def _pair(values: Floats) -> str:
    return " and ".join(f"{v:.4f}" for v in values)


def _rows_differ(sheet: Sheet, step: int) -> float:
    return float(np.ptp(sheet.u[step, ..., 0], axis=1).max())


def _shape() -> list[Claim]:
    bare, turned = run("paper/a-no-frame", "leaders=[]"), run("paper/a-rotation")
    mean = run("paper/a-no-frame", "leaders=[]", "rule={type: mean-displacement}")
    place = bare.on_grid(bare.position)
    sizes = [float(np.ptp(place[t, ..., 1])) for t in (0, 10, 100, 400)]
    rest = turned.on_grid(turned.position[:1].repeat(2, axis=0))[0] - 4.5
    exact = np.stack([-rest[..., 1], rest[..., 0]], axis=-1) + 4.5
    error = np.linalg.norm(turned.on_grid(turned.position)[-1] - exact, axis=-1).max()
    one, hexagonal = run("paper/a"), run("paper/a", "lattice={type: hexagonal, a: 1.0}")
    peaks = [int(s.of("pe1")[:, 4, 5].argmax()) for s in (one, hexagonal)]
    energy = _bond_energy(one)
    return [
        Claim(
            "without the frame … this point will be attracted toward the inside and collapse",
            f"a sheet of height 9 at rest, barycentre, no frame: {sizes[1]:.2f} after 10 steps, "
            f"{sizes[2]:.2f} after 100, {sizes[3]:.1g} after 400; with mean-displacement, the "
            f"paper's first example of a rule, it stays ({np.abs(mean.u).max():.1g})",
            sizes[3] < 0.1,
        ),
        Claim(
            "changing lattice we can obtain different results, all other conditions being equal",
            f"PE1 of the same particle of case a peaks at step {peaks[0]} on the square lattice, "
            f"{peaks[1]} on the hexagonal one",
            peaks[0] != peaks[1],
        ),
        Claim(
            "(locally) minimizing an elastic potential",
            "the sum of squared differences of displacement over all bonds of the body, case a, "
            f"falls at {int((np.diff(energy[11:]) <= 0).sum())} of {len(energy) - 12} steps after "
            "the release",
            bool((np.diff(energy[11:]) <= 0).all()),
        ),
        Claim(
            "automatically takes into account large deformation elasticity",
            "both end columns turned by 90° (`paper/a-rotation`): the body should turn with them; "
            f"once settled it is off by up to {error:.2f}, on a body 9 wide, and PE1 is "
            f"{turned.of('pe1')[-1].max():.1f} where it should be 0",
            bool(error < 0.01),
        ),
        Claim(
            "[fictitious elements] recover the original shape of the lattice … elastic behaviour",
            f"`paper/d1` and `paper/d2`, λ = 1: {run('paper/d1').residual():.3f} and "
            f"{run('paper/d2').residual():.3f} left at step 400",
            max(run("paper/d1").residual(), run("paper/d2").residual()) < 0.1,
        ),
        Claim(
            "varying the distances of the fictitious elements … plastic-like and elastic-like",
            "a strain of λ − 1 stays for good, see "
            "[the measured figure](anisotropy-and-plasticity.md); "
            f"λ = 1.2: {_strain(1.2):.4f}, 0.8: {_strain(0.8):.4f}, 1: {_strain(1.0):.4f} at step "
            "400. It does not depend on how far the piece was pulled",
            _strain(1.2) > 0.1 and _strain(0.8) < -0.1 and abs(_strain(1.0)) < 0.02,
        ),
    ]


def _strain(placement: float) -> float:
    """The strain of the piece of d1 at step 400, between its left and torn columns."""
    return float(run("paper/d1", f"fracture.placement={placement}").u[-1, 8, 5, 0]) / 8


def _bond_energy(sheet: Sheet) -> Floats:
    u = sheet.u
    return sum((np.diff(u, axis=n) ** 2).sum(axis=(1, 2, 3)) for n in (1, 2))  # type: ignore[return-value]


def _cost() -> list[Claim]:
    sizes = (10, 20, 40)
    steps = [_settling(n) for n in sizes]
    growth = steps[2] / steps[1]
    return [
        Claim(
            "computational costs are low because we do not solve differential equations",
            "a step is one sum over the neighbours, but many are needed: to within 1 % of the "
            f"equilibrium of a held sheet of {', '.join(f'{n} × {n}' for n in sizes)} it takes "
            f"{', '.join(map(str, steps))} steps, {growth:.1f} times as many for twice the size; a "
            "sparse direct solve of the same equations is one. Few in a small sheet, not in a "
            "large one",
            growth < 1.5,
            "sheets of some ten particles a side",
            steps[0] < 400,
        )
    ]


def _settling(size: int) -> int:
    """Steps until a sheet held after a pull is within 1 % of the pull from its equilibrium."""
    leaders = [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "displace", "displacement": [1.0, 0.0]},
        },
    ]
    body = {"type": "grid", "columns": size, "rows": 3}
    u = run_parts(body=body, leaders=leaders, steps=2 * size * size).u[:, :, 1, 0]
    off = np.abs(u - np.linspace(0, 1, size)).max(axis=1)
    return int(np.flatnonzero(off > 0.01)[-1]) + 1
