"""Make two pages of validation: reproduction and anisotropy-and-plasticity, and their pictures.

From the root of the repository: ``python docs/reproduction``. Every number is measured in the run.
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

This page compares the program with the paper that defines the model of the program: R. dell'Erba
(2018, [doi](https://doi.org/10.1007/s00161-018-0663-5)). Each testable claim of the paper is quoted
in a few words and has one of three verdicts: **reproduced** by the shipped case, **reproduced only
with** a named variant, option or range, or **not reproduced**. The verdict is computed from the
measurement below the quotation. A claim that failed was also tested with variants of the case:
other thresholds, frame delays, shells, neighbour metrics, frames and particles.

The paper's time t is step t − 1: its figures at time 401 show step 400. Figure numbers are those of
the pre-print, and particles have the paper's numbers. The paper does not give all speeds,
durations, thresholds and values of K; the values chosen here are listed at the head of each
experiment (`paper/*`).

One command generates this page, its pictures and the page on [anisotropy and plastic-like
behaviour](anisotropy-and-plasticity.md). All numbers are measured in that run, except for execution
times, which are taken from the linked pages:

    python docs/reproduction
"""


def sections() -> list[Section]:
    """Return the sections: the model as a whole, then every case."""
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
    """Write both pages and their pictures."""
    cases = sections()
    parts = [PREFACE, counted(cases) + "\n", *map(render, cases)]
    parts.append("## Conclusions\n\n" + lessons())
    (DOCS / "validation/reproduction.md").write_text("\n".join(parts), "utf-8")
    (DOCS / "validation/anisotropy-and-plasticity.md").write_text(announced.page(), "utf-8")


if __name__ == "__main__":
    main()
