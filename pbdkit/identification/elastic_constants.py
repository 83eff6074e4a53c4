"""Elastic constants of a rule from its expansion for long waves, if they exist.

To second order a step changes the displacement u_a by Q_abcd ∂_c ∂_d u_b. The rule is elastic if
there is a symmetric positive definite matrix B, the inverse of the mobility, with

    B_ae Q_ebcd = (C_acbd + C_adbc) / 2

where C are the elastic constants. The three components of B are determined by six linear equations
for the left side Γ. Three equations require that Γ is symmetric in a and b, because an energy
exists. The other three are Huang's relations in two dimensions, Γ_xxyy = Γ_yyxx, Γ_xxxy = Γ_xyxx
and Γ_yyxy = Γ_xyyy, because a rigid rotation has no energy. B = 1 except for rules in which x and y
approach the same equilibrium at different rates. C is determined up to a factor, which depends on
the time that a step represents. See Born and Huang, Dynamical Theory of Crystal Lattices, section
27.

Harmonics of C by direction follow Vannucci, Anisotropic Elasticity, chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement
from typing import Any

import numpy as np

from pbdkit.array_types import Floats

PAIRS = ((0, 0), (1, 1), (0, 1))
"""Pairs of axes xx, yy and xy."""
HUANG = tuple(combinations(PAIRS, 2))
"""Pairs of axes of Γ that Huang's relations exchange."""
MOBILITIES = np.eye(3)[:, [[0, 2], [2, 1]]]
"""Basis of the symmetric matrices B: xx, yy, xy."""
DIFFUSION = "diffusion"
"""Kind of rules that diffuse each component of the displacement separately."""
ELASTICITY = "elasticity"
"""Kind of rules with the equilibria of an elastic body."""
NEITHER = "neither"
"""Kind of rules that are neither diffusion nor elasticity."""
SAME = 1e-8
"""Relative tolerance for zero; central differences are accurate to 1e-9."""


@dataclass(frozen=True)
class Elasticity:
    """An elastic body in plane stress.

    Parameters
    ----------
    stiffness : array of float, shape (3, 3)
        Elastic constants C in Voigt's order xx, yy, xy, in spacing² per step.
    mobility : array of float, shape (2, 2)
        Inverse of B, scaled to tr B = 2. A step moves a particle by mobility · div σ.
    """

    stiffness: Floats
    mobility: Floats

    @property
    def symmetry(self) -> str:
        """Return isotropic, square (a quarter turn and two mirrors), orthotropic, or general."""
        fourth, second, scale = *self._harmonics, float(np.abs(self.stiffness).max())
        if abs(second) < SAME * scale:
            return "isotropic" if abs(fourth) < SAME * scale else "square"
        mixed = fourth * np.conj(second) ** 2
        return "orthotropic" if abs(mixed.imag) < SAME * scale**3 else "general"

    @property
    def axis(self) -> float | None:
        """Return the direction of an axis of symmetry in degrees, 0 to 90.

        It is None if the body is isotropic or has no such axis.
        """
        fourth, second = self._harmonics
        if self.symmetry in ("isotropic", "general"):
            return None
        square = self.symmetry == "square"
        angle = np.angle(fourth) / 4 if square else np.angle(second) / 2
        turn = 45.0 if square else 90.0
        degrees = float(np.round(np.degrees(angle), 9)) % turn
        return 0.0 if degrees > turn - 1e-6 else degrees

    @property
    def _harmonics(self) -> tuple[complex, complex]:
        """Return R0 exp(4iΦ0) and R1 exp(2iΦ1)."""
        (c11, c12, c16), (_, c22, c26), (*_, c66) = self.stiffness
        fourth = (c11 - 2 * c12 - 4 * c66 + c22 + 4j * (c16 - c26)) / 8
        return complex(fourth), complex(c11 - c22 + 2j * (c16 + c26)) / 8

    @property
    def least_stiffness(self) -> float:
        """Return the ratio of the smallest to the largest eigenvalue of the strain energy."""
        weights = np.diag(
            [1.0, 1.0, np.sqrt(2.0)]
        )  # Mandel's notation preserves the norm of strains
        sizes = np.linalg.eigvalsh(weights @ self.stiffness @ weights)
        return float(sizes[0] / sizes[-1])

    @property
    def zener(self) -> float | None:
        """Return 4 C66 / (C11 + C22 - 2 C12) in x and y, 1 for isotropic bodies.

        It is None if stretching along x and shrinking along y costs no energy.
        """
        (c11, c12, _), (_, c22, _), (*_, c66) = self.stiffness
        stretching = c11 + c22 - 2 * c12
        return float(4 * c66 / stretching) if stretching else None

    def youngs_modulus(self, degrees: float) -> float:
        """Compute Young's modulus of a bar in plane stress that is cut along a direction.

        Parameters
        ----------
        degrees : float
            Direction of the bar, counterclockwise from x in degrees.

        Returns
        -------
        float
            Modulus in units of `stiffness`.
        """
        longitudinal, _ = self._strains(degrees)
        return float(np.linalg.det(self.stiffness) / longitudinal) if longitudinal else 0.0

    def poisson_ratio(self, degrees: float) -> float | None:
        """Compute Poisson's ratio of a bar in plane stress that is cut along a direction.

        Parameters
        ----------
        degrees : float
            Direction of the bar, counterclockwise from x in degrees.

        Returns
        -------
        float or None
            -ε_across / ε_along; None if the bar cannot be stretched.
        """
        longitudinal, transverse = self._strains(degrees)
        return -transverse / longitudinal if longitudinal else None

    def _strains(self, degrees: float) -> tuple[float, float]:
        """Compute the strains along and across a bar under tension, times det C.

        They are computed from the minors of C, so that they exist for a singular C too. A strain
        along the bar that is only a rounding error is returned as 0.
        """
        rows = self.stiffness
        compliance = np.cross(rows[[1, 2, 0]], rows[[2, 0, 1]]).T
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        along, across = np.array([c * c, s * s, c * s]), np.array([s * s, c * c, -c * s])
        longitudinal, transverse = (
            float(along @ compliance @ along),
            float(across @ compliance @ along),
        )
        return longitudinal if abs(longitudinal) > SAME * np.abs(
            compliance
        ).max() else 0.0, transverse

    def as_dict(self) -> dict[str, Any]:
        """Return the constants, and quantities derived from them, by name."""
        pairs = combinations_with_replacement(range(3), 2)
        constants = {f"C{'126'[i]}{'126'[j]}": float(self.stiffness[i, j]) for i, j in pairs}
        return constants | {
            "poisson_ratio_xy": self.poisson_ratio(0.0),
            "poisson_ratio_yx": self.poisson_ratio(90.0),
            "shear_ratio": float(self.stiffness[2, 2] / self.stiffness[0, 0]),
            "zener": self.zener,
            "axis": self.axis,
            "least_stiffness": self.least_stiffness,
            "mobility": self.mobility,
        }


def second_order(along_x: Floats, along_y: Floats, along_both: Floats) -> Floats:
    """Compute Q_abcd from the second-order terms for k = (1, 0), (0, 1) and (1, 1)."""
    mixed = (along_both - along_x - along_y) / 2
    return np.array([[along_x, mixed], [mixed, along_y]]).transpose(2, 3, 0, 1)


def diffusion(q: Floats) -> Floats | None:
    """Return D_cd if Q_abcd = δ_ab D_cd, else None.

    In this case x and y diffuse separately and equally.
    """
    mean = (q[0, 0] + q[1, 1]) / 2
    remainder = q - np.einsum("ab,cd->abcd", np.eye(2), mean)
    return mean if np.abs(remainder).max() < SAME * np.abs(q).max() else None


def elasticity(q: Floats) -> Elasticity | str:
    """Return the elastic body of a rule, or the reason why there is none.

    Parameters
    ----------
    q : (2, 2, 2, 2)
        Second-order terms Q_abcd.
    """
    equations = np.array([_asymmetries(_apply(unit, q)) for unit in MOBILITIES]).T
    scale = float(np.abs(q).max())
    inverse = _inverse_mobility(equations, scale)
    if inverse is None:
        with_energy = _inverse_mobility(equations[: len(PAIRS)], scale)
        return _no_energy(q) if with_energy is None else _no_rotation(_apply(with_energy, q))
    g = _apply(inverse, q)
    c66 = (g[0, 0, 1, 1] + g[1, 1, 0, 0]) / 2
    c16, c26 = (g[0, 0, 0, 1] + g[0, 1, 0, 0]) / 2, (g[1, 1, 0, 1] + g[0, 1, 1, 1]) / 2
    c12 = g[0, 1, 0, 1] + g[1, 0, 0, 1] - c66
    stiffness = np.array([[g[0, 0, 0, 0], c12, c16], [c12, g[1, 1, 1, 1], c26], [c16, c26, c66]])
    return Elasticity(stiffness, np.linalg.inv(inverse).astype(float))


def _apply(inverse: Floats, q: Floats) -> Floats:
    """Return Γ = B Q."""
    gamma: Floats = np.einsum("ae,ebcd->abcd", inverse, q)
    return gamma


def _asymmetries(g: Floats) -> list[float]:
    """Return the six quantities that are zero for an elastic rule.

    They are the asymmetry of Γ in its first two axes, for each pair of the last two, and the errors
    of Huang's relations.
    """
    coupling = [g[0, 1][p] - g[1, 0][p] for p in PAIRS]
    return coupling + [g[p][q] - g[q][p] for p, q in HUANG]


def _inverse_mobility(equations: Floats, scale: float) -> Floats | None:
    """Return the B nearest to 1 among the solutions, with tr B = 2; None if none is positive."""
    _, sizes, rows = np.linalg.svd(equations)
    free = rows[sizes < SAME * scale]
    xx, yy, xy = free.T @ (free @ np.array([1.0, 1.0, 0.0]))
    inverse = np.array([[xx, xy], [xy, yy]])
    if xx + yy < SAME or np.linalg.eigvalsh(inverse)[0] < SAME:
        return None
    scaled: Floats = inverse * (2 / (xx + yy))
    return scaled


def _no_energy(q: Floats) -> str:
    c, d = PAIRS[np.abs(_asymmetries(q)[: len(PAIRS)]).argmax()]
    wave = f"∂{'xy'[c]}∂{'xy'[d]}"
    return (
        f"the coupling is not symmetric: {wave} of y moves x by {q[0, 1, c, d]:.6g} and {wave} of "
        f"x moves y by {q[1, 0, c, d]:.6g}, so that there is no energy"
    )


def _no_rotation(g: Floats) -> str:
    p, q = HUANG[np.abs(_asymmetries(g)[len(PAIRS) :]).argmax()]
    first, second = ("xy"[a] + "xy"[b] for a, b in (p, q))
    return (
        f"a rigid rotation costs energy: the second-order terms Q_{first}{second} = {g[p][q]:.6g} "
        f"and Q_{second}{first} = {g[q][p]:.6g} should be one constant"
    )
