"""Index entries of the site, from search_terms.yaml: the search lists them first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ruamel.yaml
from docutils import nodes
from sphinx.addnodes import index
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.transforms import SphinxTransform

TERMS: dict[str, dict[str, list[str]]] = ruamel.yaml.YAML(typ="safe").load(
    Path(__file__).with_suffix(".yaml").read_text("utf-8")
)


class IndexedSections(SphinxTransform):
    """Insert the index entries of a page into its sections, before the domains read them."""

    default_priority = 840

    def apply(self, **_: Any) -> None:
        """Raise an ExtensionError if the page has no section with a named anchor."""
        sections = list(self.document.findall(nodes.section))
        for anchor, terms in TERMS.get(self.env.docname, {}).items():
            found = [s for s in sections if not anchor or anchor in (s.get("slug"), *s["ids"])]
            if not found:
                raise ExtensionError(f"search_terms.yaml: {self.env.docname} has no #{anchor}")
            target = found[0]["ids"][0]
            entries = [("single", term, target, "main", None) for term in terms]
            found[0].insert(1, index(entries=entries))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the transform of sections."""
    app.add_transform(IndexedSections)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
