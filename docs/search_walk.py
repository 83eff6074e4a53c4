"""Search the built site for terms of finite elements, and compare the first page that is listed.

`python docs/search_walk.py build/docs` opens `search.html?q=TERM` for each term in Chromium, so
that the index, `search_terms.yaml` and `scorer.js` are used as in the browser of a reader. It fails
if another page is listed first.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote

EXPECTED = {
    "boundary condition": "modelling finite-elements",
    "Dirichlet": "finite-elements motions",
    "von Mises": "finite-elements dataset",
    "stress concentration": "plate-with-hole",
    "convergence": "refinement stability",
    "load step": "equilibrium",
    "quasi-static": "equilibrium",
    "constitutive": "finite-elements materials",
    "degrees of freedom": "finite-elements",
    "cross-validation": "fit-fields",
    "mesh": "finite-elements refinement",
    "mesh size": "refinement finite-elements",
    "node": "finite-elements",
    "element": "finite-elements",
    "connectivity": "finite-elements",
    "geometry": "modelling",
    "immersed boundary": "finite-elements",
    "node set": "finite-elements",
    "prescribed displacement": "finite-elements motions",
    "roller": "motions",
    "symmetry": "motions",
    "Neumann": "finite-elements loads",
    "traction": "finite-elements loads",
    "body force": "loads",
    "gravity": "finite-elements loads",
    "ghost points": "finite-elements glossary",
    "rigid-body modes": "finite-elements modelling",
    "contact": "obstacles",
    "material model": "materials",
    "Young's modulus": "finite-elements materials units",
    "Poisson's ratio": "finite-elements materials",
    "plane strain": "finite-elements materials",
    "orthotropic": "finite-elements materials",
    "random field": "fields",
    "amplitude curve": "finite-elements time-dependent",
    "stiffness matrix": "finite-elements numerics",
    "residual": "finite-elements numerics glossary",
    "increment": "equilibrium",
    "dynamic relaxation": "finite-elements stability",
    "Jacobi": "finite-elements",
    "momentum": "stability",
    "error bound": "numerics",
    "critical time step": "finite-elements",
    "multigrid": "numerics",
    "snap-through": "equilibrium",
    "buckling": "equilibrium",
    "mass": "motions",
    "reaction force": "finite-elements dataset",
    "strain energy": "finite-elements dataset",
    "cohesive zone": "finite-elements fracture",
    "crack": "fracture",
    "notch": "finite-elements fracture",
    "inverse problem": "finite-elements fit-fields",
    "parametric study": "finite-elements parameter-sweep",
    "restart": "long-runs finite-elements",
    "user subroutine": "finite-elements",
    "UMAT": "finite-elements",
    "ParaView": "paraview",
    "dogbone": "tensile-test",
    "load-displacement curve": "tensile-test",
    "Kirsch": "plate-with-hole",
    "effective modulus": "effective-modulus",
    "composite bounds": "effective-modulus",
    "own rule": "extending/tutorial",
    "installable package": "extending/tutorial",
    "angle term": "extending/tutorial",
    "parameter map": "parameter-sweep",
}
"""Terms, and the pages of which one must be listed first."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
RESULTS = "document.querySelectorAll('#search-results ul.search > li > a')"
LISTED = f"""{RESULTS}.length > 2
    || document.querySelector('.search-summary')?.textContent.includes('finished')"""
FIRST = f"[...{RESULTS}].slice(0, 3).map(link => link.href)"


def first_pages(site: Path, terms: Iterable[str]) -> dict[str, list[str]]:
    """Return the first three results that the search of the site lists for each term."""
    from playwright.sync_api import sync_playwright

    root = site.resolve().as_uri() + "/"
    results = {}
    with sync_playwright() as driver:
        path = next(filter(None, map(shutil.which, BROWSERS)))
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page()
        page.route("http*://**", lambda route: route.abort())
        for term in terms:
            page.goto(f"{root}search.html?q={quote(term)}")
            page.wait_for_function(LISTED)
            links = page.evaluate(FIRST)
            results[term] = [link.removeprefix(root).partition("?")[0] for link in links]
        browser.close()
    return results


def missing() -> str:
    """Return the name of what is not installed, or an empty text."""
    if find_spec("playwright") is None:
        return "playwright"
    return "" if any(map(shutil.which, BROWSERS)) else " or ".join(BROWSERS)


def main(site: str) -> int:
    """Print the first results of each term; return the number of terms with another page first."""
    if missing():
        print(f"the search is not tested: {missing()} is not installed")
        return 0
    wrong = 0
    for term, pages in first_pages(Path(site), EXPECTED).items():
        first = pages[0].partition(".html")[0] if pages else "nothing"
        right = first in EXPECTED[term].split()
        wrong += not right
        print(f"{term:24} {'right' if right else 'WRONG'}  {'  '.join(pages)}")
    print(f"{len(EXPECTED) - wrong} of {len(EXPECTED)} terms lead to the right page first")
    return wrong


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) > 0)
