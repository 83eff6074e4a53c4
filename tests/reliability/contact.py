"""Compare contact with the solutions of contact mechanics and of beams.

    python tests/reliability/contact.py [--cells N]...

Hertz's half-width with N cells across the contact (40 and 20), and three-point bending.
Exits with 1 if a half-width differs by more than 3 % or the deflection by more than 1.5 %.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent.parent)]
from tests.scene.test_obstacles import bending, half_widths


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, action="append")
    held = True
    for cells in parser.parse_args().cells or (20, 40):
        fitted, hertz = half_widths(cells)
        off = fitted / hertz - 1
        held &= abs(off) < 0.03
        print(f"Hertz, {cells} cells: half-width {fitted:.4f}, {hertz:.4f} in theory, {off:+.2%}")
    found, beam, shear = bending()
    print(
        f"bending: {found:.2f}, Timoshenko {beam:.2f}, {found / beam - 1:+.2%}; shear {shear:.1%}"
    )
    return int(not (held and abs(found / beam - 1) < 0.015))


if __name__ == "__main__":
    sys.exit(main())
