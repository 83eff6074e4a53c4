"""Whether long waves are those of an elastic body, and of which.

To second order a step moves a body by Q_abcd ∂_c ∂_d u_b. It is an elastic one where a symmetric
positive B exists, the inverse of the mobility, with

    B_ae Q_ebcd = (C_acbd + C_adbc) / 2

and C the elastic constants. Six linear equations in the three numbers of B say so: the left side
is symmetric in a and b (there is an energy: what x does to y, y does to x), and in 2 D Huang's
relations hold, Γ_xxyy = Γ_yyxx, Γ_xxxy = Γ_xyxx, Γ_yyxy = Γ_xyyy (no rigid rotation costs energy).
B = 1 but for rules that let x and y go to the same equilibrium at different rates. C is known up to
the time a step stands for. Born and Huang, Dynamical Theory of Crystal Lattices, section 27.

Harmonics of C by direction after Vannucci, Anisotropic Elasticity, chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
PAIRS = ((0, 0), (1, 1), (0, 1))
DIFFUSION, ELASTICITY, NEITHER = "diffusion", "elasticity", "neither"
SAME = 1e-8
"""Shares below this are nothing; what central differences give is good to 1e-9."""


@dataclass(frozen=True)
class Elasticity:
    """`stiffness` in Voigt's order xx, yy, xy (spacing²/step), `mobility` the inverse of B scaled
    to tr B = 2: a step moves by mobility · div σ."""

    stiffness: Floats
    mobility: Floats

    @property
    def symmetry(self) -> str:
        """isotropic, square (a quarter turn and two mirrors), orthotropic, or general."""
        fourth, second, scale = *self._harmonics, float(np.abs(self.stiffness).max())
        if abs(second) < SAME * scale:
            return "isotropic" if abs(fourth) < SAME * scale else "square"
        mixed = fourth * np.conj(second) ** 2
        return "orthotropic" if abs(mixed.imag) < SAME * scale**3 else "general"

    @property
    def axis(self) -> float | None:
        """The direction of an axis of symmetry in degrees, 0 to 90; None where every direction is
        one, or none."""
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
        """R0 exp(4iΦ0) and R1 exp(2iΦ1)."""
        (c11, c12, c16), (_, c22, c26), (*_, c66) = self.stiffness
        fourth = (c11 - 2 * c12 - 4 * c66 + c22 + 4j * (c16 - c26)) / 8
        return complex(fourth), complex(c11 - c22 + 2j * (c16 + c26)) / 8

    @property
    def least_stiffness(self) -> float:
        """The smallest eigenvalue of the strain energy as a share of the largest."""
        weights = np.diag([1.0, 1.0, np.sqrt(2.0)])  # of Mandel: the same length for every strain
        sizes = np.linalg.eigvalsh(weights @ self.stiffness @ weights)
        return float(sizes[0] / sizes[-1])

    @property
    def zener(self) -> float:
        """4 C66 / (C11 + C22 - 2 C12), in x and y: 1 for isotropic bodies."""
        (c11, c12, _), (_, c22, _), (*_, c66) = self.stiffness
        return float(4 * c66 / (c11 + c22 - 2 * c12))

    def youngs_modulus(self, degrees: float) -> float:
        """Of a bar in plane stress cut along that direction, in the units of `stiffness`; 0 where
        it can be pulled at no cost."""
        own, _ = self._strains(degrees)
        return float(np.linalg.det(self.stiffness) / own) if own else 0.0

    def poisson_ratio(self, degrees: float) -> float | None:
        """-ε_across / ε_along of a bar in plane stress cut along that direction; None where it
        cannot be pulled along it."""
        own, other = self._strains(degrees)
        return -other / own if own else None

    def _strains(self, degrees: float) -> tuple[float, float]:
        """Along and across a bar pulled along a direction, times det C; the first is 0 where
        it is nothing. From the minors of C, so that a body without stiffness against one strain has
        them too."""
        compliance = _adjugate(self.stiffness)
        along, across = _directions(degrees)
        own, other = float(along @ compliance @ along), float(across @ compliance @ along)
        return own if abs(own) > SAME * np.abs(compliance).max() else 0.0, other

    def as_dict(self) -> dict[str, Any]:
        """The constants by name and what follows from them."""
        constants = {
            f"C{'126'[i]}{'126'[j]}": float(self.stiffness[i, j])
            for i in range(3)
            for j in range(i, 3)
        }
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
    """Q_abcd from the second-order terms for k = (1, 0), (0, 1) and (1, 1)."""
    mixed = (along_both - along_x - along_y) / 2
    return np.array([[along_x, mixed], [mixed, along_y]]).transpose(2, 3, 0, 1)


def at_direction(q: Floats, degrees: Floats) -> Floats:
    """(direction, axis, axis): Q_abcd n_c n_d."""
    n = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    found: Floats = np.einsum("abcd,c...,d...->...ab", q, n, n)
    return found


def diffusion(q: Floats) -> Floats | None:
    """D_cd where Q_abcd = δ_ab D_cd, x and y each diffusing by itself and alike; else None."""
    mean = (q[0, 0] + q[1, 1]) / 2
    left_over = q - np.einsum("ab,cd->abcd", np.eye(2), mean)
    return mean if np.abs(left_over).max() < SAME * np.abs(q).max() else None


def elasticity(q: Floats) -> Elasticity | str:
    """The elastic body, or why there is none."""
    coupling, turning = _equations(q)
    scale = float(np.abs(q).max())
    inverse = _inverse_mobility(np.concatenate([coupling, turning]), scale)
    if inverse is None:
        with_energy = _inverse_mobility(coupling, scale)
        return _no_energy(q) if with_energy is None else _no_rotation(_applied(with_energy, q))
    g = _applied(inverse, q)
    c66 = (g[0, 0, 1, 1] + g[1, 1, 0, 0]) / 2
    c16, c26 = (g[0, 0, 0, 1] + g[0, 1, 0, 0]) / 2, (g[1, 1, 0, 1] + g[0, 1, 1, 1]) / 2
    c12 = g[0, 1, 0, 1] + g[1, 0, 0, 1] - c66
    stiffness = np.array([[g[0, 0, 0, 0], c12, c16], [c12, g[1, 1, 1, 1], c26], [c16, c26, c66]])
    return Elasticity(stiffness, np.linalg.inv(inverse).astype(float))


def _directions(degrees: float) -> tuple[Floats, Floats]:
    """Unit stress along a direction and across it, in Voigt's order."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([c * c, s * s, c * s]), np.array([s * s, c * c, -c * s])


def _applied(inverse: Floats, q: Floats) -> Floats:
    found: Floats = np.einsum("ae,ebcd->abcd", inverse, q)
    return found


def _no_energy(q: Floats) -> str:
    c, d = max(PAIRS, key=lambda p: abs(q[0, 1][p] - q[1, 0][p]))
    wave = f"∂{'xy'[c]}∂{'xy'[d]}"
    return (
        f"the coupling is not symmetric: {wave} of y moves x by {q[0, 1, c, d]:.6g} and {wave} of "
        f"x moves y by {q[1, 0, c, d]:.6g}, so that there is no energy"
    )


def _no_rotation(g: Floats) -> str:
    (a, b), (c, d) = max(
        [((0, 0), (1, 1)), ((0, 0), (0, 1)), ((1, 1), (0, 1))],
        key=lambda p: abs(g[p[0]][p[1]] - g[p[1]][p[0]]),
    )
    one, other = ("xy"[a] + "xy"[b], "xy"[c] + "xy"[d])
    return (
        f"a rigid rotation costs energy: the second-order terms Q_{one}{other} = "
        f"{g[a, b, c, d]:.6g} and Q_{other}{one} = {g[c, d, a, b]:.6g} would be one constant"
    )


def _equations(q: Floats) -> tuple[Floats, Floats]:
    """Rows for (B_xx, B_yy, B_xy): symmetric coupling, and Huang's relations."""
    xx, yy, xy = PAIRS
    coupling = [[q[0, 1][p], -q[1, 0][p], q[1, 1][p] - q[0, 0][p]] for p in PAIRS]
    turning = [
        [q[0, 0][yy], -q[1, 1][xx], q[1, 0][yy] - q[0, 1][xx]],
        [q[0, 0][xy] - q[0, 1][xx], 0.0, q[1, 0][xy] - q[1, 1][xx]],
        [-q[0, 1][yy], q[1, 1][xy], q[0, 1][xy] - q[1, 1][yy]],
    ]
    return np.array(coupling), np.array(turning)


def _inverse_mobility(equations: Floats, scale: float) -> Floats | None:
    """B nearest to 1 among the solutions, tr B = 2; None where none is positive."""
    _, sizes, rows = np.linalg.svd(equations)
    free = rows[sizes < SAME * scale]
    xx, yy, xy = free.T @ (free @ np.array([1.0, 1.0, 0.0]))
    inverse = np.array([[xx, xy], [xy, yy]])
    if xx + yy < SAME or np.linalg.eigvalsh(inverse)[0] < SAME:
        return None
    scaled: Floats = inverse * (2 / (xx + yy))
    return scaled


def _adjugate(m: Floats) -> Floats:
    """det(m) · m⁻¹, which exists where m⁻¹ does not: rows of cross products."""
    return np.array([np.cross(m[1], m[2]), np.cross(m[2], m[0]), np.cross(m[0], m[1])]).T
