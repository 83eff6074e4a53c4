"""How many steps an equilibrium takes."""

import numpy as np
from claims import Claim
from runs import run_parts


def cost() -> list[Claim]:
    """What a step costs, and how many are needed."""
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
