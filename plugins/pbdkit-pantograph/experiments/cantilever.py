"""One fibre of both rules as a cantilever, against Euler and Bernoulli: prints the README's table.

The root is clamped (of springs, which remember no direction, the first two pivots are held), the
tip is displaced by w: exact are w(x) = w (3 L x² - x³)/(2 L³) and the force F = 3 EI w/L³ at it.
"""

from __future__ import annotations

import numpy as np

import pbdkit

TIP, BENDING, STEPS = 1e-5, 0.01, 4000
RULES = {
    "beams": {"type": "pantograph-beams", "bending": BENDING},
    "springs": {"type": "pantograph", "bending": BENDING},
}


def cantilever(rule, links):
    """Return the dataset of a number of links of length 1 beyond the root."""
    springs = rule == "springs"
    first = {"select": {"box": [-1.5, -0.5, 0.5, 0.5]}, "motion": {"type": "hold"}}
    tip = {"type": "displace", "displacement": [0.0, TIP]}
    return pbdkit.run(
        {
            "name": "cantilever",
            "lattice": {"type": "square", "a": 1.0, "origin": [-1.0 if springs else 0.0, 0.0]},
            "body": {"type": "grid", "columns": links + 1 + springs, "rows": 1},
            "neighbours": {"type": "fibres"},
            "rule": RULES[rule],
            "frame": {"type": "none"},
            "leaders": [
                first | ({} if springs else {"clamped": True}),
                {"select": {"edge": "right"}, "motion": tip},
            ],
            "steps": STEPS,
            "record": {"every": STEPS},
            "solver": {"type": "stepping", "memory": 0.97, "engine": "numpy"},
        },
        progress=False,
    )


def main():
    """Print the table of errors."""
    print("| links | springs: shape off by | beams: shape off by | beams: force off by |")
    print("| --- | --- | --- | --- |")
    for links in (3, 6, 12):
        row = {}
        for rule in ("springs", "beams"):
            ds = cantilever(rule, links)
            x, w = ds.position[-1].values.T
            x = np.round(x)
            exact = TIP * (3 * links * x**2 - x**3) / (2 * links**3)
            row[rule] = np.abs(w - exact)[x >= 0].max() / TIP
        load = 3 * BENDING * TIP / links**3
        force = abs(-ds.force_y.values[-1, -1] / load - 1)
        print(f"| {links} | {row['springs']:.2e} | {row['beams']:.1e} | {force:.1e} |", flush=True)


if __name__ == "__main__":
    main()
