"""Open each page of the built site at the width of a phone: `python tests/pages_of_site.py FOLDER`.

The exit status is 1 if a page is wider than the screen, has errors or warnings in the console, or
requests a file of the site that does not exist. Requests to other servers are not made.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

from browser import NAMES
from playwright.sync_api import sync_playwright

SIZE = {"width": 390, "height": 844}
"""Size of the screen in pixels."""
WIDE = """() => {
  const width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth <= width) return [];
  const wide = [...document.querySelectorAll("article *")].filter(
    element => element.getBoundingClientRect().right > width + 1);
  return [`${document.documentElement.scrollWidth} pixels wide`,
          ...wide.slice(0, 3).map(element => element.outerHTML.slice(0, 80))];
}"""
"""Script that returns the width of a page that is too wide, and the first elements beyond."""


class Files(SimpleHTTPRequestHandler):
    """Files of the site, without a log."""

    def log_message(self, *args: Any) -> None:
        """Write no log of requests."""


def faults_of(page: Any, address: str) -> Iterator[str]:
    """Yield the faults of one page."""
    messages: list[str] = []
    listeners = {
        "console": lambda m: m.type == "log" or messages.append(f"{m.type}: {m.text}"),
        "pageerror": lambda error: messages.append(f"script: {error}"),
        "response": lambda r: r.status < 400 or messages.append(f"{r.status}: {r.url}"),
    }
    for event, listener in listeners.items():
        page.on(event, listener)
    page.goto(address)
    messages += page.evaluate(WIDE)
    for event, listener in listeners.items():
        page.remove_listener(event, listener)
    yield from (m for m in messages if "ERR_BLOCKED_BY_CLIENT" not in m)


def main(folder: Path) -> int:
    """Print the faults of all pages, and return the exit status."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    root = f"http://127.0.0.1:{server.server_port}/"
    browser = next(filter(None, map(shutil.which, NAMES)))
    faults = 0
    pages = sorted(folder.rglob("*.html"))
    with sync_playwright() as driver:
        page = driver.chromium.launch(executable_path=browser, args=["--no-sandbox"]).new_page(
            viewport=SIZE
        )
        page.route(
            lambda url: not url.startswith(root), lambda route: route.abort("blockedbyclient")
        )
        for path in pages:
            if "_static" in path.parts:
                continue
            name = path.relative_to(folder).as_posix()
            for fault in faults_of(page, root + name):
                print(f"{name}: {fault}")
                faults += 1
    server.shutdown()
    print(f"{len(pages)} pages, {faults} faults")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
