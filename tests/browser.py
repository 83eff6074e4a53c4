"""A browser for tests of pages: Chromium without a window, which draws WebGL in software."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OPTIONS = [
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    # One process draws all pages, and none is started in advance.
    "--renderer-process-limit=1",
    "--disable-features=SpareRendererForSitePerProcess",
]
LOOPBACK = ("127.0.0.1", "localhost", "::1")


# Not for the whole session: while it is open its event loop runs in this thread, and no other
# can be started here.
@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Yield Playwright's browser; tests that use it are skipped if there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=path, args=OPTIONS)
        yield found
        found.close()


@pytest.fixture(scope="module")
def empty_page(browser: Any) -> Iterator[tuple[Any, list[str]]]:
    """The page of all tests of a module, and the list of its faults. A new page for each test would
    take a quarter of a second of processor time more."""
    context = browser.new_context()
    faults: list[str] = []

    def only_here(route: Any) -> None:
        url, asked = urlsplit(route.request.url), route.request
        here = url.scheme in ("data", "blob") or url.hostname in LOOPBACK
        if here or (url.scheme == "file" and asked.is_navigation_request()):
            route.continue_()
        else:
            faults.append(f"a request for {asked.url}")
            route.abort()

    context.route("**/*", only_here)
    found = context.new_page()
    found.set_default_timeout(8000)
    found.on("console", lambda said: faults.append(f"{said.type}: {said.text}"))
    found.on("pageerror", lambda error: faults.append(str(error)))
    yield found, faults
    context.close()


@pytest.fixture
def page(empty_page: tuple[Any, list[str]]) -> Iterator[Any]:
    """An empty page, 1280 pixels wide. At the end its console must be empty, no script may have
    failed, and it may have requested nothing except the file that was opened and servers of this
    machine."""
    found, faults = empty_page
    faults.clear()
    found.set_viewport_size({"width": 1280, "height": 900})
    yield found
    found.goto("about:blank")
    assert faults == []


def until(holds: Callable[[], Any], seconds: float = 20.0) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, "it never came to that"
        time.sleep(0.03)


def until_page(page: Any, expression: str) -> None:
    """Wait like `wait_for_function`, which the page's policy does not allow to evaluate."""
    until(lambda: page.evaluate(expression))
