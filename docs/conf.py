"""How the documentation site is built: `nox -s docs`, or `sphinx-build -W docs build/docs`."""

from __future__ import annotations

import sys
from importlib.metadata import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from gallery_scripts import write_scripts  # noqa: E402

project = "pbdkit"
copyright = "the pbdkit developers"
DISTRIBUTION = metadata("pbdkit")
version = release = DISTRIBUTION["Version"]
urls = dict(entry.split(", ") for entry in DISTRIBUTION.get_all("Project-URL") or [])

extensions = [
    "myst_nb",
    "python_reference",
    "reference_pages",
    "search_terms",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["reproduction/*", "pictures/*", "gallery/**/*.ipynb", "**/sg_execution_times.*"]

# Markdown. Pages with a kernel in their head are notebooks, run when the site is built.
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_execution_in_temp = True
suppress_warnings = ["myst-nb.lexer"]  # of notebooks that were not run
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True

# A script an experiment, written here, run by the gallery.
SCRIPTS = HERE.parent / "build" / "gallery"
write_scripts(SCRIPTS)
sphinx_gallery_conf = {
    "examples_dirs": str(SCRIPTS),
    "gallery_dirs": "gallery",
    "matplotlib_animations": (True, "html5"),
    "reset_modules": ("matplotlib", "gallery_scripts.with_ffmpeg"),
    "capture_repr": (),
    "remove_config_comments": True,
    "show_memory": False,
    "download_all_examples": False,
    "write_computation_times": False,
}

toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_search_scorer = str(HERE / "scorer.js")
html_title = "pbdkit"
html_logo = "pictures/logo.svg"
html_favicon = "pictures/logo.svg"
html_theme_options = {
    "logo": {"text": f"pbdkit {version}"},
    "header_links_before_dropdown": 8,
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
}
if "Repository" in urls:
    html_theme_options["icon_links"] = [
        {"name": "Repository", "url": urls["Repository"], "icon": "fa-solid fa-code-branch"}
    ]
html_context = {"default_mode": "auto"}
html_show_sourcelink = False
