"""Make two pages of validation: reproduction and anisotropy-and-plasticity, and their pictures.

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
PREFACE = """# Reproduction of the paper

R. dell'Erba (2018, [doi](https://doi.org/10.1007/s00161-018-0663-5); page and figure numbers of the
pre-print) makes statements about the model that can be tested. Each one is quoted here in a few
words, beside the measurement and one of three verdicts: **reproduced** by the case as shipped;
**reproduced only with** a named variant, option or range; **not reproduced**. The verdict is
computed from the numbers beside it. Where a claim failed, thresholds, frame delay, shells, metric,
frame and particles around the case were varied. Execution times are taken from the pages that are
named; all other numbers are measured here.

The paper's time t is step t − 1: its figures at time 401 show step 400. Particles have the paper's
numbers. The paper does not give all speeds, durations, thresholds and values of K; the values
chosen here are listed at the head of each experiment (`paper/*`).

One command makes this page, its pictures and the page on
[anisotropy and plasticity](anisotropy-and-plasticity.md); no number is typed by hand:

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
    (DOCS / "validation/reproduction.md").write_text("\n".join(parts), "utf-8")
    (DOCS / "validation/anisotropy-and-plasticity.md").write_text(announced.page(), "utf-8")


if __name__ == "__main__":
    main()
