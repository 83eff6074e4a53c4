"""Why the two ends of the specimen with a hole seem to be of different moduli, and what a fit finds
that clamps an end: `PYTHONPATH=tests python -m finite_elements.ends`.

Strains are of ux along x; moduli in MPa, from the force over thickness and height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from finite_elements.specimen import FORCE, HEIGHT, LENGTH, THICKNESS, Data, Plate, lame, read
from finite_elements.updating import MARGIN, Estimate, Found, alike, relative_positions
from scipy.optimize import least_squares
from skfem import FacetBasis, LinearForm

STRESS = FORCE / THICKNESS / HEIGHT
WINDOWS = {"left": (1.0, 20.0), "right": (60.0, 79.0)}
ELEMENTS = 12
"""Over the height: the values stay within a twentieth of their errors with twice as many."""


class End(NamedTuple):
    """The mean strain of one end, and the modulus of a bar that has it."""

    strain: Estimate
    modulus: Estimate
    points: int


def affine(data: Data, window: tuple[float, float]) -> End:
    """ux = a + b x + c y by least squares; the error is that of its residuals."""
    x, y = data.points.T
    chosen = (x > window[0]) & (x < window[1])
    columns = np.column_stack([np.ones(chosen.sum()), x[chosen], y[chosen]])
    ux = data.displacements[chosen, 0]
    found = np.linalg.lstsq(columns, ux, rcond=None)[0]
    left = ux - columns @ found
    variance = left @ left / (len(ux) - 3) * np.linalg.inv(columns.T @ columns)[1, 1]
    strain = Estimate(float(found[1]), float(np.sqrt(variance)))
    modulus = STRESS / strain.value
    return End(strain, Estimate(modulus, modulus * strain.error / strain.value), len(ux))


def ends(data: Data | None = None) -> dict[str, End]:
    """Both, of all points farther than 0.5 mm within the outline."""
    data = data or read().inside(MARGIN)
    return {side: affine(data, window) for side, window in WINDOWS.items()}


class Fall(NamedTuple):
    """Decrease of the strain from end to end."""

    between: Estimate
    """From the affine fits of both ends, over the distance of their middles."""
    whole: Estimate
    """From one x², fitted with elastic elements for the rest."""
    left: Estimate
    right: Estimate
    """From an x² for each half, which that half alone determines."""
    without: Found
    found: Found
    apart: Found
    """The fits without it, with one, and with one of each half."""


def fall() -> Fall:
    """The strain that falls evenly: 8 s / length of ux = s x², x from -1 to 1."""
    data = read().inside(MARGIN)
    box = float(np.ptp(data.points[:, 0]))
    left, right = ends(data).values()
    middles = [sum(window) / 2.0 for window in WINDOWS.values()]
    stretch = LENGTH / (middles[1] - middles[0])
    between = Estimate(
        (left.strain.value - right.strain.value) * stretch,
        float(np.hypot(left.strain.error, right.strain.error)) * stretch,
    )
    without = alike(ELEMENTS, plain=False, terms=lambda points: np.zeros((2 * len(points), 0)))
    found, apart = alike(ELEMENTS, plain=False), alike(ELEMENTS, plain=False, terms=halves)
    of = [_fall(s, box) for s in (*found.strengths, *apart.strengths)]
    return Fall(between, of[0], of[1], of[2], without, found, apart)


def _fall(strength: Estimate, box: float) -> Estimate:
    """From end to end of the plate."""
    factor = 8.0 * LENGTH / box**2
    return Estimate(-factor * strength.value, factor * strength.error)


def halves(points: np.ndarray) -> np.ndarray:
    """x² on the left of the hole's middle, and on the right; both are smooth there."""
    along = relative_positions(points)
    parts = np.column_stack([np.minimum(along, 0.0) ** 2, np.maximum(along, 0.0) ** 2])
    return np.concatenate([parts, np.zeros_like(parts)])


def straightened(strength: float) -> dict[str, End]:
    """The ends, with the distortion taken away."""
    data = read().inside(MARGIN)
    u = data.displacements.copy()
    u[:, 0] -= strength * relative_positions(data.points) ** 2
    return ends(Data(data.points, u))


class Clamped(NamedTuple):
    """Young's modulus and Poisson's ratio fitted to the field, with the left end held and the force
    on the right one; and the root mean square of the remainder, in mm."""

    young: Estimate
    poisson: Estimate
    left: float


def clamped(*, by_axis: bool = False, rigid: bool = False) -> Clamped:
    """u = 0 at x = 0 and an even traction at the other end, by elements. `by_axis` counts ux and uy
    each over its mean size; `rigid` lets the whole move and turn as it fits."""
    data, plate = read().inside(MARGIN), Plate(ELEMENTS)
    shows, u = plate.shows(data.points), data.displacements
    weight = 1.0 / np.abs(u).mean(axis=0) if by_axis else np.ones(2)
    weights, motions = np.repeat(weight, len(u)), _motions(data.points) if rigid else None
    free = np.setdiff1d(np.arange(plate.basis.N), plate.ends[0])
    load = _traction(plate)

    def seen(z: np.ndarray) -> np.ndarray:
        """z is Poisson's ratio, what is shared by 200 GPa and Young's modulus, and the motions."""
        field = np.zeros(plate.basis.N)
        field[free] = plate.factorised(plate.stiffness(lame(z[0])), free).solve(load[free])
        found = shows @ field * z[1] / 200e3
        return weights * (found if motions is None else found + motions @ z[2:])

    start = np.array([0.25, 1.0, *([] if motions is None else [0.0] * 3)])
    bounds = ([0.0, *[-np.inf] * (len(start) - 1)], [0.49, *[np.inf] * (len(start) - 1)])
    wanted = weights * u.T.ravel()
    found = least_squares(lambda z: seen(z) - wanted, start, bounds=bounds, x_scale="jac")
    rest = found.fun / weights
    variance = found.fun @ found.fun / (len(wanted) - len(start))
    errors = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)) * variance)
    young = 200e3 / float(found.x[1])
    return Clamped(
        Estimate(young, young * float(errors[1] / found.x[1])),
        Estimate(float(found.x[0]), float(errors[0])),
        float(np.sqrt(np.mean(rest**2))),
    )


def _traction(plate: Plate) -> np.ndarray:
    """The force over thickness, even over the right end."""
    facets = plate.basis.mesh.facets_satisfying(lambda at: np.abs(at[0] - LENGTH) < 1e-6)
    edge = FacetBasis(plate.basis.mesh, plate.basis.elem, facets=facets)
    return np.asarray(LinearForm(lambda v, _: v[0]).assemble(edge) * STRESS)


def _motions(points: np.ndarray) -> np.ndarray:
    """Both shifts and the turn, (number, 3)."""
    x, y = points.T
    none, one = np.zeros(len(x)), np.ones(len(x))
    columns = ([one, none], [none, one], [-y, x])
    return np.stack([np.concatenate(column) for column in columns], axis=1)


def moved() -> tuple[Estimate, Estimate]:
    """The mean of ux in mm, and how it scatters, from 1 to 2 mm within each end."""
    data = read().inside(MARGIN)
    near = [np.abs(data.points[:, 0] - x) < 0.5 for x in (1.5, LENGTH - 1.5)]
    some = [data.displacements[chosen, 0] for chosen in near]
    left, right = (Estimate(float(ux.mean()), float(ux.std())) for ux in some)
    return left, right


def main() -> None:
    """Print all results in lines."""
    for side, end in ends().items():
        print(f"{side}: strain {text_of(end.strain, 1e6)}e-6, {text_of(end.modulus, 1e-3)} GPa")
    found = fall()
    for name in ("between", "whole", "left", "right"):
        print(f"strain falls from end to end, {name}: {text_of(getattr(found, name), 1e6)}e-6")
    for name in ("without", "found", "apart"):
        fit = getattr(found, name)
        print(f"fit, {name}: ν {text_of(fit.poisson)}, E {text_of(fit.young, 1e-3)} GPa, "
              f"residual {fit.ratio:.3f} of the noise")  # fmt: skip
    for side, end in straightened(found.found.strengths[0].value).items():
        print(f"{side}, straightened: {text_of(end.modulus, 1e-3)} GPa")
    for by_axis in (False, True):
        for rigid in (False, True):
            held = clamped(by_axis=by_axis, rigid=rigid)
            print(f"clamped{', axes apart' * by_axis}{', moved as a whole' * rigid}: "
                  f"E {text_of(held.young, 1e-3)} GPa, ν {text_of(held.poisson)}, "
                  f"leaves {1e3 * held.left:.2f} µm")  # fmt: skip
    for side, ux in zip(WINDOWS, moved(), strict=True):
        print(f"ux near the {side} end: {text_of(ux, 1e3)} µm")


def text_of(of: Estimate, unit: float = 1.0) -> str:
    """Return the text "value ± error"."""
    return f"{of.value * unit:.4g} ± {of.error * unit:.2g}"


if __name__ == "__main__":
    main()
