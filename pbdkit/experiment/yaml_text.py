"""An experiment, or a sweep, as text that is read again."""

from __future__ import annotations

from io import StringIO
from typing import Any

from ruamel.yaml import YAML

WIDTH = 88


def yaml_text(parts: dict[str, Any]) -> str:
    """The parts as YAML, in their order; numbers come back to the bit."""
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.width = WIDTH
    text = StringIO()
    yaml.dump(parts, text)
    return text.getvalue()
