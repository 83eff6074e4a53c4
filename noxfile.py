#!/usr/bin/env -S uv run --script
# /// script
# dependencies = ["nox>=2025.2.9"]
# ///
"""Checks of a change, one session for each subject: `nox -s lint`, or all of them by `nox`.

Each has an environment of its own; in one that has the group `dev`: `nox --no-venv --no-install`.
"""

from __future__ import annotations

from pathlib import Path

import nox

nox.needs_version = ">=2025.2.9"
nox.options.default_venv_backend = "virtualenv"

PROJECT = nox.project.load_toml("pyproject.toml")
PLUGINS = sorted(str(project.parent) for project in Path("plugins").glob("*/pyproject.toml"))


def install(session: nox.Session, group: str) -> None:
    """pbdkit with all extras, and a dependency group."""
    session.install("-e", ".[all]", *nox.project.dependency_groups(PROJECT, group))


@nox.session
def tests(session: nox.Session) -> None:
    """The tests, or those that are named: `nox -s tests -- tests/experiments/test_paper.py`."""
    install(session, "test")
    session.run("pytest", *(session.posargs or ["-n", "auto", "--dist", "worksteal"]))


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, types and prose."""
    install(session, "lint")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy", "pbdkit")
    theirs = (path for path in Path("plugins").glob("*/pbdkit_*") if path.suffix in ("", ".py"))
    session.run("mypy", *sorted(map(str, theirs)))
    session.run("python", "tests/prose.py")


@nox.session
def schemas(session: nox.Session) -> None:
    """The JSON Schemas are those of the program; `nox -s schemas -- write` writes them again."""
    install(session, "test")
    for what in ("experiment", "dataset", "sweep", "fit"):
        made = session.run("pbdkit", "schema", what, "--builtin", silent=True)
        kept = Path("schemas", f"{what}.schema.json")
        if "write" in session.posargs:
            kept.write_text(str(made), encoding="utf-8")
        elif kept.read_text(encoding="utf-8") != made:
            session.error(f"{kept} is out of date: nox -s schemas -- write")


@nox.session
def plugins(session: nox.Session) -> None:
    """The tests of the plugins, installed beside one another."""
    install(session, "test")
    session.run_install("pip", "install", *(word for plugin in PLUGINS for word in ("-e", plugin)))
    session.run("pytest", "-n", "auto", "--dist", "worksteal", *PLUGINS)
    session.run("pbdkit", "plugins", "list")


@nox.session
def installs(session: nox.Session) -> None:
    """Distributions are built and valid. Commands work with all extras, and without them or name
    the one that they need, in environments that the script makes; `nox -s installs -- --each` tries
    each extra alone."""
    install(session, "release")
    session.run("python", "tests/installs.py", *session.posargs)


@nox.session
def gpu(session: nox.Session) -> None:
    """Kernels for GPUs are compiled as far as that goes without one. The compiler takes half a
    gigabyte, which other environments are spared."""
    session.install("-e", ".[all,gpu]", *nox.project.dependency_groups(PROJECT, "test"))
    session.run("pytest", "-n", "auto", "tests/stepping/test_cuda_engine.py")


@nox.session(default=False)
def mutants(session: nox.Session) -> None:
    """Mutation testing, 500 changes; fewer: `nox -s mutants -- --count 60 --area contact`."""
    install(session, "nightly")
    session.run("python", "tests/reliability/mutants.py", *session.posargs)


@nox.session
def docs(session: nox.Session) -> None:
    """The documentation site, in build/docs; a warning is an error. `nox -s docs -- unrun` leaves
    out what notebooks and gallery show, which takes most of the time."""
    install(session, "docs")
    unrun = ["-D", "gallery_run=0", "-D", "nb_execution_mode=off"]
    # All pages are written: the search index of Sphinx has the index entries of written pages only.
    options = ["-W", "--keep-going", "-a", *(unrun if "unrun" in session.posargs else [])]
    session.run("sphinx-build", *options, "-b", "html", "docs", "build/docs")
    session.run("python", "docs/search_walk.py", "build/docs")


@nox.session
def pages(session: nox.Session) -> None:
    """Every page of build/docs in a browser, at the width of a phone."""
    session.install(*nox.project.dependency_groups(PROJECT, "test"))
    session.run("python", "tests/pages_of_site.py", "build/docs")


if __name__ == "__main__":
    nox.main()
