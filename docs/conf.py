"""Configuration of the documentation site: `nox -s docs`, or `sphinx-build -W docs build/docs`."""

from __future__ import annotations

import sys
from importlib.metadata import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

project = "pbdkit"
copyright = "the pbdkit developers"
DISTRIBUTION = metadata("pbdkit")
version = release = DISTRIBUTION["Version"].partition("+")[0]
urls = dict(entry.split(", ") for entry in DISTRIBUTION.get_all("Project-URL") or [])

extensions = [
    "gallery",
    "myst_nb",
    "python_reference",
    "reference_pages",
    "search_terms",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["paper/*", "reproduction/*", "pictures/*"]

# Markdown. Pages with a kernel in their head are notebooks, run when the site is built.
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_execution_in_temp = True
suppress_warnings = ["myst-nb.lexer"]  # of notebooks that were not run
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True

toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_search_scorer = str(HERE / "scorer.js")
html_title = "pbdkit"
html_logo = "pictures/logo.svg"
html_favicon = "pictures/logo.svg"
html_static_path = ["static", str(HERE.parent / "build" / "movies")]
html_css_files = ["site.css"]
html_theme_options = {
    "logo": {"text": f"pbdkit {version}"},
    "header_links_before_dropdown": 8,
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc", "edit-this-page"],
}
html_context = {"default_mode": "auto"}
html_show_sourcelink = False
if "Repository" in urls:
    html_theme_options["icon_links"] = [
        {"name": "Repository", "url": urls["Repository"], "icon": "fa-solid fa-code-branch"}
    ]
    html_theme_options["use_edit_page_button"] = True
    html_context["edit_page_url_template"] = urls["Repository"] + "/edit/main/docs/{{ file_name }}"
