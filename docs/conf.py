"""How the documentation site is built: `nox -s docs`, or `sphinx-build -W docs build/docs`."""

from __future__ import annotations

from importlib.metadata import version as version_of

project = "pbdkit"
copyright = "the pbdkit developers"
version = release = version_of("pbdkit")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["reproduction/*", "pictures/*"]

# Markdown. Pages with a kernel in their head are notebooks, run when the site is built.
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 120
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True

# The reference comes from the docstrings.
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_format = "short"
add_module_names = False

html_theme = "pydata_sphinx_theme"
html_title = "pbdkit"
html_theme_options = {
    "navbar_align": "left",
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
}
html_show_sourcelink = False
