"""Claims on the model as a whole: introduction, sections 3 and 5, conclusions."""

import numpy as np
from announced import PULLS, SPEED, elastic_signs, point_text, spreading, strain, torn_text
from claims import Claim, Section
from cost import cost
from drawing import curves
from elements import elements
from hooke import energy, hooke
from one_threshold import which
from runs import Floats, Sheet, parted, run, run_text
from waves import softening

NOISE = "initial={type: noise, amplitude: 1.0e-6}"


def section() -> Section:
    """Return the section of claims that belong to no case."""
    ks = np.linspace(0.05, 2.0, 14)
    bent = {
        label: (ks, softening(ks, *metric))
        for label, metric in (
            ("4 neighbours", ("coordination", 1)),
            ("8 neighbours, 2 shells", ("coordination", 2)),
            ("24 neighbours, Chebyshev 2", ("chebyshev", 2)),
        )
    }
    four, eight, wide = (values for _, values in bent.values())
    assert np.allclose(four, eight, atol=1e-6)
    assert (wide < four).all()
    bent["gradient elasticity, l² = +0.25"] = (ks, 1 + 0.25 * ks**2)
    pictures = [
        (
            curves(
                bent,
                ("wave number k", "stiffness(k) / stiffness(0)"),
                "stiffness.png",
                ylim=(0.2, 2.05),
            ),
            "Stiffness for waves along x. The curves for 4 and for 8 neighbours coincide, because "
            "the paper's second shell has no effect. 24 neighbours (the lowest curve) soften "
            "short waves more than 4 neighbours do; gradient elasticity with l² > 0 stiffens them",
        )
    ]
    words = "Claims of the introduction, sections 3 and 5 and the conclusions that can be tested."
    return Section(
        "The model as a whole", words, [*elements(), *_rules(), *_shape(), *cost()], pictures
    )


def _rules() -> list[Claim]:
    a, wide, lagged = run("paper/a"), run("paper/d2-chebyshev"), run("paper/c")
    first = [int(np.flatnonzero(s.u[:, 4, 5, 0])[0]) for s in (a, lagged, wide)]
    waves = np.array([0.5, 1.0])
    soft = {m: softening(waves, *m) for m in (("coordination", 2), ("chebyshev", 2))}
    plain = softening(waves, "coordination", 1)
    small = np.array([0.1])
    metrics = (("coordination", 1), *soft)
    lengths = [float((softening(small, *m)[0] - 1) / small[0] ** 2) for m in metrics]
    same = float(np.abs(soft[("coordination", 2)] - plain).max())
    memory, past = (
        run("paper/a-memory").u[:, 4, 5, 0],
        run("paper/a", "solver.relaxation=1.1", "steps=200", NOISE),
    )
    swings = int((np.diff(np.sign(memory[20:200])) != 0).sum())
    loose = run("paper/a", "neighbours={type: euclidean, radius: 1.5, reevaluate: true}")
    held = run("paper/a", "neighbours={type: euclidean, radius: 1.5}")
    spread = spreading(run_text(point_text("weighted")))
    ratio = float(spread[0] / spread[1])
    differ = float(np.abs(loose.u - held.u).max())
    pairs = [_near(loose, step) for step in (0, 10)]
    changed = (
        "In case a with Euclidean neighbours within a radius of 1.5 that are re-evaluated in every "
        f"step, {len(pairs[0] - pairs[1])} of the initially {len(pairs[0])} pairs of neighbours "
        f"are separated by step 10, and {len(pairs[1] - pairs[0])} new pairs have formed"
    )
    signs = elastic_signs()
    return [
        Claim(
            "followers will suffer the leaders motion after (k-1) time steps",
            f"Particle 67 is 5 layers from the leaders and first moves in step {first[0]}, after "
            f"{first[0] - 1} steps without motion.",
            first[0] == 5,
        ),
        Claim(
            "in a time depending on … how many shell of points are being considered",
            f"Particle 67 first moves in step {first[0]} with 4 neighbours, in step {first[1]} "
            "with the second shell (the diagonals, which do not reach further), and in step "
            f"{first[2]} with two Chebyshev shells.",
            first[1] < first[0],
            "Chebyshev neighbours (`paper/d2-chebyshev`)",
            first[2] < first[0],
        ),
        Claim(
            "considering also the second shell of neighbours we obtain second gradient effects",
            "The stiffness for waves along x, relative to that for infinitely long waves, was "
            f"computed for k = 0.5 and 1. It is {_pair(plain)} with 4 neighbours, "
            f"{_pair(soft[('coordination', 2)])} with 8, and "
            f"{_pair(soft[('chebyshev', 2)])} with 24. The values for 4 and 8 neighbours are equal "
            f"within {same:.0e}, so that the second shell has no effect. If the stiffness at "
            f"k = {small[0]:g} is written as 1 + l²k², "
            f"l² is {', '.join(f'{v:.3f}' for v in lengths)} for 4, 8 and 24 neighbours. The "
            "verdict assumes an energy with l² > 0, with which short waves are stiffer than long "
            "ones. If a negative l², as in expansions of a lattice, is accepted too, 24 neighbours "
            "have an effect, but the paper's 8 neighbours still have the same one as 4.",
            bool((soft[("coordination", 2)] > 1).all()),
            "Chebyshev neighbours",
            bool((soft[("chebyshev", 2)] > 1).all()),
        ),
        hooke(),
        energy(),
        Claim(
            "force the followers movement to overcome the baricenter … to oscillate",
            "With a relaxation of 1.1 and an initial noise of 1e-6 the displacements of the rows "
            f"differ by {_rows_differ(past, 100):.1g} after 100 steps and by "
            f"{_rows_differ(past, 200):.1g} after 200: they diverge instead of oscillating. "
            "Momentum causes oscillation: "
            f"x of particle 67 in `paper/a-memory` crosses its rest position {swings} times by "
            "step 200.",
            False,
            "`paper/a-memory`",
            swings >= 2,
        ),
        Claim(
            "the neighbours can dynamically change to every time step",
            "Neighbours can be re-evaluated, but the sheet then falls apart. "
            f"{changed}. The final positions differ by up to {differ:.0f} from those with fixed "
            "neighbours; the body is 9 wide."
            if differ > 9
            else f"{changed}. The final positions differ by up to {differ:.1g} from those with "
            "fixed neighbours.",
            0 < differ < 1,
            "the option `reevaluate: true`, with which the sheet falls apart",
            pairs[0] != pairs[1],
        ),
        Claim(
            "anisotropies [by weighted distance]",
            f"With weighted Euclidean neighbours, a disturbance spreads {1 / ratio:.2f} times as "
            "much along y as along x ([details](anisotropy-and-plasticity.md)).",
            ratio < 0.5,
        ),
        Claim(
            "anisotropic elastic behaviour",
            "Only the diffusivity is anisotropic. With weighted Euclidean neighbours, as in "
            "the previous claim, a displacement along x causes no displacement along y (largest "
            f"value {signs['cross']:.1g}). A displacement along y spreads exactly as one along x "
            f"does (difference at most {signs['turned']:.0e}). Diffusion has these two properties; "
            "in an elastic body, extension and shear are coupled and have different stiffnesses.",
            max(signs.values()) > 1e-6,
        ),
    ]


def _near(sheet: Sheet, step: int) -> set[tuple[int, int]]:
    """The pairs of body particles within 1.5 of each other."""
    place = sheet.position[step, sheet.body]
    near = np.linalg.norm(place[:, None] - place, axis=-1) <= 1.5
    return {(int(i), int(j)) for i, j in np.argwhere(np.triu(near, 1))}


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
    stays = {p: [strain(run_text(torn_text(t, p))) for t in PULLS] for p in (0.8, 1.0, 1.2)}
    ways = [SPEED * max(parted(run_text(torn_text(t, 1.2)))) for t in PULLS]
    return [
        Claim(
            "without the frame … this point will be attracted toward the inside and collapse",
            "With the barycentre rule and no frame, a sheet without leaders that move collapses: "
            f"its height decreases from 9 to {sizes[1]:.2f} after 10 steps, {sizes[2]:.2f} after "
            f"100 and {sizes[3]:.1g} after 400. With mean-displacement, the paper's first example "
            f"of a rule, the sheet stays at rest (displacement {np.abs(mean.u).max():.1g}).",
            sizes[3] < 0.1,
        ),
        Claim(
            "changing lattice we can obtain different results, all other conditions being equal",
            f"In case a, PE1 of the same particle is largest at step {peaks[0]} on the square "
            f"lattice and at step {peaks[1]} on the hexagonal lattice.",
            peaks[0] != peaks[1],
        ),
        Claim(
            "(locally) minimizing an elastic potential",
            "The sum over all bonds of the squared difference between the displacements of their "
            f"ends decreases at {int((np.diff(energy[11:]) <= 0).sum())} of {len(energy) - 12} "
            "steps after the release in case a.",
            bool((np.diff(energy[11:]) <= 0).all()),
        ),
        Claim(
            "automatically takes into account large deformation elasticity",
            "If both end columns are rotated by 90° (`paper/a-rotation`), the body should rotate "
            "with them. After convergence, particles of this body, which is 9 wide, are up to "
            f"{error:.2f} away from their rotated positions, and PE1 is "
            f"{turned.of('pe1')[-1].max():.1f} instead of "
            "0.",
            bool(error < 0.01),
        ),
        Claim(
            "[fictitious elements] recover the original shape of the lattice … elastic behaviour",
            "With λ = 1, the largest displacement at step 400 is "
            f"{run('paper/d1').residual():.3f} in `paper/d1` and "
            f"{run('paper/d2').residual():.3f} in `paper/d2`.",
            max(run("paper/d1").residual(), run("paper/d2").residual()) < 0.1,
        ),
        Claim(
            "a change in their position produces … contraction or loosening of the lattice",
            "The strain of the piece that remains clamped converges to "
            f"{stays[0.8][1]:.4f} for λ = 0.8, {stays[1.0][1]:.4f} for 1 and "
            f"{stays[1.2][1]:.4f} for 1.2 ([figures](anisotropy-and-plasticity.md)).",
            max(stays[0.8]) < -0.1 < 0.1 < min(stays[1.2]) and max(map(abs, stays[1.0])) < 1e-3,
        ),
        Claim(
            "varying the distances of the fictitious elements … plastic-like … behaviours",
            "A plastic strain would depend on the previous deformation. At thresholds of "
            f"{which(PULLS)} the right column had moved by {which(ways)} when the sheet separated. "
            f"With λ = 1.2, the remaining strains are {', '.join(f'{s:.5f}' for s in stays[1.2])}. "
            "The remaining strain is always λ − 1, because it is the effect of a permanent load on "
            "the broken edge.",
            float(np.ptp(stays[1.2])) > 0.01,
        ),
    ]


def _bond_energy(sheet: Sheet) -> Floats:
    u = sheet.u
    return sum((np.diff(u, axis=n) ** 2).sum(axis=(1, 2, 3)) for n in (1, 2))  # type: ignore[return-value]
