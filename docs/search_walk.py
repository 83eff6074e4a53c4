"""Search the built site for the terms of finite elements, and compare the first page found.

`python docs/search_walk.py build/docs` opens `search.html?q=TERM` of each term in Chromium, so that the index
of Sphinx and `scorer.js` are used as in a reader's browser. It fails if another page comes first.
"""

from __future__ import annotations

import shutil
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

EXPECTED = {
    "boundary condition": "finite-elements",
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
}
"""The pages, without extension, of which one comes first for a term."""
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


class Silent(SimpleHTTPRequestHandler):
    """Serve files without a line for each request."""

    def log_message(self, *_: Any) -> None:
        """Print nothing."""


def first_pages(site: str, terms: list[str]) -> dict[str, list[str]]:
    """Return the first three pages that the search of the site lists for each term."""
    from playwright.sync_api import sync_playwright

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    root = f"http://127.0.0.1:{server.server_address[1]}/"
    path = next(filter(None, map(shutil.which, NAMES)))
    found = {}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page()
        page.route("**/*", lambda r: r.continue_() if r.request.url.startswith(root) else r.abort())
        for term in terms:
            page.goto(f"{root}search.html?q={term}")
            page.wait_for_function(
                "document.querySelector('.search-summary')?.textContent.includes('finished')"
                " || document.querySelectorAll('#search-results ul.search li').length > 5"
            )
            links = "[...document.querySelectorAll('#search-results ul.search li > a')]"
            hrefs = page.evaluate(f"{links}.slice(0, 3).map(link => link.href)")
            found[term] = [h.removeprefix(root).partition("?")[0] for h in hrefs]
        browser.close()
    server.shutdown()
    return found


def main(site: str) -> int:
    """Print the terms whose first page is not one of those expected; return their number."""
    if next(filter(None, map(shutil.which, NAMES)), None) is None:
        print(f"the search is not tested: none of {', '.join(NAMES)} is installed")
        return 0
    wrong = 0
    for term, pages in first_pages(site, list(EXPECTED)).items():
        first = pages[0].partition(".html")[0] if pages else "nothing"
        right = first in EXPECTED[term].split()
        wrong += not right
        print(f"{term:24} {'right' if right else 'WRONG'}  {'  '.join(pages)}")
    print(f"{len(EXPECTED) - wrong} of {len(EXPECTED)} terms lead to the right page first")
    return wrong


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) > 0)
