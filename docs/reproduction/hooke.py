"""Claims on Hooke's law by weights of the distance, and on PE1 as its energy."""

import numpy as np
from claims import Claim
from runs import run, run_parts

STRAIN = 1e-3
WAYS = (0.1, 0.5, 1.0, 2.0)
RELAXATIONS = (1.0, 0.6, 0.3)
LATTICES = ("square", "hexagonal")
STRAINS = ([[STRAIN, 0.0], [0.0, 0.0]], [[0.0, STRAIN / 2], [STRAIN / 2, 0.0]])
ENERGIES = (0.5 / (1 - 1 / 9), 0.25 / (1 + 1 / 3))
"""Per area and square of the strain: ε_xx alone, E / (2 (1 - ν²)), and shear, E / (4 (1 + ν))."""


def pull(way: float, relaxation: float) -> float:
    """Return the increase of the force of a neighbour that has moved away by `way`.

    It is the move of a follower amid four leaders, times the sum of weights, over the relaxation.
    """
    leaders = [
        {
            "select": {"nearest": [place]},
            "motion": {"type": "displace", "displacement": [way * (place == [2, 1]), 0.0]},
        }
        for place in ([0, 1], [1, 0], [1, 2], [2, 1])
    ]
    sheet = run_parts(
        body={"type": "grid", "columns": 3, "rows": 3},
        rule={"type": "distance-weighted"},
        leaders=leaders,
        steps=1,
        solver={"type": "stepping", "relaxation": relaxation},
    )
    return float(sheet.u[1, 1, 1, 0]) * (4 + way) / relaxation


def hooke() -> Claim:
    """Return the claim on Hooke's law, with the stability of the rule."""
    noise = "initial={type: noise, amplitude: 1.0e-6}"
    noisy = [
        np.abs(run("paper/a-weighted", f"solver.relaxation={w}", "leaders=[]", noise).u).max(
            axis=(1, 2, 3)
        )
        for w in RELAXATIONS[:2]
    ]
    ratios = np.array([[pull(way, w) / way for way in WAYS] for w in RELAXATIONS])
    off = float(np.abs(ratios - [2 + way for way in WAYS]).max())
    return Claim(
        "introduce relative distance between the points into the rule … and simulate Hook law",
        f"If a neighbour moves away by {', '.join(f'{way:g}' for way in WAYS)}, its force "
        f"increases by {', '.join(f'{r:.2f}' for r in ratios[0])} times this displacement, at "
        f"each of the relaxations {', '.join(f'{w:g}' for w in RELAXATIONS)}. The force is "
        "therefore "
        f"r² (within {off:.0e}), where r is the distance of the neighbour, and the energy is "
        "Σ r³/3. With Hooke's law the factor would be constant. In addition, the rule as printed "
        "is unstable: noise of "
        f"1e-6 grows to {noisy[0][60]:.2g} in 60 steps at rest. With a relaxation of 0.6 "
        f"(`paper/a-weighted`) it decays to {noisy[1][400]:.1g} in 400 steps.",
        bool(np.ptp(ratios) < 0.01 * ratios.mean()),
    )


def energy() -> Claim:
    """Return the claim on PE1, compared with the energy of an elastic sheet with ν = 1/3."""
    square, net = ([_pe1(lattice, gradient) for gradient in STRAINS] for lattice in LATTICES)
    elastic = [4 * w for w in ENERGIES]
    off = max(abs(found / exact - 1) for found, exact in zip(net, elastic, strict=True))
    return Claim(
        "potential energy of material points subject to Hook law [PE1]",
        "On the square lattice with 4 neighbours, PE1 divided by the square of the strain "
        f"({STRAIN:g}) is {square[0]:.3f} in tension along x and {square[1]:.1g} in shear: PE1 "
        "does "
        f"not contain the shear. On the hexagonal lattice it is {net[0]:.3f} in tension and "
        f"{net[1]:.3f} in shear. These values agree within {off:.0e} with four times the energy of "
        "an elastic sheet with ν = 1/3 and E = 1, which is "
        f"{elastic[0]:.3f} and {elastic[1]:.3f}.",
        square[1] > 0.01,
        "the hexagonal lattice",
        off < 0.01,
    )


def _pe1(lattice: str, gradient: list[list[float]]) -> float:
    """PE1 of a particle inside a uniformly strained sheet, over the square of the strain."""
    sheet = run_parts(
        lattice={"type": lattice, "a": 1.0},
        body={"type": "grid", "columns": 6, "rows": 6},
        initial={"type": "affine", "gradient": gradient},
        steps=1,
        diagnostics=[{"type": "pe1"}],
    )
    return float(sheet.of("pe1")[0, 3, 3]) / STRAIN**2
