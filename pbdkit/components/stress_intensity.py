"""Stress intensity factors, J integral and T-stress at crack tips, by integrals over domains of
cells.

With the direction 1 of the crack and a weight q, which is 1 near the tip and 0 outside the domain,
J = ∫ (σ_ij u_i,1 - W δ_1j) q,j dA (Li, Shih and Needleman 1985). Its mixed term for the field of
the body and an auxiliary field gives K_I and K_II, with the fields of Williams (1957), and T, with
the field of a point force at the tip (Kfouri 1986).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator

from pbdkit.array_types import Floats, Indices
from pbdkit.components.diagnostics import Modulus
from pbdkit.components.elasticity import rectangle_springs
from pbdkit.errors import AccuracyWarning, ExperimentError, warn_caller
from pbdkit.plugin import CellTable, CrackEnd, Diagnostic, Moment, Pair, Stiffness, Variable
from pbdkit.plugin.component import Strict
from pbdkit.plugin.diagnostic import Need
from pbdkit.plugin.units import FRACTURE_ENERGY, LENGTH, STRESS, STRESS_INTENSITY, Place, unset

DOMAINS = (0.6, 0.7, 0.8, 0.9, 1.0)
"""Outer radii of the domains, relative to the largest one."""
HOLLOW = 0.5
"""Inner radius of a domain, relative to its outer radius."""
MAX_CELLS = 40.0
"""Default of the largest radius, in sides of a cell."""
MIN_CELLS = 6.0
"""Radius below which no domain is used, in sides of a cell."""
BESIDE = 1.25
"""Distance from the line of a crack up to which torn cells belong to it, in sides of a cell."""
SEARCHED = 2.5
"""Distance along a crack within which its last torn cells are searched, in sides of a cell."""
STEPS_BACK = 8
"""Number of torn cells from which the line of a crack that has grown is determined."""
LARGE_STRAIN = 0.1
"""Displacement gradients above this number are not small."""
ISOTROPY_RTOL = 1e-9
"""Relative difference of stiffnesses up to which a material is regarded as isotropic."""
ANGLE_ATOL = 1e-6
"""Tolerance with which the angles of the cells around a particle add up to a full turn."""
ON_LINE = 1e-9
"""Distance from a line, in sides of a cell, up to which a particle is regarded as lying on it."""


class IsotropicPlane(NamedTuple):
    """Isotropic elasticity in plane stress or plane strain, divided by Young's modulus.

    Parameters
    ----------
    shear : float
        Shear modulus μ.
    kappa : float
        Kolosov's constant κ, (3 - ν)/(1 + ν) in plane stress and 3 - 4ν in plane strain.
    """

    shear: float
    kappa: float

    @classmethod
    def of(cls, c: Stiffness) -> IsotropicPlane | None:
        """Return the constants of a stiffness, or None if it is anisotropic."""
        coupled = abs(c.x_shear) + abs(c.y_shear)
        if max(abs(c.xx - c.yy), abs(c.xx - c.xy - 2 * c.shear), coupled) > ISOTROPY_RTOL * c.xx:
            return None
        return cls(float(c.shear), float((c.xy + 3 * c.shear) / (c.xy + c.shear)))

    @property
    def modulus(self) -> float:
        """Modulus E' of G = (K_I² + K_II²)/E': E in plane stress, E/(1 - ν²) in plane strain."""
        return 8 * self.shear / (1 + self.kappa)


class CellField(NamedTuple):
    """Displacements on cells of one shape, in the frame of a crack tip.

    Axis 0 is the direction of the crack, and the tip is the origin.

    Parameters
    ----------
    x, u : array of float, shape (cell, corner, axis)
        Positions and displacements of the corners.
    intact : array of bool, shape (cell,)
        Whether no bond of the cell is broken.
    bonds : array of int, shape (bond, 2)
        Corners between which a cell has bonds.
    carries : array of bool, shape (cell, bond)
        Whether the cell is torn and the bond is intact.
    springs : array of float, shape (bond,)
        Stiffness of the springs that remain in torn cells, divided by Young's modulus and
        thickness.
    """

    x: Floats
    u: Floats
    intact: NDArray[np.bool_]
    bonds: NDArray[np.intp]
    carries: NDArray[np.bool_]
    springs: Floats


def auxiliary(x: Floats, material: IsotropicPlane) -> tuple[Floats, Floats]:
    """Return the auxiliary fields: those of K_I = 1, of K_II = 1, and of a unit force on the tip.

    Parameters
    ----------
    x
        Positions relative to the tip, (..., axis).
    material
        The material.

    Returns
    -------
    tuple
        Displacements u_i of shape (field, ..., i), and their gradients u_i,j, (field, ..., i, j).
    """
    k, mu = material.kappa, material.shear
    r, angle = np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])
    cos, sin, c, s = np.cos(angle), np.sin(angle), np.cos(angle / 2), np.sin(angle / 2)
    opening = c * (k - cos), s * (k - cos)
    sliding = s * (k + 2 + cos), -c * (k - 2 + cos)
    # Derivatives with respect to the angle.
    opening_slope = c * sin - s * (k - cos) / 2, s * sin + c * (k - cos) / 2
    sliding_slope = c * (k + 2 + cos) / 2 - s * sin, s * (k - 2 + cos) / 2 + c * sin
    scale = 1 / (2 * mu * math.sqrt(2 * math.pi))
    values, slopes = (
        scale * np.moveaxis(np.array(parts), 1, -1)
        for parts in ((opening, sliding), (opening_slope, sliding_slope))
    )
    root = np.sqrt(r)[..., None]
    force = 1 / (8 * math.pi * mu)
    pushed = [
        -force * ((1 + k) * np.log(r) + 2 * sin * sin),
        force * (2 * sin * cos - (k - 1) * angle),
    ]
    along = force * np.array([-(1 + k) + 0 * r, 0 * r])  # r ∂u/∂r
    around = force * np.array([-4 * sin * cos, 2 * np.cos(2 * angle) - (k - 1)])  # ∂u/∂angle
    radial, turned = np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)
    along, around = np.moveaxis(along, 0, -1), np.moveaxis(around, 0, -1)

    def gradient(du_dr: Floats, du_da: Floats) -> Floats:
        parts = (du_dr, radial), (du_da, turned)
        return np.asarray(sum(u[..., None] * unit[..., None, :] for u, unit in parts))

    williams = gradient(values / 2 / root, slopes / root)
    point = gradient(along / r[..., None], around / r[..., None])
    displacement = np.concatenate([values * root, np.stack(pushed, axis=-1)[None]])
    return displacement, np.concatenate([williams, point[None]])


def integrals(
    field: CellField, c: Stiffness, radii: tuple[float, float], material: IsotropicPlane | None
) -> Floats:
    """Return the share of some cells in J and in its mixed terms with the auxiliary fields.

    Parameters
    ----------
    field
        Cells, with displacements of zero mean rotation.
    c
        Stiffness in the frame of the tip, divided by Young's modulus.
    radii
        Inner and outer radius of the domain; the weight q decreases linearly from 1 to 0 between
        them.
    material
        The isotropic material; None for J alone.

    Returns
    -------
    NDArray
        J divided by Young's modulus, and the three mixed terms.
    """
    inner, outer = radii
    q = np.clip((outer - np.hypot(*np.moveaxis(field.x, -1, 0))) / (outer - inner), 0.0, 1.0)
    inside = np.ptp(q, axis=1) > 0.0
    x, u, q = field.x[inside], field.u[inside], q[inside]
    whole, carries = field.intact[inside], field.carries[inside]
    area, slopes = _mean_slopes(x)
    H, dq = np.einsum("cki,ckj->cij", u, slopes), np.einsum("ck,ckj->cj", q, slopes)
    weight = area * whole
    bars = _bars(x, u, q, carries, field)
    J = _mixed(H, H, c, dq) @ weight / 2 + _mixed_of_bars(bars, bars.d).sum() / 2
    if material is None:
        return np.array([J])
    gradient = auxiliary(x[whole].mean(axis=1), material)[1]
    mixed = [_mixed(H[whole], part, c, dq[whole]) @ weight[whole] for part in gradient]
    ends = auxiliary(bars.ends, material)[0]
    mixed_bars = [_mixed_of_bars(bars, part[:, 1] - part[:, 0]).sum() for part in ends]
    return np.array([J, *np.add(mixed, mixed_bars)])


def _mean_slopes(x: Floats) -> tuple[Floats, Floats]:
    """Return the areas of polygons and the mean gradients of their shape functions, (cell, corner,
    axis)."""
    ahead, behind = np.roll(x, -1, axis=1), np.roll(x, 1, axis=1)
    normals = np.stack([ahead[..., 1] - behind[..., 1], behind[..., 0] - ahead[..., 0]], -1) / 2
    area = np.einsum("ck,ck->c", x[..., 0], normals[..., 0])
    return area, normals / area[:, None, None]


def _mixed(H: Floats, G: Floats, c: Stiffness, dq: Floats) -> Floats:
    """Return (σ_ij G_i1 + τ_ij H_i1 - σ_ij G_ij δ_1j) q,j for gradients H and G with the stresses σ
    and τ; for G = H twice the integrand of J."""
    stress, other = _stress(H, c), _stress(G, c)
    mutual = np.einsum("cij,cij->c", stress, G)
    flux = np.einsum("cij,ci->cj", stress, G[..., 0]) + np.einsum("cij,ci->cj", other, H[..., 0])
    flux[:, 0] -= mutual
    return np.asarray(np.einsum("cj,cj->c", flux, dq))


def _stress(H: Floats, c: Stiffness) -> Floats:
    xx, yy, xy = H[:, 0, 0], H[:, 1, 1], H[:, 0, 1] + H[:, 1, 0]
    stress = np.empty_like(H)
    stress[:, 0, 0] = c.xx * xx + c.xy * yy + c.x_shear * xy
    stress[:, 1, 1] = c.xy * xx + c.yy * yy + c.y_shear * xy
    stress[:, 0, 1] = stress[:, 1, 0] = c.x_shear * xx + c.y_shear * yy + c.shear * xy
    return stress


class Bars(NamedTuple):
    """Springs of torn cells: positions of their ends, differences of displacement and of q."""

    ends: Floats
    d: Floats
    dq: Floats
    stiffness: Floats


def _bars(x: Floats, u: Floats, q: Floats, carries: NDArray[np.bool_], field: CellField) -> Bars:
    cell, bond = np.nonzero(carries)
    a, b = field.bonds[bond].T
    ends = np.stack([x[cell, a], x[cell, b]], axis=1)
    return Bars(ends, u[cell, b] - u[cell, a], q[cell, b] - q[cell, a], field.springs[bond])


def _mixed_of_bars(bars: Bars, other: Floats) -> Floats:
    """Return the same as `_mixed` for springs, of which the second field has the differences
    `other`."""
    r = bars.ends[:, 1] - bars.ends[:, 0]
    size = np.hypot(*r.T)
    e = r / size[:, None]
    first, second = (e * bars.d).sum(axis=1), (e * other).sum(axis=1)
    turn = first * other[:, 0] + second * bars.d[:, 0]
    rate = 3.0 * e[:, 0] * first * second - turn
    return np.asarray(bars.stiffness / size * bars.dq * rate)


class Tip(Strict):
    """A place near which a crack ends, and the direction in which it would grow."""

    at: Place = Field(
        description="Position of the tip, or the place from which the crack grows.",
        examples=[[5.0, 4.5]],
    )
    direction: Annotated[tuple[float, float], Field(strict=False)] = Field(
        description="Vector from the crack into the body, of any length.", examples=[[1.0, 0.0]]
    )

    @field_validator("direction")
    @classmethod
    def _has_length(cls, value: Pair) -> Pair:
        if not 0.0 < math.hypot(*value) < math.inf:
            raise ValueError("the direction has no length")
        return value


class Frame(NamedTuple):
    """Frame of a crack tip: its position and the unit vector in the direction of the crack."""

    origin: Floats
    direction: Floats

    @property
    def axes(self) -> Floats:
        """Unit vectors of the frame as rows: along the crack, and to the left of it."""
        x, y = self.direction
        return np.array([[x, y], [-y, x]])

    def of(self, points: Floats) -> Floats:
        """Return coordinates in the frame."""
        return np.asarray((points - self.origin) @ self.axes.T)


class StressIntensity(Diagnostic):
    """Stress intensity factors, energy release rate and T-stress at crack tips.

    Tips are the ends of `cuts` and initial cracks inside the body, or `tips`. A tip follows its
    crack along broken bonds. It lies where the first intact bond crosses the line of the crack. The
    quantities are means over five domains around the tip, and each error is the largest difference
    between domains. With axis 1 in the direction of the crack and axis 2 to its left, K_I and K_II
    are positive if the left lip moves along axis 2 and along axis 1 relative to the right lip. G =
    (K_I² + K_II²)/E' with E' = E in plane stress and E/(1 - ν²) in plane strain. T is the stress
    along the crack that remains at the tip. All values are NaN where there is no crack or no domain
    of sufficient size; for anisotropic materials, all but J. Domains have a `radius` of 40 cells
    unless it is given. They become smaller if they would contain an edge, another crack, another
    material, loads, leaders or obstacles.
    """

    type: Literal["stress-intensity"] = "stress-intensity"
    youngs_modulus: Modulus = Field(default_factory=unset)
    tips: Annotated[tuple[Tip, ...], Field(strict=False)] = Field(
        (), description="Crack tips; by default the ends of cuts and initial cracks."
    )
    radius: Annotated[float, Field(gt=0.0), LENGTH] | None = Field(
        None, description="Outer radius of the largest domain (lattice units).", examples=[8.0]
    )

    needs: ClassVar[frozenset[Need]] = frozenset({"cells", "cracks", "material"})
    _ends_of_cracks: bool = PrivateAttr(False)

    def variables(self) -> tuple[Variable, ...]:
        """Declare K_I, K_II, J, G and T_stress with their errors, and place, direction and radius
        of each tip.
        """
        quantities = {
            "K_I": ("stress intensity factor K_I", STRESS_INTENSITY),
            "K_II": ("stress intensity factor K_II", STRESS_INTENSITY),
            "J": ("J integral", FRACTURE_ENERGY),
            "G": ("energy release rate", FRACTURE_ENERGY),
            "T_stress": ("T-stress", STRESS),
        }
        variables = [
            Variable(f"{name}{end}", ("crack_tip",), f"{text}{more}", q.lattice, may_be_nan=True)
            for end, more in (("", ""), ("_error", ", largest difference between domains"))
            for name, (text, q) in quantities.items()
        ]
        places = {
            "position": (("crack_tip", "axis"), "position of the crack tip", LENGTH.lattice),
            "direction": (("crack_tip", "axis"), "direction of the crack", "1"),
            "radius": (("crack_tip",), "radius of the largest domain", LENGTH.lattice),
        }
        return (
            *variables,
            *(Variable(f"crack_tip_{n}", *v, may_be_nan=True) for n, v in places.items()),
        )

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Return `crack_tip`, the numbers of the tips, counted from 0."""
        return {"crack_tip": np.arange(len(self.tips))}

    def at_cracks(self, ends: tuple[CrackEnd, ...]) -> Self:
        """Return the diagnostic with the ends of cracks as tips, unless tips are given."""
        if self.tips:
            return self
        if not ends:
            raise ExperimentError(
                f"'{self.type}' requires a crack tip, but no cut and no initial crack ends inside "
                "the body; add `cuts` or `cracks`, or give `tips`"
            )
        tips = tuple(Tip(at=end.place, direction=end.direction) for end in ends)
        resolved = self.model_copy(update={"tips": tips})
        resolved._ends_of_cracks = True
        return resolved

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the quantities, their errors, and the places of the tips."""
        cracks = Cracks(now.cells.table() if now.broken_bonds() else (), now)
        values = np.full((2, 5, len(self.tips)), np.nan)
        places, radii = np.full((2, len(self.tips), 2), np.nan), np.full(len(self.tips), np.nan)
        for n, tip in enumerate(self.tips):
            frame = cracks.tip(tip)
            if frame is None:
                if not self._ends_of_cracks and cracks.size:
                    self._warn(n, "no broken bond is near it, so that it has no values")
                continue
            places[:, n] = frame.origin, frame.direction
            most = self.radius or MAX_CELLS * cracks.side
            surroundings = Surroundings(now, frame, cracks.side, most)
            radius, reason = surroundings.largest_radius()
            if (least := MIN_CELLS * cracks.side) > radius:
                self._warn(
                    n,
                    f"{reason} is {max(radius, 0.0):.4g} lattice units away, and a domain needs a "
                    f"radius of {least:.4g}, so that the tip has no values; use a finer lattice, "
                    "or a larger `radius` if it is given",
                )
                continue
            if self.radius and radius < self.radius:
                self._warn(n, f"domains are smaller than `radius`, because {reason} is near")
            radii[n], values[:, :, n] = radius, self._at_tip(n, surroundings, radius)
        return (*values[0], *values[1], *places, radii)

    def _at_tip(self, n: int, surroundings: Surroundings, radius: float) -> tuple[Floats, Floats]:
        """Return K_I, K_II, J, G and T at a tip, and their largest differences between domains."""
        if surroundings.steepest(radius) > LARGE_STRAIN:
            self._warn(
                n,
                f"displacement gradients exceed {LARGE_STRAIN:g}, but the integrals are those of "
                "small displacements; use smaller loads",
            )
        E, material = self.youngs_modulus, surroundings.material
        outer = [share * radius for share in DOMAINS]
        parts = np.array([surroundings.integrals((HOLLOW * R, R)) for R in outer])
        each = np.full((len(parts), 5), np.nan)
        each[:, 2] = E * parts[:, 0]
        if material is None:
            self._warn(n, "the material is anisotropic, so that J is the only value")
        else:
            each[:, :2] = E * material.modulus / 2 * parts[:, 1:3]
            each[:, 3] = (each[:, :2] ** 2).sum(axis=1) / (E * material.modulus)
            each[:, 4] = E * material.modulus * parts[:, 3]
        return each.mean(axis=0), np.ptp(each, axis=0)

    def _warn(self, n: int, text: str) -> None:
        x, y = self.tips[n].at
        warn_caller(f"{self.type}: crack tip {n} at ({x:g}, {y:g}): {text}", AccuracyWarning)


class Cracks:
    """The torn cells of a state."""

    def __init__(self, tables: tuple[CellTable, ...], now: Moment) -> None:
        self._now = now
        self.size = sum(len(table.corners) for table in tables)
        """Number of torn cells."""
        if self.size:
            places = [places_of(now, table) for table in tables]
            self._centres = np.concatenate([corners.mean(axis=1) for corners in places])
            ends = [x[:, t.bonds][t.broken] for x, t in zip(places, tables, strict=True)]
            self._broken = np.concatenate(ends)
            self._corners = [row for table in tables for row in table.corners.tolist()]
            self.side = side_of(places[0][0])
            """Length of the longest side of a cell."""

    def tip(self, given: Tip) -> Frame | None:
        """Return the frame of the tip of a crack that ends at a given place, or has grown from it;
        None if no cell near this place is torn.
        """
        start = Frame(np.array(given.at), np.array(given.direction) / math.hypot(*given.direction))
        if not self.size:
            return None
        along, across = start.of(self._centres).T / self.side
        is_beside = abs(across) <= BESIDE
        near = np.flatnonzero(is_beside & (abs(along) <= SEARCHED))
        if not len(near):
            return None
        last = int(near[np.lexsort((abs(across[near]), -along[near]))[0]])
        path = self._grown(last, ~(is_beside & (along <= along[last])), along)
        line, length = start, MAX_CELLS
        if len(path) > 1:
            length = min(len(path) - 1, STEPS_BACK)
            ahead = self._centres[path[-1]] - self._centres[path[-1 - length]]
            line = Frame(self._centres[path[-1]], ahead / math.hypot(*ahead))
        along, across = line.of(self._centres[path[-1]])
        at = line.origin + along * line.direction
        return self._before_intact_bond(self._between_lips(Frame(at, line.direction), length))

    def _between_lips(self, line: Frame, length: float) -> Frame:
        """Return a line midway between the lips of the crack, along a number of cells behind its
        origin.
        """
        x = line.of(self._broken) / self.side
        middle = x.mean(axis=1)
        own = (abs(middle[:, 1]) <= BESIDE) & (-length <= middle[:, 0]) & (middle[:, 0] <= 1.0)
        own &= abs(x[:, 1, 1] - x[:, 0, 1]) > ON_LINE  # Without bonds along the crack.
        if not own.any():
            return line
        low, high = np.sort(x[own, :, 1], axis=1).T
        shift = self.side * (low.max() + high.min()) / 2
        return Frame(line.origin + shift * line.axes[1], line.direction)

    def _grown(self, first: int, allowed: NDArray[np.bool_], along: Floats) -> list[int]:
        """Return the longest chain of torn cells that begins with a cell; consecutive cells share a
        side, and all but the first are allowed.
        """
        if not allowed.any():
            return [first]
        sides: dict[frozenset[int], list[int]] = {}
        for cell in (first, *np.flatnonzero(allowed).tolist()):
            for side in sides_of(self._corners[cell]):
                sides.setdefault(side, []).append(cell)
        previous, depth, queue = {first: first}, {first: 0}, deque([first])
        while queue:
            cell = queue.popleft()
            for neighbour in (n for side in sides_of(self._corners[cell]) for n in sides[side]):
                if neighbour not in previous:
                    previous[neighbour], depth[neighbour] = cell, depth[cell] + 1
                    queue.append(neighbour)
        path = [max(depth, key=lambda cell: (depth[cell], along[cell]))]
        while path[-1] != first:
            path.append(previous[path[-1]])
        return path[::-1]

    def _before_intact_bond(self, line: Frame) -> Frame:
        """Return the frame with the tip where the first intact bond ahead of broken ones crosses
        the line, of which the origin is beside the last torn cell.

        Bonds of which no spring would remain in a torn cell carry nothing across the crack.
        """
        x, y = line.origin.tolist()
        c = stiffness_at(self._now, line.origin)
        intact, broken = [], [-SEARCHED * self.side]
        for table in self._now.cells.table(((x, y), 2 * SEARCHED * self.side)):
            x = line.of(places_of(self._now, table))
            a, b = x[:, table.bonds[:, 0]], x[:, table.bonds[:, 1]]
            crosses = (a[..., 1] >= 0.0) != (b[..., 1] >= 0.0)
            height = np.where(crosses, b[..., 1] - a[..., 1], 1.0)
            place = a[..., 0] - a[..., 1] * (b[..., 0] - a[..., 0]) / height
            crosses &= abs(place) <= SEARCHED * self.side
            carries = springs_of(c, places_of(self._now, table)[0], table.bonds) > 0.0
            intact.append(place[crosses & ~table.broken & carries])
            broken.extend(place[crosses & table.broken].tolist())
        ahead = np.concatenate(intact)
        ahead = ahead[ahead > max(broken) + ON_LINE * self.side]
        position = float(ahead.min()) if len(ahead) else max(broken)
        return Frame(line.origin + position * line.direction, line.direction)


class Surroundings:
    """Cells and particles around a crack tip, in the frame of the tip.

    Parameters
    ----------
    now
        State of the run.
    frame
        Frame of the tip.
    side
        Length of the longest side of a cell.
    most
        Largest radius that is considered.
    """

    def __init__(self, now: Moment, frame: Frame, side: float, most: float) -> None:
        self._now, self._frame, self._side, self._most = now, frame, side, most
        x, y = frame.origin.tolist()
        self._tables = now.cells.table(((x, y), most + 2 * side))
        self._x = [frame.of(places_of(now, table)) for table in self._tables]
        c = stiffness_at(now, frame.origin)
        self.material = IsotropicPlane.of(c)
        """The material at the tip; None if it is anisotropic."""
        self._c = c if self.material else turned(c, frame.axes)
        self._fields = [
            self._field(table, x, c) for table, x in zip(self._tables, self._x, strict=True)
        ]

    def _field(self, table: CellTable, x: Floats, c: Stiffness) -> CellField:
        u = self._now.displacement(table.corners.ravel()).astype(float, copy=False)
        u = (u @ self._frame.axes.T).reshape(x.shape)
        carries = table.torn[:, None] & ~table.broken
        springs = springs_of(c, x[0] @ self._frame.axes, table.bonds)
        return CellField(x, u, ~table.torn, table.bonds, carries, springs)

    def integrals(self, radii: tuple[float, float]) -> Floats:
        """Return J and its three mixed terms for a domain, divided by Young's modulus."""
        turn = self._mean_gradient(radii[1])[0]
        return np.asarray(
            sum(
                integrals(field._replace(u=field.u - turn * turned_left(field.x)), self._c, radii,
                          self.material)
                for field in self._fields
            )
        )  # fmt: skip

    def steepest(self, radius: float) -> float:
        """Return the largest displacement gradient, or rotation, outside the hollow of the smallest
        domain.
        """
        return max(map(abs, self._mean_gradient(radius)))

    def _mean_gradient(self, radius: float) -> tuple[float, float]:
        """Return the mean rotation within a radius, and the largest displacement gradient between
        the inner radius of the smallest domain and this radius.
        """
        turn, total, steepest = 0.0, 0.0, 0.0
        for field in self._fields:
            distance = np.hypot(*field.x.mean(axis=1).T)
            inside = field.intact & (distance < radius)
            area, slopes = _mean_slopes(field.x[inside])
            H = np.einsum("cki,ckj->cij", field.u[inside], slopes)
            turn += float(area @ (H[:, 1, 0] - H[:, 0, 1])) / 2
            total += float(area.sum())
            away = H[distance[inside] > HOLLOW * DOMAINS[0] * radius]
            steepest = max(steepest, float(np.abs(away).max(initial=0.0)))
        return turn / total, steepest

    def largest_radius(self) -> tuple[float, str]:
        """Return the largest radius of a domain, and what limits it."""
        limits = [(self._most, "the limit"), *self._cell_limits(), *self._particle_limits()]
        return min(limits, key=lambda limit: limit[0])

    def _cell_limits(self) -> Iterator[tuple[float, str]]:
        for table, x in zip(self._tables, self._x, strict=True):
            centre, torn = x.mean(axis=1), table.torn
            distance = np.hypot(x[..., 0], x[..., 1]).min(axis=1)
            own = (abs(centre[:, 1]) <= BESIDE * self._side) & (centre[:, 0] <= self._side)
            straddles = (x[..., 1].min(axis=1) < 0.0) & (x[..., 1].max(axis=1) > 0.0)
            behind = straddles & (centre[:, 0] < -self._side) & ~torn
            other = float(distance[behind].min(initial=math.inf))
            yield other - 2 * self._side, "the other end of the crack"
            other = float(distance[torn & ~own].min(initial=math.inf))
            yield other - self._side, "another crack, or a bend of the crack,"

    def _particle_limits(self) -> Iterator[tuple[float, str]]:
        now = self._now
        rows = np.concatenate([table.corners.ravel() for table in self._tables])
        angles = np.concatenate([_angles(x).ravel() for x in self._x])
        cut = np.concatenate([np.repeat(t.share < 1.0, t.corners.shape[1]) for t in self._tables])
        rows, place = np.unique(rows, return_inverse=True)
        distance = np.hypot(*self._frame.of(now.reference(rows)).T)
        complete = np.bincount(place, angles) > 2 * math.pi - ANGLE_ATOL
        loads = (load.rows[load.share != 0.0] for load in now.loads() if load.force.any())
        leaders = (group.rows for group in now.leader_groups() if group.leads)
        for which, what in (
            (~complete | (np.bincount(place, cut) > 0.0), "an edge of the body or of a hole"),
            (self._other_material(rows), "another material"),
            (_among(rows, loads), "a load"),
            (_among(rows, leaders), "a leader"),
            (_among(rows, (contact.rows for contact in now.touching())), "an obstacle"),
        ):
            yield float(distance[which].min(initial=math.inf)), what
        if (lost := now.cells.lost_stress()) is not None:
            softened = distance[np.nan_to_num(lost[rows]).any(axis=(1, 2))]
            shares = softened[softened > HOLLOW * DOMAINS[0] * self._most]
            yield float(shares.min(initial=math.inf)), "a softened zone"

    def _other_material(self, rows: Indices) -> NDArray[np.bool_]:
        differs = np.zeros(len(rows), bool)
        at_tip = stiffness_at(self._now, self._frame.origin)
        for value, reference in zip(self._now.forces.stiffness, at_tip, strict=True):
            if np.ndim(value):
                differs |= abs(value[rows] - reference) > ISOTROPY_RTOL * at_tip.xx
        return differs


def _among(rows: Indices, groups: Iterator[Indices]) -> NDArray[np.bool_]:
    """Return which rows belong to any of several groups."""
    return np.isin(rows, np.concatenate([np.empty(0, np.intp), *groups]))


def _angles(x: Floats) -> Floats:
    """Return the interior angle at each corner of polygons, (cell, corner)."""
    ahead, behind = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    sine = ahead[..., 0] * behind[..., 1] - ahead[..., 1] * behind[..., 0]
    return np.asarray(np.arctan2(sine, (ahead * behind).sum(axis=-1)))


def places_of(now: Moment, table: CellTable) -> Floats:
    """Return the reference positions of the corners of cells, (cell, corner, axis)."""
    return now.reference(table.corners.ravel()).reshape(*table.corners.shape, 2)


def side_of(corners: Floats) -> float:
    """Return the length of the longest side of a cell, given its corners (corner, axis)."""
    return float(np.hypot(*(corners - np.roll(corners, 1, axis=0)).T).max())


def sides_of(corners: list[int]) -> Iterator[frozenset[int]]:
    """Generate the sides of a cell as pairs of corners."""
    return (frozenset((corners[k - 1], corners[k])) for k in range(len(corners)))


def turned_left(x: Floats) -> Floats:
    """Return vectors turned by a right angle, counterclockwise."""
    return np.stack([-x[..., 1], x[..., 0]], axis=-1)


def stiffness_at(now: Moment, place: Floats) -> Stiffness:
    """Return the stiffness of the particle nearest to a place."""
    c = now.forces.stiffness
    if not any(map(np.ndim, c)):
        return c
    (row,) = now.nearest(((float(place[0]), float(place[1])),))
    return Stiffness(*(float(value[row]) if np.ndim(value) else float(value) for value in c))


def turned(c: Stiffness, axes: Floats) -> Stiffness:
    """Return a stiffness in other axes, given as rows."""
    x, y = axes.T
    # Rows: the strains xx, yy and γ in the axes of the lattice, for each of the other axes.
    T = np.array([[x[0] ** 2, x[1] ** 2, x[0] * x[1]], [y[0] ** 2, y[1] ** 2, y[0] * y[1]],
                  [2 * x[0] * y[0], 2 * x[1] * y[1], x[0] * y[1] + x[1] * y[0]]])  # fmt: skip
    C = (
        T.T
        @ [[c.xx, c.xy, c.x_shear], [c.xy, c.yy, c.y_shear], [c.x_shear, c.y_shear, c.shear]]
        @ T
    )
    return Stiffness(C[0, 0], C[1, 1], C[0, 1], C[2, 2], C[0, 2], C[1, 2])


def springs_of(c: Stiffness, corners: Floats, bonds: NDArray[np.intp]) -> Floats:
    """Return the stiffnesses of the springs that remain in a torn cell, one for each bond.

    Parameters
    ----------
    c
        Stiffness of the material divided by Young's modulus.
    corners
        Corners of the cell, (corner, axis).
    bonds
        Corners between which the cell has bonds, (bond, 2).
    """
    if len(corners) == 3:
        share = min(2 / 3 * (c.xx + c.xy), 8 / 3 * c.shear)
        return np.full(len(bonds), share * math.sqrt(0.75) / 2)
    rest = abs(corners[bonds[:, 1]] - corners[bonds[:, 0]])
    a, b = np.ptp(corners, axis=0)
    along, across, diagonal = rectangle_springs(c, float(a), float(b))
    is_along, is_across = rest[:, 1] < 0.5 * b, rest[:, 0] < 0.5 * a
    return np.select([is_along, is_across], [along, across], diagonal)
