"""Makes docs/reproduction.md, docs/anisotropy-and-plasticity.md and their pictures.

From the root of the repository: ``python docs/reproduction``. Every number is measured anew.
"""

from pathlib import Path

import announced
import case_a
import case_bc
import case_d
import case_e
import case_f
import case_g
import general
from claims import Section, counted, render
from trust import lessons

DOCS = Path(__file__).parent.parent
PREFACE = """# The paper's claims, measured

What R. dell'Erba (2018, [doi](https://doi.org/10.1007/s00161-018-0663-5); page and figure numbers
of the pre-print) says of its model, against what pbdkit computes. Every sentence that we found to
be testable is quoted in a few words, with what was measured and one of three verdicts: **comes
out**, of the case as shipped; **comes out only with** a named variant, option or range; **does not
come out**. A verdict is computed from the numbers beside it. Where a claim failed, thresholds, lag,
shells, metric, frame and particles around the case were searched. Times of programs are those of
the pages that are named; all else is measured here.

The paper's time t is step t − 1: its figures at time 401 are of step 400. Particles have the
paper's numbers. Speeds, durations, thresholds and K that the paper does not give are our choice and
stand in the headers of the experiments ([paper/*](../pbdkit/experiments/paper)).

All of this page, its pictures and [that on anisotropy and plasticity](anisotropy-and-plasticity.md)
are made by one command, with no number typed by hand:

    python docs/reproduction
"""


def sections() -> list[Section]:
    """The model as a whole, then every case."""
    return [
        general.section(),
        case_a.section(),
        case_bc.section_b(),
        case_bc.section_c(),
        case_d.section(),
        case_e.section(),
        case_f.section(),
        case_g.section(),
    ]


def main() -> None:
    """Writes both pages."""
    found = sections()
    parts = [PREFACE, counted(found) + "\n", *map(render, found)]
    parts.append("## What to know before trusting the paper\n\n" + lessons())
    (DOCS / "reproduction.md").write_text("\n".join(parts), "utf-8")
    (DOCS / "anisotropy-and-plasticity.md").write_text(announced.page(), "utf-8")


if __name__ == "__main__":
    main()
